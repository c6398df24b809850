"""Where a student gets nowhere: it stands still, or comes back again and again to where it was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Visits of the same state in an episode that make a stall.
VISITS = 3
_GIVEN_UP = 10  # visits of the same state after which nothing else is expected
_NEAR = 0.05  # in standard deviations: inputs that differ by no more, all of them, are those of the same state
_EQUAL = 5e-4  # the same in the inputs' own units, as long as their deviations are not known


class Stalls:
    """Counts how often each of some environments has been in its present state in this episode.

    States are the same if the environment's ``state`` is; where it has none, if no input differs by more than a
    twentieth of its standard deviation. What moves along a cycle and drifts a little is found so, too.

    :param n_envs: number of environments
    """

    def __init__(self, n_envs: int) -> None:
        #: Standard deviations of the inputs, ``(n_inputs,)``; ``None`` as long as they are not known, when only inputs
        #: that are equal to three digits are the same.
        self.deviations: NDArray[np.floating] | None = None
        self._states: list[dict[str, int]] = [{} for _ in range(n_envs)]
        self._past: list[NDArray[np.float32]] = [np.zeros((0, 0), np.float32) for _ in range(n_envs)]
        self._lengths = [0] * n_envs

    def forget(self, row: int) -> None:
        """Begin an episode."""
        self._states[row], self._lengths[row] = {}, 0

    def forget_all(self) -> None:
        """Begin episodes in all environments."""
        for row in range(len(self._past)):
            self.forget(row)

    def visits(self, envs: Sequence[Any], inputs: NDArray[np.float32]) -> NDArray[np.intp]:
        """Take in the present states; return how often each was visited, this time included, ``(n_envs,)``.

        :param envs: the environments
        :param inputs: what a student reads, ``(n_envs, n_inputs)``
        """
        return np.array([self.visit(row, env, now) for row, (env, now) in enumerate(zip(envs, inputs, strict=True))])

    def visit(self, row: int, env: Any, now: NDArray[np.float32]) -> int:
        """Take in the present state of one environment; return how often it was visited, this time included.

        :param row: of the environment
        :param env: the environment
        :param now: what a student reads, ``(n_inputs,)``
        """
        state = getattr(env.unwrapped, "state", None)
        if isinstance(state, Mapping):
            key, seen = repr(state), self._states[row]
            seen[key] = seen.get(key, 0) + 1
            return seen[key]
        past = self._with_room(row, len(now))
        past[self._lengths[row]] = now
        self._lengths[row] += 1
        near = _EQUAL if self.deviations is None else _NEAR * self.deviations
        return int((np.abs(past[: self._lengths[row]] - now) <= near).all(axis=1).sum())

    def _with_room(self, row: int, n_inputs: int) -> NDArray[np.float32]:
        """Return the past of an environment, twice as long where it was full."""
        past, length = self._past[row], self._lengths[row]
        if length == len(past) or past.shape[1] != n_inputs:
            longer = np.empty((max(64, 2 * length), n_inputs), dtype=np.float32)
            if length:
                longer[:length] = past[:length]
            self._past[row] = past = longer
        return past


class Patience:
    """Gives up episodes with a goal that take far too long, or come back to the same state too often.

    :param n_envs: number of environments
    :param limit: steps after which an episode is given up
    """

    def __init__(self, n_envs: int, limit: int) -> None:
        self.limit, self.stalls = limit, Stalls(n_envs)

    def begin(self) -> None:
        """Begin episodes in all environments."""
        self.stalls.forget_all()

    def ends(self, row: int, env: Any, now: NDArray[np.float32], n_steps: int) -> bool:
        """Return whether an episode is given up in its present state.

        :param row: of the environment
        :param env: the environment
        :param now: its observation
        :param n_steps: taken so far
        """
        return n_steps >= self.limit or self.stalls.visit(row, env, now) > _GIVEN_UP
