"""One step of each recurrent cell in NumPy, with the equations and the gate order of PyTorch; and of the switch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.programs.syntax import Cell

Array = NDArray[Any]
Tanh = Callable[[Any], Any]


def sigmoid(x: Array, tanh: Tanh = np.tanh) -> Array:
    """Return the logistic function, by way of tanh, which cannot overflow."""
    return cast(Array, 0.5 * tanh(0.5 * x) + 0.5)


def rnn_step(gates: Array, recurrent: Array, hidden: Array, cell: Array, tanh: Tanh = np.tanh) -> tuple[Array, Array]:
    """Advance a tanh cell. See :data:`STEPS`."""
    return tanh(gates + recurrent), cell


def gru_step(gates: Array, recurrent: Array, hidden: Array, cell: Array, tanh: Tanh = np.tanh) -> tuple[Array, Array]:
    """Advance a GRU cell. See :data:`STEPS`."""
    units = hidden.shape[-1]
    both = sigmoid(gates[..., : 2 * units] + recurrent[..., : 2 * units], tanh)
    new = tanh(gates[..., 2 * units :] + both[..., :units] * recurrent[..., 2 * units :])
    return new + both[..., units:] * (hidden - new), cell


def lstm_step(gates: Array, recurrent: Array, hidden: Array, cell: Array, tanh: Tanh = np.tanh) -> tuple[Array, Array]:
    """Advance an LSTM cell. See :data:`STEPS`."""
    units = hidden.shape[-1]
    total = gates + recurrent
    i, f, o = (sigmoid(total[..., k * units : (k + 1) * units], tanh) for k in (0, 1, 3))
    cell = f * cell + i * tanh(total[..., 2 * units : 3 * units])
    return o * tanh(cell), cell


def switch_step(
    gates: Array, recurrent: Array, hidden: Array, cell: Array, tanh: Tanh = np.tanh
) -> tuple[Array, Array]:
    """Advance a switch: on, off or as it was. See :data:`STEPS`."""
    units = hidden.shape[-1]
    total = gates + recurrent
    on, off = total[..., :units] >= 0, total[..., units:] >= 0
    return np.where(on, 1.0, np.where(off, 0.0, hidden)), cell


#: Cell name to its step: ``step(W_ih x + b_ih, W_hh h + b_hh, h, c, tanh) -> (h, c)``, arrays ``(..., width)``.
STEPS: dict[Cell, Callable[..., tuple[Array, Array]]] = {
    "rnn": rnn_step,
    "gru": gru_step,
    "lstm": lstm_step,
    "switch": switch_step,
}
