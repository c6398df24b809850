"""Reset options that stay in force when an episode has ended."""

from __future__ import annotations

from typing import Any

import gymnasium as gym


class RepeatOptions(gym.Wrapper[Any, Any, Any, Any]):
    """Gives its environment the options of the last reset that had any, in each one that has none.

    Gymnasium's environments read options for one reset, and a ``VecEnv`` gives none when an episode has ended.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._options: dict[str, Any] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See ``gymnasium.Env.reset``."""
        if options is not None:
            self._options = options
        return self.env.reset(seed=seed, options=self._options)
