"""The differentiable program: every program of the derivation graph computed at once, mixed by W.

Layer k of a derivation graph of depth d chooses between ``E_k ::= C_k`` and ``E_k ::= if B_k then C'_k else E_{k+1}``;
the last layer is ``C_d`` (grammar of figure 1). So there are d complete programs, of 0 to d - 1 conditions, which share
their conditions and then-controllers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch as th
from torch import nn

from progpolicy_envs.symmetry import Symmetry
from sb3_progpolicy.differentiable.conditions import Conditions, State, matrix, vector
from sb3_progpolicy.differentiable.search import DerivationSearch
from sb3_progpolicy.differentiable.tied import TiedLinear
from sb3_progpolicy.programs.syntax import BOX_SEMANTICS, BoxSemantics, Cell, Controller, Expression, IfThenElse
from sb3_progpolicy.spaces import ActionSpec
from sb3_progpolicy.symmetries import Group


class ProgramModule(nn.Module):
    """All programs of a derivation graph under the soft semantics of section 2.2, mixed with W's probabilities.

    ``[[if B then C else E]] = s(B)·C + (1 - s(B))·E`` with ``s`` the sigmoid. The mixture is linear in the
    controllers, so that each of the ``2 depth - 1`` controllers has one weight: the probability that a program is drawn
    from W and its branches, drawn from the sigmoids, lead to that controller. One cumulative product over the
    conditions and one over the choices give all mixture weights in O(depth).

    For discrete actions the controllers' action probabilities are mixed. For Box actions it is their values, or, with
    ``semantics="branches"``, the densities of Gaussians around them.

    :param n_inputs: length of X
    :param action: the action space
    :param depth: layers of the derivation graph, at least 1; programs have 0 to ``depth - 1`` conditions
    :param cell: see :class:`Conditions`
    :param condition_size: see there, ``size``
    :param temperature: of the sigmoid, above 0; towards 0 the soft semantics becomes the crisp one
    :param semantics: of Box actions, ``"means"`` or ``"branches"``
    :param symmetries: generators of a group that is to leave the program as it is: all weights of a controller that are
        one another's images are one number, and conditions read the mean of X over the group
    """

    def __init__(
        self,
        n_inputs: int,
        action: ActionSpec,
        depth: int = 3,
        cell: Cell = "gru",
        condition_size: int = 1,
        temperature: float = 1.0,
        semantics: BoxSemantics = "means",
        symmetries: Sequence[Symmetry | Mapping[str, Any]] = (),
    ) -> None:
        super().__init__()
        if depth < 1:
            raise ValueError(f"depth={depth} is not accepted; a derivation graph has at least 1 layer")
        if semantics not in BOX_SEMANTICS:
            raise ValueError(f"semantics={semantics!r} is not accepted; it is one of {', '.join(BOX_SEMANTICS)}")
        self.semantics: BoxSemantics = semantics
        self.group = Group(symmetries, n_inputs, action) if symmetries else None
        self.n_inputs, self.action, self.depth = n_inputs, action, depth
        projection = None if self.group is None else th.from_numpy(self.group.mean_of_inputs())
        self.conditions = Conditions(n_inputs, depth - 1, cell, condition_size, projection)
        # Rows: the then-controllers C'_1 ... C'_K, then the last controllers C_1 ... C_depth.
        n_controllers = 2 * depth - 1
        self.controllers: nn.Linear | TiedLinear = (
            nn.Linear(n_inputs, n_controllers * action.n_outputs)
            if self.group is None
            else TiedLinear(self.group.ties(), n_controllers)
        )
        self.search = DerivationSearch(depth)
        self.temperature: th.Tensor
        self.register_buffer("temperature", th.tensor(float(temperature)))
        #: Logits of discrete actions are divided by it; the crisp program's choice does not depend on it.
        self.action_temperature: th.Tensor
        self.register_buffer("action_temperature", th.tensor(1.0))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Load a state dict; one of release 0.1 has no action temperature, which was 1."""
        state_dict.setdefault(f"{prefix}action_temperature", th.ones_like(self.action_temperature))
        super()._load_from_state_dict(state_dict, prefix, *args)

    @th.no_grad()
    def keep_action_(self, weight: float) -> None:
        """Let every controller favour the action taken before, which is among the inputs.

        :param weight: is added to what each output reads of its own previous value
        """
        n_outputs = self.action.n_outputs
        first = self.n_inputs - self.action.interaction_size
        weights = self.controllers.weight.detach().clone()
        weights.unflatten(0, (-1, n_outputs))[:, range(n_outputs), range(first, first + n_outputs)] += weight
        if isinstance(self.controllers, TiedLinear):
            self.controllers.set_(weights)
        else:
            self.controllers.weight.copy_(weights)

    @property
    def n_controllers(self) -> int:
        """Number of controllers in the graph."""
        return 2 * self.depth - 1

    @property
    def controllers_in_use(self) -> list[int]:
        """Which controllers can decide: all of them during the search, then those of the selected program."""
        return (
            list(range(self.n_controllers))
            if self.search.searching
            else self._controller_rows(self.search.most_likely())
        )

    def path_probabilities(self, condition_values: th.Tensor, crisp: bool = False) -> th.Tensor:
        """Return how probable it is for the branches of its program to lead to each controller in use.

        :param condition_values: the values of B, ``(..., depth - 1)``
        :param crisp: decide each branch by ``B >= 0`` instead of weighing it
        :return: ``(..., n_in_use)``, then-controllers first; the last controllers are those of programs of any length
        """
        values = condition_values
        if not self.search.searching:
            values = values[..., : self.search.most_likely()]
        taken = (values >= 0).to(values.dtype) if crisp else th.sigmoid(values / self.temperature)
        reached = th.cat((values.new_ones(*values.shape[:-1], 1), th.cumprod(1 - taken, dim=-1)), dim=-1)
        last = reached if self.search.searching else reached[..., -1:]
        return th.cat((taken * reached[..., :-1], last), dim=-1)

    def choices(self) -> th.Tensor:
        """Return how probable it is under W for a program to contain each controller in use, ``(n_in_use,)``."""
        if not self.search.searching:
            return self.controllers.weight.new_ones(self.search.most_likely() + 1)
        return th.cat((self.search.at_least(), self.search.probabilities()))

    def mixture_weights(self, condition_values: th.Tensor, crisp: bool = False) -> th.Tensor:
        """Return the weight of every controller in use; they sum to 1. See :meth:`path_probabilities`."""
        paths = self.path_probabilities(condition_values, crisp)
        return paths * self.choices() if self.search.searching else paths

    def mix(self, inputs: th.Tensor, mixture_weights: th.Tensor) -> th.Tensor:
        """Return the parameters of the action distribution.

        :param inputs: X, ``(..., n_inputs)``
        :param mixture_weights: ``(..., n_in_use)``
        :return: ``(..., n_outputs)``: means for Box, log-probabilities for Discrete and MultiDiscrete (per component),
            log-odds for MultiBinary; with branches, ``(..., n_in_use * (1 + n_outputs))``: the logarithms of the
            weights, then the controllers' outputs
        """
        mixed = self.mix_outputs(self.controller_outputs(inputs), mixture_weights.flatten(0, -2))
        return mixed.unflatten(0, inputs.shape[:-1])

    def mix_outputs(self, outputs: th.Tensor, mixture_weights: th.Tensor) -> th.Tensor:
        """Return what :meth:`mix` returns, for outputs that are known.

        :param outputs: of the controllers in use, from :meth:`controller_outputs`
        :param mixture_weights: ``(rows, n_in_use)``
        """
        if self.mixes_branches:
            return th.cat((_log(mixture_weights), outputs.permute(2, 0, 1).flatten(1)), dim=-1)
        mixed = (mixture_weights.T.unsqueeze(1) * self._to_terms(outputs)).sum(0)
        return self._to_parameters(mixed.T)

    def derivation_terms(self, inputs: th.Tensor, condition_values: th.Tensor) -> th.Tensor:
        """Return the matrices by which the mixture is linear in W's probabilities, as long as phi stays.

        :param inputs: X, ``(n, n_inputs)``
        :param condition_values: the values of B, ``(n, depth - 1)``
        :return: for :meth:`mix_derivation`: ``(n, n_terms, n_in_use)``, or with branches
            ``(n, n_in_use * (1 + n_outputs))``
        """
        if self.mixes_branches:
            outputs = self._terms(inputs).permute(2, 0, 1).flatten(1)
            return th.cat((self.path_probabilities(condition_values), outputs), dim=1)
        terms = self.path_probabilities(condition_values).T.unsqueeze(1) * self._terms(inputs)
        return terms.permute(2, 1, 0).contiguous()

    def mix_derivation(self, terms: th.Tensor) -> th.Tensor:
        """Return what :meth:`mix` returns.

        :param terms: from :meth:`derivation_terms`
        """
        if self.mixes_branches:
            choices = self.choices()
            return th.cat((_log(terms[:, : len(choices)] * choices), terms[:, len(choices) :]), dim=1)
        return self._to_parameters(terms @ self.choices())

    def controller_outputs(self, inputs: th.Tensor) -> th.Tensor:
        """Return the outputs of the controllers in use, ``(n_in_use, n_outputs, rows)``.

        Rows come last: softmax and sums then run along contiguous memory, twice as fast as over a last axis of a few.

        :param inputs: X, ``(..., n_inputs)``
        """
        (weight, bias), in_use = self.controller_parameters(), self.controllers_in_use
        if len(in_use) < self.n_controllers:
            rows = th.tensor(in_use, device=weight.device)
            weight, bias = (
                block.unflatten(0, (self.n_controllers, -1))[rows].flatten(0, 1) for block in (weight, bias)
            )
        outputs = th.addmm(bias.unsqueeze(1), weight, inputs.flatten(0, -2).T)
        return outputs.unflatten(0, (len(in_use), self.action.n_outputs))

    def _terms(self, inputs: th.Tensor) -> th.Tensor:
        """Return what is mixed, ``(n_in_use, n_terms, rows)``: values, or probabilities."""
        return self._to_terms(self.controller_outputs(inputs))

    def _to_terms(self, outputs: th.Tensor) -> th.Tensor:
        if self.action.kind == "box":
            return outputs
        if self.action.kind == "multi_binary":
            return th.cat((th.sigmoid(outputs), th.sigmoid(-outputs)), dim=1)
        if self.action.kind == "discrete":
            return outputs.softmax(1)
        return th.cat([component.softmax(1) for component in outputs.split(list(self.action.sizes), dim=1)], dim=1)

    @property
    def mixes_branches(self) -> bool:
        """Whether the actions are drawn from a mixture of Gaussians."""
        return self.action.kind == "box" and self.semantics == "branches"

    def controller_parameters(self) -> tuple[th.Tensor, th.Tensor]:
        """Return weights and biases of all controllers, of logits by the action temperature."""
        if isinstance(self.controllers, TiedLinear):
            weight, bias = self.controllers.expand()
        else:
            weight, bias = self.controllers.weight, self.controllers.bias
        if self.action.kind == "box":
            return weight, bias
        return weight / self.action_temperature, bias / self.action_temperature

    @th.no_grad()
    def crisp_controllers(self, condition_values: th.Tensor) -> th.Tensor:
        """Return which of the controllers in use decides in the most likely program, run crisp, ``(n,)``.

        :param condition_values: the values of B, ``(n, depth - 1)``
        """
        n_conditions = self.search.most_likely()
        taken = condition_values[:, :n_conditions] >= 0
        last = self.depth - 1 + n_conditions if self.search.searching else n_conditions
        first = taken.to(th.int8).argmax(1) if n_conditions else taken.new_zeros(len(taken), dtype=th.long)
        return th.where(taken.any(1), first, last)

    @th.no_grad()
    def crisp_disagreement(self, inputs: th.Tensor, condition_values: th.Tensor) -> float:
        """Return the share of steps on which the soft program's most likely action is not the crisp program's.

        For Box actions it is the share on which the most likely controller is not the one that decides.

        :param inputs: X, ``(n, n_inputs)``
        :param condition_values: the values of B, ``(n, depth - 1)``
        """
        weights, crisp = self.mixture_weights(condition_values), self.crisp_controllers(condition_values)
        if self.action.kind == "box":
            return (weights.argmax(1) != crisp).float().mean().item()
        terms = self._terms(inputs)
        soft = self._modes((weights.T.unsqueeze(1) * terms).sum(0))
        own = self._modes(terms.permute(2, 0, 1)[th.arange(len(crisp), device=crisp.device), crisp].T)
        return (soft != own).any(0).float().mean().item()

    def _modes(self, probabilities: th.Tensor) -> th.Tensor:
        """Return the most likely choice of each component, ``(n_components, n)``, of terms ``(n_terms, n)``."""
        if self.action.kind == "multi_binary":
            on, off = probabilities.chunk(2)
            return on >= off
        return th.stack([part.argmax(0) for part in probabilities.split(list(self.action.sizes))])

    def _to_parameters(self, mixed: th.Tensor) -> th.Tensor:
        """Turn mixed terms ``(..., n_terms)`` into the parameters of the action distribution."""
        if self.action.kind == "box":
            return mixed
        if self.action.kind == "multi_binary":
            on, off = mixed.chunk(2, dim=-1)
            return _log(on) - _log(off)
        return _log(mixed)

    def forward(self, inputs: th.Tensor, state: State, crisp: bool = False) -> tuple[th.Tensor, State]:
        """Run the program over a sequence.

        :param inputs: X, ``(n_steps, n_sequences, n_inputs)``
        :param state: two tensors ``(1, n_sequences, hidden_size)``; zeros at the start of a task
        :param crisp: run every program as a real if-then-else
        :return: distribution parameters ``(n_steps, n_sequences, n_outputs)`` (see :meth:`mix`) and the new state
        """
        if self.search.needs_conditions:
            condition_values, state = self.conditions(inputs, state)
        else:
            condition_values = inputs.new_zeros(*inputs.shape[:-1], self.depth - 1)
        return self.mix(inputs, self.mixture_weights(condition_values, crisp)), state

    def initial_state(self, n_sequences: int) -> State:
        """Return the zero state of ``n_sequences`` sequences."""
        zeros = self.controllers.weight.new_zeros(1, n_sequences, self.conditions.hidden_size)
        return zeros, zeros.clone()

    def extract(self, n_conditions: int | None = None) -> ProgramModule:
        """Return one program of the graph as a module of its own, computing what it computed inside the mixture.

        :param n_conditions: which program; the most likely one under W if ``None``
        :raises ValueError: if the graph has no such program
        """
        n_conditions = self.search.most_likely() if n_conditions is None else n_conditions
        if not 0 <= n_conditions < self.depth:
            raise ValueError(f"n_conditions={n_conditions} is not accepted; this graph has 0 to {self.depth - 1}")
        module = ProgramModule(
            self.n_inputs,
            self.action,
            n_conditions + 1,
            self.conditions.cell,
            self.conditions.size,
            float(self.temperature),
            self.semantics,
        ).to(self.controllers.weight.device)
        module.conditions = self.conditions.keep(n_conditions).to(self.controllers.weight.device)
        # In the new graph only the deepest program is drawn, so only its controllers need values.
        rows = self._controller_rows(n_conditions)
        with th.no_grad():
            module.controllers.weight.zero_()
            module.controllers.bias.zero_()
            targets = module._controller_rows(n_conditions)
            for name, values in zip(("weight", "bias"), self.controller_parameters(), strict=True):
                blocks = values.unflatten(0, (self.n_controllers, -1))
                module.controllers.get_parameter(name).unflatten(0, (module.n_controllers, -1))[targets] = blocks[rows]
        module.search.select(n_conditions)
        return module

    def to_syntax(self, n_conditions: int | None = None) -> Expression:
        """Return one program of the graph as plain data.

        :param n_conditions: which program; the most likely one under W if ``None``
        """
        n_conditions = self.search.most_likely() if n_conditions is None else n_conditions
        weights, biases = (values.unflatten(0, (self.n_controllers, -1)) for values in self.controller_parameters())
        *then, last = (
            Controller(matrix(weights[row]), vector(biases[row])) for row in self._controller_rows(n_conditions)
        )
        expression: Expression = last
        for k in reversed(range(n_conditions)):
            expression = IfThenElse(self.conditions.to_syntax(k), then[k], expression)
        return expression

    def _controller_rows(self, n_conditions: int) -> list[int]:
        """Which controllers a program uses: its then-controllers, then its last one."""
        return [*range(n_conditions), self.depth - 1 + n_conditions]


def _log(probabilities: th.Tensor) -> th.Tensor:
    return th.log(probabilities.clamp_min(th.finfo(probabilities.dtype).tiny))
