"""What the single forms of the planning domains share: plans, states as data, and three ways to look at a state."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from progpolicy_envs.single import DomainEnv, require_reset
from progpolicy_envs.variation import Variation


def refuse_solved(start: Mapping[str, Any], optimal_steps: int) -> None:
    """Raise ``ValueError`` if nothing is left to be done in a start.

    :param start: its given parts, for the message
    :param optimal_steps: that the planner needs from there
    """
    if not optimal_steps:
        raise ValueError(f"{dict(start)} is not accepted; nothing is left to be done there")


class PlanningEnv(DomainEnv):
    """An environment with a Discrete action space that can be drawn as a picture and as a text."""

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "ansi"], "render_fps": 4}

    @property
    def state(self) -> dict[str, Any]:
        """The present state, as data that JSON can hold; ``reset(options=...)`` and :meth:`set_state` take it."""
        require_reset(self._started, "state")
        return self._state()

    def set_state(self, state: Mapping[str, Any]) -> Any:
        """Put the running episode into a state.

        The variation in force, with which the next episode begins, stays as it is. With ``context="observed"`` the
        numbers are those of the state.

        :param state: what :attr:`state` returns, or parts of it; all others stay as they are
        :return: the observation
        :raises ValueError: if it is not a state; the present one is then unchanged
        """
        present = self.state
        unknown = sorted(set(self.variations.split(state)[0]) - set(present))
        if unknown:
            raise ValueError(f"{unknown} are not parts of a state; its parts are {', '.join(present)}")
        self._set_state({**present, **state})
        self._shown = self.variations.shown(self.variation, self._state())
        self._show()
        return self._observation()

    def plan(self) -> list[int]:
        """Return the actions of a shortest solution from the present state.

        ``for action in env.unwrapped.plan(): env.step(action)`` solves the task, as in every environment of this
        package.
        """
        require_reset(self._started, "plan()")
        return self._plan()

    def render(self) -> Any:
        """Return a picture ``(height, width, 3)`` of bytes, or a text, or show a window, as ``render_mode`` says."""
        require_reset(self._started, "render()")
        if self.render_mode == "ansi":
            return self._text()
        if self.render_mode == "rgb_array":
            return self._frame()
        self._show()
        return None

    def _check_action(self, action: np.int64 | int) -> int:
        """Return the action as an ``int``.

        :raises ValueError: if it is out of range
        """
        require_reset(self._started, "step()")
        if not self.action_space.contains(action):
            n_actions = self.action_space.n  # type: ignore[attr-defined]
            raise ValueError(f"action={action!r} is not accepted; actions are integers from 0 to {n_actions - 1}")
        return int(action)

    def _start(self, variation: Variation, start: Mapping[str, Any]) -> None:
        self._draw(variation)
        if start:
            self._set_state(self._completed(variation, start))
            refuse_solved(start, self._optimal_steps())

    def _reset_info(self) -> dict[str, Any]:
        return {"optimal_steps": self._optimal_steps()}

    def _completed(self, variation: Variation, start: Mapping[str, Any]) -> dict[str, Any]:
        """Return the state that begins an episode, of which parts are given and all others have been drawn.

        :param variation: of the episode
        :param start: the parts that are given
        :raises ValueError: if they do not fit the variation
        """
        return {**self._state(), **start}

    @abstractmethod
    def _draw(self, variation: Variation) -> None:
        """Draw a starting state of a variation."""

    @abstractmethod
    def _state(self) -> dict[str, Any]:
        """Return the present state; the names are those of the variation's parameters and of its starts."""

    @abstractmethod
    def _set_state(self, state: Mapping[str, Any]) -> None:
        """Check a whole state and put the environment into it."""

    @abstractmethod
    def _plan(self) -> list[int]:
        """Return the actions of a shortest solution from the present state."""

    @abstractmethod
    def _optimal_steps(self) -> int:
        """Return the length of a shortest solution from the present state."""

    @abstractmethod
    def _text(self) -> str:
        """Write the state in lines that end in line feeds."""
