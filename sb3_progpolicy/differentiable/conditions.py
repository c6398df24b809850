"""The conditions of a program: all of them in one recurrent layer, or in one affine layer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch as th
from torch import nn

from sb3_progpolicy.differentiable.recurrence import scan
from sb3_progpolicy.programs.syntax import GATES, STATELESS, Cell, Condition

State = tuple[th.Tensor, th.Tensor]

_LAYERS: dict[Cell, Callable[[int, int], nn.RNNBase]] = {"rnn": nn.RNN, "gru": nn.GRU, "lstm": nn.LSTM}
_OF_INPUTS = ("rnn.weight_ih_l0", "affine.weight")
CELLS: tuple[Cell, ...] = (*STATELESS, *_LAYERS)


class Conditions(nn.Module):
    """All conditions ``B_1 ... B_K`` of a program in one layer.

    The recurrent matrix is block-diagonal: entries between the units of different conditions are zero and get no
    gradient, so that each condition has a state of its own while one fused kernel computes them all.

    The module is called like ``torch.nn.LSTM`` whatever the cell, so that sb3-contrib's sequence handling can run
    it; cells without a second state pass it through.

    :param n_inputs: length of X
    :param n_conditions: K, 0 or more
    :param cell: ``"gru"``, ``"lstm"``, ``"rnn"``, or for conditions without a state ``"affine"`` or ``"min"``
    :param size: hidden units per condition, or affine sums of a ``"min"``, at least 1
    :param projection: ``(n_inputs, n_inputs)``, applied to X first, such as the mean over a group of symmetries, which
        makes every condition the same for all members; ``None`` for none
    """

    num_layers = 1

    def __init__(
        self, n_inputs: int, n_conditions: int, cell: Cell = "gru", size: int = 1, projection: th.Tensor | None = None
    ) -> None:
        super().__init__()
        self.projection: th.Tensor | None
        self.register_buffer("projection", projection, persistent=False)
        if cell not in CELLS:
            raise ValueError(f"cell={cell!r} is not accepted; known cells: {', '.join(CELLS)}")
        if size < 1:
            raise ValueError(f"condition size {size} is not accepted; it is at least 1")
        self.input_size, self.n_conditions, self.cell, self.size = n_inputs, n_conditions, cell, size
        self.recurrent = cell not in STATELESS and n_conditions > 0
        # SB3 keeps states as arrays of this width; it cannot be 0.
        self.hidden_size = n_conditions * size if self.recurrent else 1
        if self.recurrent:
            self.rnn = _LAYERS[cell](n_inputs, self.hidden_size)
            self._make_block_diagonal()
            self.readout = nn.Parameter(th.ones(n_conditions, size) / size**0.5)
            self.readout_bias = nn.Parameter(th.zeros(n_conditions))
        elif n_conditions:
            self.affine = nn.Linear(n_inputs, n_conditions * self.n_sums)

    @property
    def n_sums(self) -> int:
        """Affine sums of a condition without a state."""
        return self.size if self.cell == "min" else 1

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
        if self.projection is not None:
            inputs = inputs @ self.projection
        if not self.recurrent:
            sums = self.affine(inputs)
            return sums if self.n_sums == 1 else sums.unflatten(-1, (self.n_conditions, self.n_sums)).amin(-1), state
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

    @property
    def input_weight(self) -> th.Tensor:
        """The weights of X, with the projection: ``(n_gates * hidden_size or n_conditions * n_sums, n_inputs)``."""
        weight = cast(th.Tensor, self.rnn.weight_ih_l0 if self.recurrent else self.affine.weight)
        return weight if self.projection is None else weight @ self.projection

    def to_syntax(self, k: int) -> Condition:
        """Return condition ``k`` (0-based) as plain data, of sums that are equal only one."""
        if not self.recurrent:
            own = slice(k * self.n_sums, (k + 1) * self.n_sums)
            rows = dict.fromkeys(zip(vector(self.affine.bias[own]), matrix(self.input_weight[own]), strict=True))
            constants, weights = zip(*rows, strict=True)
            if len(rows) == 1:
                return Condition("affine", (), (), (), (), weights[0], constants[0])
            return Condition("min", weights, (), constants, (), (), 0.0)
        n_gates = len(GATES[self.cell])
        units = slice(k * self.size, (k + 1) * self.size)

        def gates(parameter: th.Tensor | nn.Module) -> th.Tensor:
            return cast(th.Tensor, parameter).unflatten(0, (n_gates, self.hidden_size))[:, units].flatten(0, 1)

        return Condition(
            cell=self.cell,
            weight_ih=matrix(gates(self.input_weight)),
            weight_hh=matrix(gates(self.rnn.weight_hh_l0)[:, units]),
            bias_ih=vector(gates(self.rnn.bias_ih_l0)),
            bias_hh=vector(gates(self.rnn.bias_hh_l0)),
            readout=vector(self.readout[k]),
            readout_bias=self.readout_bias[k].item(),
        )

    def keep(self, n_conditions: int) -> Conditions:
        """Return a module of the first ``n_conditions`` conditions alone, with copies of their parameters.

        A projection is then in the weights.
        """
        kept = Conditions(self.input_size, n_conditions, self.cell, self.size)
        units = slice(0, n_conditions * self.size)
        with th.no_grad():
            for name, parameter in kept.named_parameters():
                source: th.Tensor = self.input_weight if name in _OF_INPUTS else self.get_parameter(name)
                if name.startswith("rnn."):
                    source = source.unflatten(0, (len(GATES[self.cell]), self.hidden_size))[:, units].flatten(0, 1)
                    source = source[:, units] if name == "rnn.weight_hh_l0" else source
                else:
                    source = source[: len(parameter)]
                parameter.copy_(source)
        return kept


def vector(values: th.Tensor) -> tuple[float, ...]:
    """Return a vector as plain data."""
    return tuple(values.detach().tolist())


def matrix(values: th.Tensor) -> tuple[tuple[float, ...], ...]:
    """Return a matrix as plain data."""
    return tuple(tuple(row) for row in values.detach().tolist())
