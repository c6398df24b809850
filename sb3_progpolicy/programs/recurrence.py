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
    """Run a recurrent layer over a sequence; differentiable in all but the initial state.

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
    @staticmethod
    def forward(
        ctx: FunctionCtx,
        kind: Cell,
        gates: th.Tensor,
        weight: th.Tensor,
        bias: th.Tensor,
        hidden: th.Tensor,
    ) -> th.Tensor:
        context = cast(Any, ctx)
        arrays = [tensor.detach().numpy() for tensor in (gates, weight, bias, hidden)]
        states, tape = _FORWARD[kind](*arrays)
        # A copy: the optimizer steps the weights in place.
        context.kind, context.tape, context.states, context.weight = kind, tape, states, arrays[1].copy()
        return th.from_numpy(states[1:])

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, d_outputs: th.Tensor) -> tuple[th.Tensor | None, ...]:
        context = cast(Any, ctx)
        backward: Callable[..., tuple[Array, Array]] = _BACKWARD[context.kind]
        d_gates, d_recurrent = backward(d_outputs.contiguous().numpy(), context.weight, *context.tape)
        flat = d_recurrent.reshape(-1, d_recurrent.shape[-1])
        previous = context.states[:-1].reshape(len(flat), -1)
        return None, th.from_numpy(d_gates), th.from_numpy(flat.T @ previous), th.from_numpy(flat.sum(0)), None


def _rnn_forward(gates: Array, weight: Array, bias: Array, hidden: Array) -> tuple[Array, Tape]:
    states = np.empty((len(gates) + 1, *hidden.shape), gates.dtype)
    states[0], weight = hidden, np.ascontiguousarray(weight.T)
    for t, gate in enumerate(gates):
        np.tanh(gate + states[t] @ weight, out=states[t + 1])
    return states, (1 - states[1:] ** 2,)


def _rnn_backward(d_outputs: Array, weight: Array, slope: Array) -> tuple[Array, Array]:
    d_gates = np.empty_like(slope)
    d_hidden = np.zeros_like(d_outputs[0])
    for t in reversed(range(len(slope))):
        np.multiply(d_hidden + d_outputs[t], slope[t], out=d_gates[t])
        d_hidden = d_gates[t] @ weight
    return d_gates, d_gates


def _gru_forward(gates: Array, weight: Array, bias: Array, hidden: Array) -> tuple[Array, Tape]:
    n_steps, n_sequences, width = gates.shape
    units = width // 3
    states = np.empty((n_steps + 1, n_sequences, units), gates.dtype)
    reset_update = np.empty((n_steps, n_sequences, 2 * units), gates.dtype)
    new = np.empty((n_steps, n_sequences, units), gates.dtype)
    inner = np.empty((n_steps, n_sequences, units), gates.dtype)
    states[0], weight = hidden, np.ascontiguousarray(weight.T)
    half = 0.5 * gates[..., : 2 * units]
    for t in range(n_steps):
        recurrent = states[t] @ weight
        recurrent += bias
        both = reset_update[t]
        np.multiply(recurrent[:, : 2 * units], 0.5, out=both)
        both += half[t]
        np.tanh(both, out=both)
        both *= 0.5
        both += 0.5
        inner[t] = recurrent[:, 2 * units :]
        candidate = new[t]
        np.multiply(both[:, :units], inner[t], out=candidate)
        candidate += gates[t, :, 2 * units :]
        np.tanh(candidate, out=candidate)
        following = states[t + 1]
        np.subtract(states[t], candidate, out=following)
        following *= both[:, units:]
        following += candidate
    return states, (states, reset_update, new, inner)


def _gru_backward(
    d_outputs: Array, weight: Array, states: Array, reset_update: Array, new: Array, inner: Array
) -> tuple[Array, Array]:
    units = new.shape[-1]
    reset, update = reset_update[..., :units], reset_update[..., units:]
    # Derivatives of each step that do not depend on the steps after it, for all steps at once.
    by_new = (1 - update) * (1 - new**2)
    by_update = (states[:-1] - new) * update * (1 - update)
    by_reset = inner * reset * (1 - reset)
    update = np.ascontiguousarray(update)
    d_gates = np.empty((*new.shape[:-1], 3 * units), new.dtype)
    d_recurrent = np.empty_like(d_gates)
    d_hidden = np.zeros_like(new[0])
    for t in reversed(range(len(new))):
        d_hidden += d_outputs[t]
        row = d_recurrent[t]
        d_new = d_hidden * by_new[t]
        np.multiply(d_new, by_reset[t], out=row[:, :units])
        np.multiply(d_hidden, by_update[t], out=row[:, units : 2 * units])
        np.multiply(d_new, reset[t], out=row[:, 2 * units :])
        d_gates[t, :, 2 * units :] = d_new
        d_hidden *= update[t]
        d_hidden += row @ weight
    d_gates[..., : 2 * units] = d_recurrent[..., : 2 * units]
    return d_gates, d_recurrent


_FORWARD: dict[Cell, Callable[..., tuple[Array, Tape]]] = {
    "rnn": _rnn_forward,
    "gru": _gru_forward,
}
_BACKWARD: dict[Cell, Callable[..., tuple[Array, Array]]] = {
    "rnn": _rnn_backward,
    "gru": _gru_backward,
}
