"""What the single forms of the planning domains share: checked actions and the three ways to look at a state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.rendering import Display, Frame


class PlanningEnv(gym.Env[NDArray[np.float32], np.int64], ABC):
    """An environment with a Discrete action space that can be drawn as a picture and as a text.

    :param render_mode: ``"human"``, ``"rgb_array"``, ``"ansi"`` or ``None``
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "ansi"], "render_fps": 4}

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self._display = Display(self.metadata["render_fps"])

    def render(self) -> Any:
        """Return a picture ``(height, width, 3)`` of bytes, or a text, or show a window, as ``render_mode`` says."""
        if self.render_mode == "ansi":
            return self._text()
        if self.render_mode == "rgb_array":
            return self._frame()
        self._show()
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        self._display.close()

    def _check_action(self, action: np.int64 | int) -> int:
        """Return the action as an ``int``.

        :raises ValueError: if it is out of range
        """
        if not self.action_space.contains(action):
            n_actions = self.action_space.n  # type: ignore[attr-defined]
            raise ValueError(f"action={action!r} is not accepted; actions are integers from 0 to {n_actions - 1}")
        return int(action)

    def _show(self) -> None:
        """Show the state in the window; to be called after each change of it."""
        if self.render_mode == "human":
            self._display.show(self._frame())

    @abstractmethod
    def plan(self) -> list[int]:
        """Return the actions of a shortest solution from the present state.

        ``for action in env.unwrapped.plan(): env.step(action)`` solves the task, as in every environment of this
        package.
        """

    @abstractmethod
    def _frame(self) -> Frame:
        """Draw the state, ``(height, width, 3)`` bytes."""

    @abstractmethod
    def _text(self) -> str:
        """Write the state in lines that end in line feeds."""
