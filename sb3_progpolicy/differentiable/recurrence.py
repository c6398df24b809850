"""GRU and tanh cells over a whole sequence on the CPU, for layers of a few units.

A program's conditions have a handful of hidden units. At that size torch's kernels for these two cells spend their
time in bookkeeping, once per step and operation, forwards and again backwards (its LSTM has a fused kernel and does
not). Here the steps run over NumPy views of the tensors, with the derivatives written out, about four times as fast
(``benchmarks/recurrence.py``). Equations and gate order are those of ``torch.nn.RNN`` and ``torch.nn.GRU``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch.autograd.function import FunctionCtx, once_differentiable

from sb3_progpolicy.programs.syntax import Cell

Array = NDArray[np.floating]
Tape = tuple[Array, ...]


def scan(kind: Cell, gates: th.Tensor, weight_hh: th.Tensor, bias_hh: th.Tensor, hidden: th.Tensor) -> th.Tensor:
    """Run a recurrent layer over a sequence; differentiable in all tensors.

    :param kind: ``"rnn"`` or ``"gru"``
    :param gates: ``W_ih x + b_ih``, ``(n_steps, n_sequences, n_gates * hidden_size)``, on the CPU
    :param weight_hh: ``(n_gates * hidden_size, hidden_size)``
    :param bias_hh: ``(n_gates * hidden_size,)``
    :param hidden: initial state ``(n_sequences, hidden_size)``
    :return: hidden states of all steps ``(n_steps, n_sequences, hidden_size)``
    """
    # Only in a GRU the hidden bias stands inside a gate and cannot be added beforehand.
    gates, bias = (gates, bias_hh) if kind == "gru" else (gates + bias_hh, th.zeros_like(bias_hh))
    return cast(th.Tensor, _Scan.apply(kind, gates, weight_hh, bias, hidden))


class _Scan(th.autograd.Function):
    """Units come before sequences inside, so that each gate of a step is one contiguous block."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, kind: Cell, gates: th.Tensor, weight: th.Tensor, bias: th.Tensor, hidden: th.Tensor
    ) -> th.Tensor:
        context = cast(Any, ctx)
        by_unit = np.ascontiguousarray(gates.detach().numpy().swapaxes(1, 2))
        # A copy: the optimizer steps the weights in place.
        context.kind, context.weight = kind, weight.detach().numpy().copy()
        context.states, context.tape = _FORWARD[kind](
            by_unit, context.weight, bias.detach().numpy()[:, None], hidden.detach().numpy().T
        )
        return th.from_numpy(np.ascontiguousarray(context.states[1:].swapaxes(1, 2)))

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, d_outputs: th.Tensor) -> tuple[th.Tensor | None, ...]:
        context = cast(Any, ctx)
        d_states = np.ascontiguousarray(d_outputs.numpy().swapaxes(1, 2))
        d_gates, d_recurrent, d_hidden = _BACKWARD[context.kind](d_states, context.weight.T.copy(), *context.tape)
        d_weight = np.tensordot(d_recurrent, context.states[:-1], axes=((0, 2), (0, 2)))
        d_bias = d_recurrent.sum((0, 2))
        d_inputs = np.ascontiguousarray(d_gates.swapaxes(1, 2))
        gradients = (d_inputs, d_weight, d_bias, np.ascontiguousarray(d_hidden.T))
        return None, *map(th.from_numpy, gradients)


def _rnn_forward(gates: Array, weight: Array, bias: Array, hidden: Array) -> tuple[Array, Tape]:
    states = np.empty((len(gates) + 1, *hidden.shape), gates.dtype)
    states[0] = hidden
    for gate, before, after in zip(gates, states[:-1], states[1:], strict=True):
        np.matmul(weight, before, out=after)
        after += gate
        np.tanh(after, out=after)
    return states, (1 - states[1:] ** 2,)


def _rnn_backward(d_states: Array, weight: Array, slope: Array) -> tuple[Array, Array, Array]:
    d_gates = np.empty_like(slope)
    d_hidden = np.zeros_like(d_states[0])
    for t in reversed(range(len(slope))):
        d_hidden += d_states[t]
        np.multiply(d_hidden, slope[t], out=d_gates[t])
        np.matmul(weight, d_gates[t], out=d_hidden)
    return d_gates, d_gates, d_hidden


def _gru_forward(gates: Array, weight: Array, bias: Array, hidden: Array) -> tuple[Array, Tape]:
    n_steps, width, n_sequences = gates.shape
    units = width // 3
    # A last row of ones below the states multiplies the bias, so that one product does all that is recurrent.
    states = np.ones((n_steps + 1, units + 1, n_sequences), gates.dtype)
    states[0, :units] = hidden
    # 2 sigmoid(x) = tanh(x / 2) + 1: the halves go into the weights, that of the reset gate into what it multiplies.
    weight = 0.5 * np.concatenate((weight, bias), axis=1)
    gates_both = 0.5 * gates[:, : 2 * units]
    recurrent = np.empty((n_steps, width, n_sequences), gates.dtype)
    reset_update = np.empty((n_steps, 2 * units, n_sequences), gates.dtype)
    new = np.empty((n_steps, units, n_sequences), gates.dtype)
    rows = zip(
        gates_both,
        gates[:, 2 * units :],
        recurrent,
        recurrent[:, : 2 * units],
        recurrent[:, 2 * units :],
        reset_update,
        reset_update[:, :units],
        reset_update[:, units:],
        new,
        states[:-1],
        states[:-1, :units],
        states[1:, :units],
        strict=True,
    )
    for gate, gate_new, product, to_gates, to_new, both, reset, update, candidate, before_one, before, after in rows:
        np.matmul(weight, before_one, out=product)
        np.add(to_gates, gate, out=both)
        np.tanh(both, out=both)
        both += 1
        np.multiply(reset, to_new, out=candidate)
        candidate += gate_new
        np.tanh(candidate, out=candidate)
        np.subtract(before, candidate, out=after)
        after *= update
        after *= 0.5
        after += candidate
    reset_update *= 0.5
    states = states[:, :units]
    return states, (states, reset_update, new, 2 * recurrent[:, 2 * units :])


def _gru_backward(
    d_states: Array, weight: Array, states: Array, reset_update: Array, new: Array, inner: Array
) -> tuple[Array, Array, Array]:
    units = new.shape[1]
    reset, update = reset_update[:, :units], reset_update[:, units:]
    # Derivatives of each step that do not depend on the steps after it, for all steps at once.
    by_new = (1 - update) * (1 - new**2)
    by_update = (states[:-1] - new) * update * (1 - update)
    by_reset = inner * reset * (1 - reset)
    # What the step's candidate and gates pass on, per unit of d_hidden: by_new[t] times these three.
    by_hidden = np.concatenate((by_new * by_reset, by_update, by_new * reset), axis=1)
    by_hidden = by_hidden.reshape(len(new), 3, units, -1)
    d_recurrent = np.empty_like(by_hidden)
    flat = d_recurrent.reshape(len(new), 3 * units, -1)
    d_hiddens = np.empty_like(new)
    d_hidden = np.zeros_like(new[0])
    through = np.empty_like(d_hidden)
    rows = zip(
        d_states[::-1], d_hiddens[::-1], by_hidden[::-1], d_recurrent[::-1], flat[::-1], update[::-1], strict=True
    )
    for d_state, d_total, factors, row, flat_row, kept in rows:
        np.add(d_hidden, d_state, out=d_total)
        np.multiply(d_total, factors, out=row)
        np.matmul(weight, flat_row, out=d_hidden)
        np.multiply(d_total, kept, out=through)
        d_hidden += through
    d_gates = flat.copy()
    np.multiply(d_hiddens, by_new, out=d_gates[:, 2 * units :])
    return d_gates, flat, d_hidden


_FORWARD: dict[Cell, Callable[[Array, Array, Array, Array], tuple[Array, Tape]]] = {
    "rnn": _rnn_forward,
    "gru": _gru_forward,
}
_BACKWARD: dict[Cell, Callable[..., tuple[Array, Array, Array]]] = {"rnn": _rnn_backward, "gru": _gru_backward}
