"""What the single environments have in common: variations, starts that are given, and reset before all else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from progpolicy_envs.rendering import Display
from progpolicy_envs.states import check_choice
from progpolicy_envs.variation import Variation, VariationSpace, with_context


def require_reset(started: bool, call: str) -> None:
    """Raise :class:`gymnasium.error.ResetNeeded` unless an episode has been started."""
    if not started:
        raise ResetNeeded(f"{call} needs an episode; call reset() first")


class DomainEnv(gym.Env[Any, Any], ABC):
    """One environment of a task domain.

    :param variation: the variation in force
    :param observation_space: of what a subclass observes
    :param render_mode: one of those in ``metadata``, or ``None``
    :param context: ``"observed"`` if observations end with the variation's numbers, ``"hidden"`` if not
    :raises ValueError: if a value is not accepted
    """

    variations: ClassVar[VariationSpace]
    #: Names of the numbers of an observation.
    observation_names: tuple[str, ...] = ()

    def __init__(
        self,
        variation: Mapping[str, Any],
        observation_space: spaces.Space[Any],
        render_mode: str | None = None,
        context: str = "hidden",
    ) -> None:
        check_choice("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        names = self.variations.context_names
        self.observation_space = with_context(observation_space, names, context)
        self.context = context
        if context == "observed":
            self.observation_names = (*type(self).observation_names, *names)
        self.variation: Variation = self.variations.update({}, variation)
        #: The variation whose numbers are observed: that in force, or that of the state that was set.
        self._shown = self.variation
        self.render_mode = render_mode
        self._display = Display(self.metadata["render_fps"])
        self._started = False

    def reset(self, *, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        :param seed: seeds the generator from which everything random is drawn; ``None`` goes on with it
        :param options: new values of variation parameters, which stay in force, and parts of the start of this one
            episode, in place of drawn ones; see the class
        :return: observation and info
        :raises ValueError: if an option is not accepted; the variation in force is then unchanged, and if it was part
            of a start, another reset is needed
        """
        changes, start = self.variations.split(options)
        variation = self.variations.update(self.variation, changes)
        super().reset(seed=seed)
        self._started = False
        self._start(variation, start)
        self.variation = self._shown = variation
        self._started = True
        self._show()
        return self._observation(), {"is_success": False, "variation": dict(variation), **self._reset_info()}

    def close(self) -> None:
        """Close the window, if there is one."""
        self._display.close()

    def _observation(self) -> Any:
        """Return the observation, with the variation's numbers if they are observed."""
        observation = self._observe()
        if self.context == "hidden":
            return observation
        return np.concatenate([observation, self.variations.encode(self._shown)], dtype=np.float32)

    def _show(self) -> None:
        """Show the state in the window; to be called after each change of it."""
        if self.render_mode == "human":
            self._display.show(self._frame())

    def _reset_info(self) -> dict[str, Any]:
        """Return what the info of a reset has besides the variation."""
        return {}

    @abstractmethod
    def _start(self, variation: Variation, start: Mapping[str, Any]) -> None:
        """Put the environment into a starting state.

        :param variation: of the episode
        :param start: parts of it that are given; all others are drawn
        """

    @abstractmethod
    def _observe(self) -> Any:
        """Return the observation, without the variation's numbers."""

    @abstractmethod
    def _frame(self) -> Any:
        """Draw the state, ``(height, width, 3)`` bytes."""
