"""Run a program with NumPy, for one or many environments at once.

Sums are taken term by term in the order of X and ``tanh`` is the C library's, so that an action never depends on the
batch size or on a BLAS, and the file written by :func:`~sb3_progpolicy.programs.export.export_python` computes the
same bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import deprecated

from sb3_progpolicy.programs.cells import STEPS, sigmoid
from sb3_progpolicy.programs.syntax import Condition, ProgramData
from sb3_progpolicy.programs.validation import check_program
from sb3_progpolicy.spaces import ActionSpec, encode_actions

Floats = NDArray[np.float64]
Semantics = Literal["crisp", "soft"]


def join_inputs(
    program: ProgramData,
    observation: ArrayLike,
    previous_action: ArrayLike | None = None,
    previous_reward: ArrayLike = 0.0,
    previous_done: ArrayLike = False,
) -> Floats:
    """Build the input X of section 2.4 from the last interaction with the environment.

    The order is observation, previous action, previous reward, previous done flag. Without ``program.interaction``,
    X is the observation alone and the rest is ignored. Rewards and Box actions are rounded to ``float32``, as they are
    in training.

    :param program: the program that will read X
    :param observation: ``(n_envs, n_observations)``, or ``(n_observations,)`` for one environment
    :param previous_action: one action for each environment: whole numbers ``(n_envs,)`` for Discrete,
        ``(n_envs, n)`` for MultiDiscrete, MultiBinary and Box; ``None`` before the first action, which reads as zeros
    :param previous_reward: ``(n_envs,)`` or one number for all
    :param previous_done: ``(n_envs,)`` or one flag for all
    :return: X, ``(n_envs, n_inputs)``
    :raises ValueError: if a shape does not fit or an action is not in the action space
    """
    observations = np.atleast_2d(np.asarray(observation, dtype=np.float64))
    if observations.ndim != 2 or observations.shape[1] != program.n_observations:
        raise ValueError(
            f"observation has the shape {np.shape(observation)}; (n_envs, {program.n_observations}) is accepted"
        )
    if not program.interaction:
        return observations
    n_envs = len(observations)
    inputs = np.zeros((n_envs, program.n_inputs))
    inputs[:, : program.n_observations] = observations
    if previous_action is not None:
        actions = _check_actions(program.action, previous_action, n_envs)
        inputs[:, program.n_observations : -2] = encode_actions(actions, program.action)
    for column, name, value in ((-2, "previous_reward", previous_reward), (-1, "previous_done", previous_done)):
        if np.shape(value) not in ((), (n_envs,)):
            raise ValueError(f"{name} has the shape {np.shape(value)}; ({n_envs},) or one value is accepted")
        inputs[:, column] = np.asarray(value, dtype=np.float32)
    return inputs


def _check_actions(action: ActionSpec, given: ArrayLike, n_envs: int) -> NDArray[Any]:
    """Return actions ``(n_envs, width)`` that are in the action space; Box actions beyond their bounds are accepted."""
    width = {"discrete": 1, "multi_discrete": len(action.sizes)}.get(action.kind, action.sizes[0])
    actions = np.asarray(given)
    if actions.size != n_envs * width:
        raise ValueError(
            f"previous_action has the shape {actions.shape}; {width} number(s) for each of {n_envs} environments "
            "are accepted"
        )
    actions = actions.reshape(n_envs, width)
    if action.kind in ("box", "multi_binary"):
        return actions
    numbers = actions.astype(np.int64)
    indices = numbers - action.start
    if np.any(numbers != actions) or np.any(indices < 0) or np.any(indices >= action.sizes):
        raise ValueError(
            f"previous_action={actions.tolist()} is not accepted; actions are whole numbers from {action.start}, "
            f"fewer than {list(action.sizes)} of them"
        )
    return numbers


class ProgramRunner:
    """A program with its memory, for ``n_envs`` environments stepped together.

    :param program: what to run
    :param n_envs: number of rows of the inputs
    :param semantics: ``"crisp"`` runs a real if-then-else on ``B >= 0``; ``"soft"`` mixes the controllers with the
        weights ``s_k * prod_{j<k}(1 - s_j)``, ``s = sigmoid(B / temperature)``, as in training;
        for Box actions, if the program says ``"branches"``, it runs the controller with the largest weight
    :raises ValueError: if the program is not well formed or an argument is not accepted

    Conditions are numbered from the outermost inwards, and every one reads X at every step, reached or not: its
    memory must not depend on the branch taken. Memory is kept until :meth:`reset`, across ends of episodes.
    """

    def __init__(self, program: ProgramData, n_envs: int = 1, semantics: Semantics = "crisp") -> None:
        check_program(program)
        if semantics not in ("crisp", "soft"):
            raise ValueError(f"semantics={semantics!r} is not accepted; it is 'crisp' or 'soft'")
        if n_envs < 1:
            raise ValueError(f"n_envs={n_envs} is not accepted; it is 1 or more")
        self.program, self.n_envs, self.semantics = program, n_envs, semantics
        self._cells = [_Cell(condition, n_envs) for condition in program.conditions]
        self._n_controllers = len(program.controllers)
        # One map for everything that is affine in X: the gates of all conditions, then all controllers.
        blocks = [cell.rows for cell in self._cells] + [
            np.column_stack(
                [
                    np.array(controller.bias),
                    np.array(controller.weights).reshape(len(controller.bias), program.n_inputs),
                ]
            )
            for controller in program.controllers
        ]
        self._splits = np.cumsum([len(block) for block in blocks])[: len(self._cells)]
        self._constant, *columns = np.concatenate(blocks).T.copy()
        self._columns = _nonzero(columns)
        self.reset()

    def reset(self) -> None:
        """Zero the memory of all conditions. Do so when the task changes, and not when an episode ends."""
        for cell in self._cells:
            cell.reset()
        self._condition_values = np.zeros((self.n_envs, len(self._cells)))
        self._outputs = np.zeros((self.n_envs, self._n_controllers, self.program.action.n_outputs))

    @property
    def condition_values(self) -> Floats:
        """The B of every condition at the last step, ``(n_envs, n_conditions)``; zeros before the first."""
        return self._condition_values

    @property
    def memory(self) -> tuple[Floats, ...]:
        """The hidden units of every condition now, ``(n_envs, hidden_size)`` each; no columns without memory."""
        return tuple(cell.h for cell in self._cells)

    @property
    def outputs(self) -> Floats:
        """What every controller gave at the last step, ``(n_envs, n_controllers, n_outputs)``; zeros before it."""
        return self._outputs

    @property
    def branch(self) -> NDArray[np.int64]:
        """Index of the controller reached at the last step, ``(n_envs,)``: the first whose B is not below 0."""
        reached = np.column_stack([self._condition_values >= 0, np.ones(self.n_envs, dtype=bool)])
        return reached.argmax(axis=1)

    @property
    def mixture_weights(self) -> Floats:
        """Weight of every controller at the last step, ``(n_envs, n_controllers)``, summing to 1 for each row."""
        if self.semantics == "crisp":
            return np.eye(self._n_controllers)[self.branch]
        weights, rest = np.empty((self.n_envs, self._n_controllers)), np.ones(self.n_envs)
        for index, value in enumerate(self._condition_values.T):
            chosen = sigmoid(value / self.program.temperature, _tanh)
            weights[:, index] = rest * chosen
            rest = rest * (1 - chosen)
        weights[:, -1] = rest
        return weights

    @property
    @deprecated("ProgramRunner.masses is now called mixture_weights")
    def masses(self) -> Floats:
        """The former name of :attr:`mixture_weights`."""
        return self.mixture_weights

    def act(self, inputs: ArrayLike) -> NDArray[Any]:
        """Take one step.

        :param inputs: X, ``(n_envs, n_inputs)``, as :func:`join_inputs` builds it
        :return: actions: int64 ``(n_envs,)`` for Discrete, int64 ``(n_envs, n)`` for MultiDiscrete, int8
            ``(n_envs, n)`` for MultiBinary, float32 ``(n_envs, n)`` for Box
        :raises ValueError: if the shape is another one or a number is not finite; the memory is then unchanged
        """
        x = np.asarray(inputs, dtype=np.float64)
        if x.shape != (self.n_envs, self.program.n_inputs):
            raise ValueError(f"inputs have the shape {x.shape}; {(self.n_envs, self.program.n_inputs)} is accepted")
        if not np.isfinite(x).all():
            raise ValueError("inputs hold a number that is infinite or not a number; finite numbers are accepted")
        *gates, controllers = np.split(_accumulate(self._constant, self._columns, x), self._splits, axis=1)
        for index, (cell, gate) in enumerate(zip(self._cells, gates, strict=True)):
            self._condition_values[:, index] = cell.step(gate)
        self._outputs = controllers.reshape(self.n_envs, self._n_controllers, -1)
        return self._choose(self._outputs)

    def _choose(self, outputs: Floats) -> NDArray[Any]:
        action = self.program.action
        if self.semantics == "crisp":
            taken = outputs[np.arange(self.n_envs), self.branch]
            threshold = 0.0
        elif action.kind == "box" and self.program.semantics == "branches":
            taken = outputs[np.arange(self.n_envs), self.mixture_weights.argmax(axis=1)]
        else:
            taken = np.einsum("nk,nko->no", self.mixture_weights, _distribution(action, outputs))
            threshold = 0.5
        if action.kind == "box":
            return np.clip(taken, action.low, action.high).astype(np.float32)
        if action.kind == "multi_binary":
            return (taken > threshold).astype(np.int8)
        chosen = [part.argmax(axis=1) for part in np.split(taken, np.cumsum(action.sizes)[:-1], axis=1)]
        return chosen[0] + action.start if action.kind == "discrete" else np.column_stack(chosen)


class _Cell:
    """One condition: PyTorch's RNN (tanh), GRU or LSTM cell with a readout, a switch or affine sums, in float64."""

    def __init__(self, condition: Condition, n_envs: int) -> None:
        self.cell, self.size, self.n_envs = condition.cell, condition.hidden_size, n_envs
        self.readout_bias, self.readout = np.array(condition.readout_bias), np.array(condition.readout)
        if not condition.remembers:
            self.rows = np.array([[constant, *weights] for constant, weights in condition.sums], dtype=np.float64)
            return
        constant, self.hidden_bias = np.array(condition.bias_ih), np.array(condition.bias_hh)
        # Only the GRU's candidate keeps its recurrent part apart: r scales W_hn h + b_hn and nothing else.
        apart = np.zeros(len(constant), dtype=bool)
        if self.cell == "gru":
            apart[2 * self.size :] = True
        constant[~apart] += self.hidden_bias[~apart]
        self.hidden_bias[~apart] = 0
        columns = np.array(condition.weight_hh).T
        self.joined_columns = _nonzero(np.where(apart, 0, columns))
        self.apart_columns = _nonzero(np.where(apart, columns, 0))
        self.rows = np.column_stack([constant, np.array(condition.weight_ih).reshape(len(constant), -1)])

    def reset(self) -> None:
        self.h = np.zeros((self.n_envs, self.size))
        self.c = np.zeros((self.n_envs, self.size))

    def step(self, gates: Floats) -> Floats:
        """Advance the state by the gates' share of X ``(n_envs, n_rows)`` and return B ``(n_envs,)``."""
        if self.size == 0:
            return gates[:, 0] if self.cell == "affine" else np.asarray(gates.min(axis=1))
        joined = _accumulate(gates, self.joined_columns, self.h)
        apart = _accumulate(self.hidden_bias, self.apart_columns, self.h)
        self.h, self.c = STEPS[self.cell](joined, apart, self.h, self.c, _tanh)
        return _accumulate(self.readout_bias[None], list(enumerate(self.readout[:, None])), self.h)[:, 0]


_Columns = list[tuple[int, Floats]]


def _nonzero(columns: Iterable[Floats]) -> _Columns:
    """Return the columns that are not 0 in all rows, each with its index."""
    return [(index, column) for index, column in enumerate(columns) if column.any()]


def _accumulate(constant: Floats, columns: _Columns, values: Floats) -> Floats:
    """``constant + sum_j columns[j] * values[:, j]``, added from left to right."""
    total = np.array(np.broadcast_to(constant, (len(values), constant.shape[-1])))
    for index, column in columns:
        total += column * values[:, index, None]
    return total


def _tanh(values: Floats) -> Floats:
    # NumPy's own tanh may differ from the C library's in the last bit, which a chaotic recurrence would amplify.
    return np.array([math.tanh(value) for value in values.ravel().tolist()]).reshape(values.shape)


def _distribution(action: ActionSpec, outputs: Floats) -> Floats:
    """What the soft semantics mixes: probabilities of discrete actions, the outputs themselves for a Box."""
    if action.kind == "box":
        return outputs
    if action.kind == "multi_binary":
        return sigmoid(outputs, _tanh)
    parts = []
    for part in np.split(outputs, np.cumsum(action.sizes)[:-1], axis=2):
        weights = np.exp(part - part.max(axis=2, keepdims=True))
        parts.append(weights / weights.sum(axis=2, keepdims=True))
    return np.concatenate(parts, axis=2)
