"""Run a program with NumPy, for one or many environments at once.

Sums are taken term by term in the order of X and ``tanh`` is the C library's, so that an action never depends on the
batch size or on a BLAS, and the file written by :func:`~sb3_progpolicy.programs.export.export_python` computes the
same bits.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_progpolicy.programs.syntax import GATES, ActionSpec, Condition, Program
from sb3_progpolicy.programs.validation import check_program

Floats = NDArray[np.float64]
Semantics = Literal["crisp", "soft"]


def join_inputs(
    program: Program,
    observation: ArrayLike,
    previous_action: ArrayLike | None = None,
    previous_reward: ArrayLike = 0.0,
    previous_done: ArrayLike = False,
) -> Floats:
    """Build the input X of section 2.4 from the last interaction with the environment.

    The order is observation, previous action, previous reward, previous done flag. Without ``program.interaction``,
    X is the observation alone and the rest is ignored.

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
        inputs[:, program.n_observations : -2] = _encode_actions(program.action, previous_action, n_envs)
    for column, name, value in ((-2, "previous_reward", previous_reward), (-1, "previous_done", previous_done)):
        if np.shape(value) not in ((), (n_envs,)):
            raise ValueError(f"{name} has the shape {np.shape(value)}; ({n_envs},) or one value is accepted")
        inputs[:, column] = np.asarray(value, dtype=np.float64)
    return inputs


def _encode_actions(action: ActionSpec, given: ArrayLike, n_envs: int) -> Floats:
    width = (
        1 if action.kind == "discrete" else len(action.sizes) if action.kind == "multi_discrete" else action.sizes[0]
    )
    actions = np.asarray(given)
    if actions.size != n_envs * width:
        raise ValueError(
            f"previous_action has the shape {actions.shape}; {width} number(s) for each of {n_envs} environments "
            "are accepted"
        )
    actions = actions.reshape(n_envs, width)
    if action.kind in ("box", "multi_binary"):
        return actions.astype(np.float64)
    indices = actions.astype(np.int64) - action.start
    if np.any(indices != actions - action.start) or np.any(indices < 0) or np.any(indices >= action.sizes):
        raise ValueError(
            f"previous_action={actions.tolist()} is not accepted; actions are whole numbers from {action.start}, "
            f"fewer than {list(action.sizes)} of them"
        )
    encoded = np.zeros((n_envs, action.history_size))
    first = np.cumsum((0, *action.sizes[:-1]))
    encoded[np.arange(n_envs)[:, None], first + indices] = 1
    return encoded


class ProgramRunner:
    """A program with its memory, for ``n_envs`` environments stepped together.

    :param program: what to run
    :param n_envs: number of rows of the inputs
    :param semantics: ``"crisp"`` runs a real if-then-else on ``B >= 0``; ``"soft"`` mixes the controllers with the
        masses ``s_k * prod_{j<k}(1 - s_j)``, ``s = sigmoid(B / temperature)``, as in training
    :raises ValueError: if the program is not well formed or an argument is not accepted

    Conditions are numbered from the outermost inwards, and every one reads X at every step, reached or not: its
    memory must not depend on the branch taken. Memory is kept until :meth:`reset`, across ends of episodes.
    """

    def __init__(self, program: Program, n_envs: int = 1, semantics: Semantics = "crisp") -> None:
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
        self._constant, *self._columns = np.concatenate(blocks).T.copy()
        self.reset()

    def reset(self) -> None:
        """Zero the memory of all conditions. Do so when the task changes, and not when an episode ends."""
        for cell in self._cells:
            cell.reset()
        self._condition_values = np.zeros((self.n_envs, len(self._cells)))

    @property
    def condition_values(self) -> Floats:
        """The B of every condition at the last step, ``(n_envs, n_conditions)``; zeros before the first."""
        return self._condition_values

    @property
    def branch(self) -> NDArray[np.int64]:
        """Index of the controller reached at the last step, ``(n_envs,)``: the first whose B is not below 0."""
        reached = np.column_stack([self._condition_values >= 0, np.ones(self.n_envs, dtype=bool)])
        return reached.argmax(axis=1)

    @property
    def masses(self) -> Floats:
        """Weight of every controller at the last step, ``(n_envs, n_controllers)``, summing to 1 for each row."""
        if self.semantics == "crisp":
            return np.eye(self._n_controllers)[self.branch]
        masses, rest = np.empty((self.n_envs, self._n_controllers)), np.ones(self.n_envs)
        for index, value in enumerate(self._condition_values.T):
            chosen = sigmoid(value / self.program.temperature)
            masses[:, index] = rest * chosen
            rest = rest * (1 - chosen)
        masses[:, -1] = rest
        return masses

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
        outputs = controllers.reshape(self.n_envs, self._n_controllers, -1)
        return self._choose(outputs)

    def _choose(self, outputs: Floats) -> NDArray[Any]:
        action = self.program.action
        if self.semantics == "crisp":
            taken = outputs[np.arange(self.n_envs), self.branch]
            threshold = 0.0
        else:
            taken = np.einsum("nk,nko->no", self.masses, _distribution(action, outputs))
            threshold = 0.5
        if action.kind == "box":
            return np.clip(taken, action.low, action.high).astype(np.float32)
        if action.kind == "multi_binary":
            return (taken > threshold).astype(np.int8)
        chosen = [part.argmax(axis=1) for part in np.split(taken, np.cumsum(action.sizes)[:-1], axis=1)]
        return chosen[0] + action.start if action.kind == "discrete" else np.column_stack(chosen)


class _Cell:
    """One condition: PyTorch's RNN (tanh), GRU or LSTM cell with a readout, in float64."""

    def __init__(self, condition: Condition, n_envs: int) -> None:
        self.cell, self.size, self.n_envs = condition.cell, condition.hidden_size, n_envs
        self.readout_bias, self.readout = np.array(condition.readout_bias), np.array(condition.readout)
        if self.cell == "affine":
            self.rows = np.concatenate([self.readout_bias[None], self.readout])[None]
            return
        constant, hidden = np.array(condition.bias_ih), np.array(condition.bias_hh)
        # Only the GRU's candidate keeps its two biases apart: r scales W_hn h + b_hn and nothing else.
        shared = slice(0, 2 * self.size) if self.cell == "gru" else slice(None)
        constant[shared] += hidden[shared]
        hidden[shared] = 0
        self.rows = np.column_stack([constant, np.array(condition.weight_ih).reshape(len(constant), -1)])
        self.hidden_bias, self.hidden_columns = hidden, list(np.array(condition.weight_hh).T.copy())

    def reset(self) -> None:
        self.h = np.zeros((self.n_envs, self.size))
        self.c = np.zeros((self.n_envs, self.size))

    def step(self, gates: Floats) -> Floats:
        """Advance the state by the gates' share of X ``(n_envs, n_rows)`` and return B ``(n_envs,)``."""
        if self.cell == "affine":
            return gates[:, 0]
        if self.cell == "gru":
            both = _accumulate(gates[:, : -self.size], [column[: -self.size] for column in self.hidden_columns], self.h)
            candidate = _accumulate(
                self.hidden_bias[-self.size :], [column[-self.size :] for column in self.hidden_columns], self.h
            )
            r, z = np.split(sigmoid(both), 2, axis=1)
            n = _tanh(gates[:, -self.size :] + r * candidate)
            self.h = (1 - z) * n + z * self.h
        else:
            total = _accumulate(gates, self.hidden_columns, self.h)
            if self.cell == "rnn":
                self.h = _tanh(total)
            else:
                i, f, g, o = np.split(total, len(GATES["lstm"]), axis=1)
                self.c = sigmoid(f) * self.c + sigmoid(i) * _tanh(g)
                self.h = sigmoid(o) * _tanh(self.c)
        return _accumulate(self.readout_bias[None], list(self.readout[:, None]), self.h)[:, 0]


def _accumulate(constant: Floats, columns: list[Floats], values: Floats) -> Floats:
    """``constant + sum_j columns[j] * values[:, j]``, added from left to right."""
    total = np.array(np.broadcast_to(constant, (len(values), constant.shape[-1])))
    for index, column in enumerate(columns):
        total += column * values[:, index, None]
    return total


def _tanh(values: Floats) -> Floats:
    # NumPy's own tanh may differ from the C library's in the last bit, which a chaotic recurrence would amplify.
    return np.array([math.tanh(value) for value in values.ravel().tolist()]).reshape(values.shape)


def sigmoid(values: Floats) -> Floats:
    """The logistic function, by way of tanh, which cannot overflow."""
    return 0.5 + 0.5 * _tanh(0.5 * values)


def _distribution(action: ActionSpec, outputs: Floats) -> Floats:
    """What the soft semantics mixes: probabilities of discrete actions, the outputs themselves for a Box."""
    if action.kind == "box":
        return outputs
    if action.kind == "multi_binary":
        return sigmoid(outputs)
    parts = []
    for part in np.split(outputs, np.cumsum(action.sizes)[:-1], axis=2):
        weights = np.exp(part - part.max(axis=2, keepdims=True))
        parts.append(weights / weights.sum(axis=2, keepdims=True))
    return np.concatenate(parts, axis=2)
