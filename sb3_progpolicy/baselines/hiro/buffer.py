"""A replay buffer of steps that remembers which goal each was made under, and so serves both levels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

Indices = NDArray[np.int64]
MAX_ROUNDS = 20  # of drawing, before a buffer with few segments gives fewer than asked for


class Steps(NamedTuple):
    """Single steps, for the low level.

    :param observations: ``(batch, obs_dim)``
    :param next_observations: ``(batch, obs_dim)``
    :param actions: ``(batch, action_dim)``
    :param starts: observations in which the goals were proposed, ``(batch, obs_dim)``
    :param goals: proposed there, in units of the scale, ``(batch, n_goal_dims)``
    """

    observations: th.Tensor
    next_observations: th.Tensor
    actions: th.Tensor
    starts: th.Tensor
    goals: th.Tensor


class Segments(NamedTuple):
    """Steps under one goal each, for the high level; at most ``goal_period``, fewer where the episode ended.

    :param observations: ``(batch, goal_period, obs_dim)``
    :param actions: ``(batch, goal_period, action_dim)``
    :param mask: ``(batch, goal_period)``; whether the step belongs to the segment
    :param ends: observations after the last step, ``(batch, obs_dim)``
    :param rewards: sums over the steps, ``(batch, 1)``
    :param dones: ``(batch, 1)``; 1 where the episode ended by itself
    :param goals: in units of the scale, ``(batch, n_goal_dims)``
    """

    observations: th.Tensor
    actions: th.Tensor
    mask: th.Tensor
    ends: th.Tensor
    rewards: th.Tensor
    dones: th.Tensor
    goals: th.Tensor


class GoalReplayBuffer(ReplayBuffer):
    """SB3's replay buffer with two numbers more for each step: the goal proposed last, and how long ago.

    The steps of an environment lie one behind the other, so those before and after a step are found by counting.

    :param buffer_size: steps kept, over all environments
    :param observation_space: one-dimensional ``Box``
    :param action_space: ``Box`` or ``Discrete``
    :param device: of the tensors returned
    :param n_envs: number of environments
    :param n_goal_dims: length of a goal
    :param goal_period: steps under one goal
    :param kwargs: see SB3's ``ReplayBuffer``
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        *,
        n_goal_dims: int,
        goal_period: int,
        **kwargs: Any,
    ) -> None:
        # A segment has to fit in.
        buffer_size = max(buffer_size, (goal_period + 1) * n_envs)
        super().__init__(buffer_size, observation_space, action_space, device, n_envs, **kwargs)
        self.goal_period = goal_period
        self.goals = np.zeros((self.buffer_size, n_envs, n_goal_dims), dtype=np.float32)
        self.ages = np.zeros((self.buffer_size, n_envs), dtype=np.int64)
        self.segment_ends = np.zeros((self.buffer_size, n_envs), dtype=bool)

    def note_goals(self, goals: NDArray[np.float32], ages: NDArray[np.int64]) -> None:
        """Say under which goals the steps to be added next are made; called before :meth:`add`.

        :param goals: proposed last, in units of the scale, ``(n_envs, n_goal_dims)``
        :param ages: steps made under them before, ``(n_envs,)``
        """
        self.goals[self.pos], self.ages[self.pos] = goals, ages

    def add(
        self,
        obs: NDArray[Any],
        next_obs: NDArray[Any],
        action: NDArray[Any],
        reward: NDArray[Any],
        done: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Add a step of each environment; see SB3's ``ReplayBuffer.add``."""
        self.segment_ends[self.pos] = np.asarray(done, dtype=bool) | (self.ages[self.pos] == self.goal_period - 1)
        super().add(obs, next_obs, action, reward, done, infos)

    def sample_steps(self, batch_size: int, env: VecNormalize | None = None) -> Steps:
        """Draw single steps uniformly.

        :param batch_size: number of them
        :param env: which normalises observations
        :raises ValueError: if the buffer is empty
        """
        drawn = self._draw(batch_size, self._has_start, oversampling=1)
        if drawn is None:
            raise ValueError("the replay buffer is empty; collect steps before sampling")
        rows, envs = drawn
        starts = (rows - self.ages[rows, envs]) % self.buffer_size
        return Steps(
            self._observations(self.observations[rows, envs], env),
            self._observations(self.next_observations[rows, envs], env),
            self.to_torch(self.actions[rows, envs]),
            self._observations(self.observations[starts, envs], env),
            self.to_torch(self.goals[rows, envs]),
        )

    def sample_segments(self, batch_size: int, env: VecNormalize | None = None) -> Segments | None:
        """Draw finished segments uniformly.

        :param batch_size: number of them
        :param env: which normalises observations and rewards
        :return: the segments; ``None`` if there is none yet
        """
        drawn = self._draw(batch_size, self._is_finished, oversampling=self.goal_period + 1)
        if drawn is None:
            return None
        starts, envs = drawn
        rows = (starts[:, None] + np.arange(self.goal_period)) % self.buffer_size
        columns = envs[:, None]
        last = self._segment(starts, envs).argmax(axis=1)
        mask = np.arange(self.goal_period) <= last[:, None]
        ends = (starts + last) % self.buffer_size
        rewards = self._normalize_reward(self.rewards[rows, columns], env)
        return Segments(
            self._observations(self.observations[rows, columns], env),
            self.to_torch(self.actions[rows, columns]),
            self.to_torch(mask),
            self._observations(self.next_observations[ends, envs], env),
            self.to_torch((rewards * mask).sum(axis=1, keepdims=True, dtype=np.float32)),
            self.to_torch((self.dones[ends, envs] * (1 - self.timeouts[ends, envs])).reshape(-1, 1)),
            self.to_torch(self.goals[starts, envs]),
        )

    def _observations(self, observations: NDArray[Any], env: VecNormalize | None) -> th.Tensor:
        return self.to_torch(np.asarray(self._normalize_obs(observations, env), dtype=np.float32))

    def _order(self, rows: Indices) -> Indices:
        """Return how many steps of an environment are older than those at some rows."""
        return (rows - (self.pos if self.full else 0)) % self.buffer_size

    def _has_start(self, rows: Indices, envs: Indices) -> NDArray[np.bool_]:
        return self._order(rows) >= self.ages[rows, envs]

    def _segment(self, starts: Indices, envs: Indices) -> NDArray[np.bool_]:
        """Return which of the ``goal_period`` steps from a start on is the segment's last, ``(batch, goal_period)``."""
        offsets = np.arange(self.goal_period)
        rows = (starts[:, None] + offsets) % self.buffer_size
        stored = self._order(starts)[:, None] + offsets < self.size()
        # Where training was begun anew, a segment was left unfinished and the ages do not go on.
        going_on = np.logical_and.accumulate(self.ages[rows, envs[:, None]] == offsets, axis=1)
        last: NDArray[np.bool_] = self.segment_ends[rows, envs[:, None]] & stored & going_on
        return last

    def _is_finished(self, rows: Indices, envs: Indices) -> NDArray[np.bool_]:
        finished = self.ages[rows, envs] == 0
        finished[finished] = self._segment(rows[finished], envs[finished]).any(axis=1)
        return finished

    def _draw(
        self, batch_size: int, accept: Callable[[Indices, Indices], NDArray[np.bool_]], oversampling: int
    ) -> tuple[Indices, Indices] | None:
        """Draw rows and environments until enough are accepted; repeat those found where there are too few."""
        found_rows, found_envs, n_found = [], [], 0
        for _ in range(MAX_ROUNDS if self.size() else 0):
            draws = th.randint(self.size() * self.n_envs, (batch_size * oversampling,)).numpy()
            rows, envs = np.divmod(draws, self.n_envs)
            accepted = accept(rows, envs)
            found_rows.append(rows[accepted])
            found_envs.append(envs[accepted])
            n_found += int(accepted.sum())
            if n_found >= batch_size:
                break
        if not n_found:
            return None
        return np.resize(np.concatenate(found_rows), batch_size), np.resize(np.concatenate(found_envs), batch_size)
