"""A point in a U-shaped corridor, whose only reward is at its far end: what one level of learning does not find."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

SIZE = 10.0
WALL = (4.0, 6.0)  # along y
WALL_END = 6.0  # along x; beyond it the corridor goes around
TARGET = (1.0, 9.0)
RADIUS = 1.0
SPEED = 0.5  # a step
MAX_STEPS = 200


class PointMazeEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A square with a wall between start, below left, and target, above left; the way around takes some 25 steps.

    Observation: the position, ``Box(-1, 1, (2,))``, the square's middle being 0. Action: the velocity, likewise.
    Reward: 1 on reaching the target, which ends the episode, and 0 before; after 200 steps it is truncated.
    """

    observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start below left."""
        super().reset(seed=seed)
        self.x, self.y = 1 + self.np_random.uniform(-0.5, 0.5, 2)
        self.steps = 0
        return self._observation(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move along x, then along y, each unless a wall is in the way."""
        x = min(max(self.x + SPEED * float(action[0]), 0.0), SIZE)
        if not self._is_wall(x, self.y):
            self.x = x
        y = min(max(self.y + SPEED * float(action[1]), 0.0), SIZE)
        if not self._is_wall(self.x, y):
            self.y = y
        self.steps += 1
        reached = bool(np.hypot(self.x - TARGET[0], self.y - TARGET[1]) < RADIUS)
        truncated = self.steps >= MAX_STEPS and not reached
        return self._observation(), float(reached), reached, truncated, {"is_success": reached}

    def _observation(self) -> NDArray[np.float32]:
        return np.array([self.x, self.y], dtype=np.float32) * (2 / SIZE) - 1

    @staticmethod
    def _is_wall(x: float, y: float) -> bool:
        return x < WALL_END and WALL[0] < y < WALL[1]
