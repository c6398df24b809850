"""The differentiable program: every program of the derivation graph computed at once, mixed by W.

Layer k of a derivation graph of depth d chooses between ``E_k ::= C_k`` and ``E_k ::= if B_k then C'_k else E_{k+1}``;
the last layer is ``C_d`` (grammar of figure 1). So there are d complete programs, of 0 to d - 1 conditions, which share
their conditions and then-controllers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch as th
from torch import nn

from sb3_progpolicy.differentiable.recurrence import scan
from sb3_progpolicy.differentiable.search import DerivationSearch
from sb3_progpolicy.programs.syntax import GATES, Cell, Condition, Controller, Expression, IfThenElse
from sb3_progpolicy.spaces import ActionSpec

State = tuple[th.Tensor, th.Tensor]

_LAYERS: dict[Cell, Callable[[int, int], nn.RNNBase]] = {"rnn": nn.RNN, "gru": nn.GRU, "lstm": nn.LSTM}
CELLS: tuple[Cell, ...] = ("affine", *_LAYERS)


class Conditions(nn.Module):
    """All conditions ``B_1 ... B_K`` of a program in one recurrent layer.

    The recurrent matrix is block-diagonal: entries between the units of different conditions are zero and get no
    gradient, so that each condition has a state of its own while one fused kernel computes them all.

    The module is called like ``torch.nn.LSTM`` whatever the cell, so that sb3-contrib's sequence handling can run
    it; cells without a second state pass it through.

    :param n_inputs: length of X
    :param n_conditions: K, 0 or more
    :param cell: ``"gru"``, ``"lstm"``, ``"rnn"``, or ``"affine"`` for conditions without a state
    :param size: hidden units per condition, at least 1
    """

    num_layers = 1

    def __init__(self, n_inputs: int, n_conditions: int, cell: Cell = "gru", size: int = 1) -> None:
        super().__init__()
        if cell not in CELLS:
            raise ValueError(f"cell={cell!r} is not accepted; known cells: {', '.join(CELLS)}")
        if size < 1:
            raise ValueError(f"condition size {size} is not accepted; it is at least 1")
        self.input_size, self.n_conditions, self.cell, self.size = n_inputs, n_conditions, cell, size
        self.recurrent = cell != "affine" and n_conditions > 0
        # SB3 keeps states as arrays of this width; it cannot be 0.
        self.hidden_size = n_conditions * size if self.recurrent else 1
        if self.recurrent:
            self.rnn = _LAYERS[cell](n_inputs, self.hidden_size)
            self._make_block_diagonal()
            self.readout = nn.Parameter(th.ones(n_conditions, size) / size**0.5)
            self.readout_bias = nn.Parameter(th.zeros(n_conditions))
        elif n_conditions:
            self.affine = nn.Linear(n_inputs, n_conditions)

    def _make_block_diagonal(self) -> None:
        blocks = th.block_diag(*[th.ones(self.size, self.size)] * self.n_conditions)
        mask = blocks.repeat(len(GATES[self.cell]), 1)
        weight = cast(nn.Parameter, self.rnn.weight_hh_l0)
        with th.no_grad():
            weight.mul_(mask)
        weight.register_hook(lambda gradient: gradient * mask.to(gradient.device))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copied module; torch copies no hooks, so that the block structure is set anew."""
        super().__setstate__(state)
        if self.recurrent:
            self._make_block_diagonal()

    def forward(self, inputs: th.Tensor, state: State) -> tuple[th.Tensor, State]:
        """Compute every B for a sequence.

        :param inputs: X, ``(n_steps, n_sequences, n_inputs)``
        :param state: two tensors ``(1, n_sequences, hidden_size)``
        :return: B, ``(n_steps, n_sequences, n_conditions)``, and the state after the last step
        """
        if not self.n_conditions:
            return inputs.new_zeros(*inputs.shape[:-1], 0), state
        if not self.recurrent:
            return self.affine(inputs), state
        if self.cell == "lstm":
            hidden, state = self.rnn(inputs, state)
        elif inputs.device.type == "cpu" and inputs.dtype == th.float32:
            hidden = self._scan(inputs, state[0][0])
            state = (hidden[-1:], state[1])
        else:
            hidden, last = self.rnn(inputs, state[0])
            state = (last, state[1])
        units = hidden.unflatten(-1, (self.n_conditions, self.size))
        return (units * self.readout).sum(-1) + self.readout_bias, state

    def _scan(self, inputs: th.Tensor, hidden: th.Tensor) -> th.Tensor:
        names = ("weight_ih_l0", "bias_ih_l0", "weight_hh_l0", "bias_hh_l0")
        input_weight, input_bias, weight, bias = (cast(th.Tensor, getattr(self.rnn, name)) for name in names)
        return scan(self.cell, nn.functional.linear(inputs, input_weight, input_bias), weight, bias, hidden)

    def to_syntax(self, k: int) -> Condition:
        """Return condition ``k`` (0-based) as plain data."""
        if not self.recurrent:
            weight, bias = self.affine.weight[k], self.affine.bias[k]
            return Condition("affine", (), (), (), (), _vector(weight), bias.item())
        n_gates = len(GATES[self.cell])
        rows = slice(k * self.size, (k + 1) * self.size)

        def gates(parameter: th.Tensor | nn.Module) -> th.Tensor:
            return cast(th.Tensor, parameter).unflatten(0, (n_gates, self.hidden_size))[:, rows].flatten(0, 1)

        return Condition(
            cell=self.cell,
            weight_ih=_matrix(gates(self.rnn.weight_ih_l0)),
            weight_hh=_matrix(gates(self.rnn.weight_hh_l0)[:, rows]),
            bias_ih=_vector(gates(self.rnn.bias_ih_l0)),
            bias_hh=_vector(gates(self.rnn.bias_hh_l0)),
            readout=_vector(self.readout[k]),
            readout_bias=self.readout_bias[k].item(),
        )

    def keep(self, n_conditions: int) -> Conditions:
        """Return a module of the first ``n_conditions`` conditions alone, with copies of their parameters."""
        kept = Conditions(self.input_size, n_conditions, self.cell, self.size)
        rows = slice(0, n_conditions * self.size)
        with th.no_grad():
            for name, parameter in kept.named_parameters():
                source: th.Tensor = self.get_parameter(name)
                if name.startswith("rnn."):
                    source = source.unflatten(0, (len(GATES[self.cell]), self.hidden_size))[:, rows].flatten(0, 1)
                    source = source[:, rows] if name == "rnn.weight_hh_l0" else source
                else:
                    source = source[:n_conditions]
                parameter.copy_(source)
        return kept


class ProgramModule(nn.Module):
    """All programs of a derivation graph under the soft semantics of section 2.2, mixed with W's probabilities.

    ``[[if B then C else E]] = s(B)·C + (1 - s(B))·E`` with ``s`` the sigmoid. The mixture is linear in the
    controllers, so that each of the ``2 depth - 1`` controllers has one weight: the probability that a program is drawn
    from W and its branches, drawn from the sigmoids, lead to that controller. One cumulative product over the
    conditions and one over the choices give all mixture weights in O(depth).

    For discrete actions the controllers' action probabilities are mixed, for Box actions their values.

    :param n_inputs: length of X
    :param action: the action space
    :param depth: layers of the derivation graph, at least 1; programs have 0 to ``depth - 1`` conditions
    :param cell: see :class:`Conditions`
    :param condition_size: hidden units per condition
    :param temperature: of the sigmoid, above 0; towards 0 the soft semantics becomes the crisp one
    """

    def __init__(
        self,
        n_inputs: int,
        action: ActionSpec,
        depth: int = 3,
        cell: Cell = "gru",
        condition_size: int = 1,
        temperature: float = 1.0,
    ) -> None:
        super().__init__()
        if depth < 1:
            raise ValueError(f"depth={depth} is not accepted; a derivation graph has at least 1 layer")
        self.n_inputs, self.action, self.depth = n_inputs, action, depth
        self.conditions = Conditions(n_inputs, depth - 1, cell, condition_size)
        # Rows: the then-controllers C'_1 ... C'_K, then the last controllers C_1 ... C_depth.
        self.controllers = nn.Linear(n_inputs, (2 * depth - 1) * action.n_outputs)
        self.search = DerivationSearch(depth)
        self.temperature: th.Tensor
        self.register_buffer("temperature", th.tensor(float(temperature)))

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
            log-odds for MultiBinary
        """
        weights = mixture_weights.flatten(0, -2).T.unsqueeze(1)
        mixed = (weights * self._terms(inputs)).sum(0)
        return self._to_parameters(mixed.T.unflatten(0, inputs.shape[:-1]))

    def derivation_terms(self, inputs: th.Tensor, condition_values: th.Tensor) -> th.Tensor:
        """Return the matrices by which the mixture is linear in W's probabilities, as long as phi stays.

        :param inputs: X, ``(n, n_inputs)``
        :param condition_values: the values of B, ``(n, depth - 1)``
        :return: ``(n, n_terms, n_in_use)``, for :meth:`mix_derivation`
        """
        terms = self.path_probabilities(condition_values).T.unsqueeze(1) * self._terms(inputs)
        return terms.permute(2, 1, 0).contiguous()

    def mix_derivation(self, terms: th.Tensor) -> th.Tensor:
        """Return what :meth:`mix` returns.

        :param terms: from :meth:`derivation_terms`, ``(n, n_terms, n_in_use)``
        :return: ``(n, n_outputs)``
        """
        return self._to_parameters(terms @ self.choices())

    def _terms(self, inputs: th.Tensor) -> th.Tensor:
        """Return what is mixed, ``(n_in_use, n_terms, rows)``: values, or probabilities.

        Rows come last: softmax and sums then run along contiguous memory, twice as fast as over a last axis of a few.
        """
        weight, bias, in_use = self.controllers.weight, self.controllers.bias, self.controllers_in_use
        if len(in_use) < self.n_controllers:
            rows = th.tensor(in_use, device=weight.device)
            weight, bias = (
                block.unflatten(0, (self.n_controllers, -1))[rows].flatten(0, 1) for block in (weight, bias)
            )
        outputs = th.addmm(bias.unsqueeze(1), weight, inputs.flatten(0, -2).T)
        outputs = outputs.unflatten(0, (len(in_use), self.action.n_outputs))
        if self.action.kind == "box":
            return outputs
        if self.action.kind == "multi_binary":
            return th.cat((th.sigmoid(outputs), th.sigmoid(-outputs)), dim=1)
        if self.action.kind == "discrete":
            return outputs.softmax(1)
        return th.cat([component.softmax(1) for component in outputs.split(list(self.action.sizes), dim=1)], dim=1)

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
        ).to(self.controllers.weight.device)
        module.conditions = self.conditions.keep(n_conditions).to(self.controllers.weight.device)
        # In the new graph only the deepest program is drawn, so only its controllers need values.
        rows = self._controller_rows(n_conditions)
        with th.no_grad():
            module.controllers.weight.zero_()
            module.controllers.bias.zero_()
            targets = module._controller_rows(n_conditions)
            for name in ("weight", "bias"):
                blocks = self.controllers.get_parameter(name).unflatten(0, (self.n_controllers, -1))
                module.controllers.get_parameter(name).unflatten(0, (module.n_controllers, -1))[targets] = blocks[rows]
        module.search.select(n_conditions)
        return module

    def to_syntax(self, n_conditions: int | None = None) -> Expression:
        """Return one program of the graph as plain data.

        :param n_conditions: which program; the most likely one under W if ``None``
        """
        n_conditions = self.search.most_likely() if n_conditions is None else n_conditions
        weights = self.controllers.weight.unflatten(0, (self.n_controllers, -1))
        biases = self.controllers.bias.unflatten(0, (self.n_controllers, -1))
        *then, last = (
            Controller(_matrix(weights[row]), _vector(biases[row])) for row in self._controller_rows(n_conditions)
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


def _vector(values: th.Tensor) -> tuple[float, ...]:
    return tuple(values.detach().tolist())


def _matrix(values: th.Tensor) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in values.detach().tolist())
