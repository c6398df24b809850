"""The batched form of the Panda environments: several simulations in one process, each part of a step for all of them.

Physics and Python evict each other from the processor's caches. So a step first gives all arms their commands, then
computes the physics of all simulations, then reads all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from progpolicy_envs.panda import make_push, make_reach, make_slide, make_stack
from progpolicy_envs.panda.env import Observation, PandaEnv
from progpolicy_envs.panda.goal import EntryPoint
from progpolicy_envs.vector import DomainVectorEnv, Infos, check_num_envs


class PandaVectorEnv(DomainVectorEnv):
    """N simulations stepped together, equal to N single environments step for step.

    A subclass names what makes a single one. ``infos`` of a step hold the items of a single one's info, in arrays.

    :param num_envs: number of environments
    :param max_episode_steps: steps after which an episode is truncated; ``None`` for no limit
    :param render_mode: ``None`` or ``"rgb_array"``
    :param arguments: of the single form
    """

    metadata: dict[str, Any] = {
        **PandaEnv.metadata,
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": ["rgb_array"],
    }
    #: Makes one environment.
    make_single: ClassVar[EntryPoint]
    observation_names: tuple[str, ...] = PandaEnv.observation_names
    action_names: ClassVar[tuple[str, ...]] = PandaEnv.action_names

    def __init_subclass__(cls) -> None:
        cls.variations = cls.make_single.variations

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode={render_mode!r} is not accepted; a batch has None or 'rgb_array'")
        check_num_envs(num_envs)
        self.render_mode = render_mode
        self.envs: list[PandaEnv] = []
        try:
            for _ in range(num_envs):
                self.envs.append(self.make_single(render_mode=render_mode, **arguments))
            first = self.envs[0]
            super().__init__(num_envs, first.observation_space, first.action_space, first.variation, max_episode_steps)
            self.observation_names = first.observation_names
        except BaseException:
            self.close_extras()
            raise
        self._observations: list[Observation] = [np.empty(0, np.float32)] * num_envs

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture of each environment, as its single form draws it; ``None`` without a render mode."""
        return tuple(env.render() for env in self.envs) if self.render_mode else None

    def close_extras(self, **kwargs: Any) -> None:
        """Leave PyBullet."""
        for env in self.envs:
            env.close()

    def _checked(self, actions: NDArray[Any]) -> NDArray[Any]:
        with np.errstate(over="ignore"):
            numbers = actions.astype(np.float32)
        if actions.shape != self.action_space.shape or not np.isfinite(numbers).all():
            raise ValueError(
                f"actions of shape {actions.shape} and values {actions!r} are not accepted; "
                f"needed: shape {self.action_space.shape}, finite numbers from -1 to 1"
            )
        return numbers

    def _apply(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_], Infos]:
        for env, numbers in zip(self.envs, actions.tolist(), strict=True):
            env.scene.act(numbers)
        for env in self.envs:
            env.scene.simulate()
        observations, rewards, infos = zip(*[env.post_physics_step() for env in self.envs], strict=True)
        self._observations = list(observations)
        batch = {name: np.array([info[name] for info in infos]) for name in infos[0]}
        return np.array(rewards), batch["is_success"] | batch["is_failure"], batch

    def _observe(self) -> Any:
        rows: list[Any] = self._observations
        if isinstance(rows[0], dict):
            return {key: np.array([row[key] for row in rows]) for key in rows[0]}
        return np.array(rows)

    def _reset_rows(self, rows: NDArray[np.intp]) -> None:
        for row in rows:
            env = self.envs[row]
            env.np_random = self._generators[row]
            self._observations[row] = env.reset(options=self.variations.whole(self.row_variations[row]))[0]

    def _set_start(self, row: int, start: Mapping[str, Any]) -> None:
        self._observations[row] = self.envs[row].replace_start(start)


class PandaReachVectorEnv(PandaVectorEnv):
    """N :class:`~progpolicy_envs.panda.PandaReachEnv`; see :class:`PandaVectorEnv`."""

    make_single: ClassVar[EntryPoint] = make_reach


class PandaPushVectorEnv(PandaVectorEnv):
    """N :class:`~progpolicy_envs.panda.PandaPushEnv`; see :class:`PandaVectorEnv`."""

    make_single: ClassVar[EntryPoint] = make_push


class PandaSlideVectorEnv(PandaVectorEnv):
    """N :class:`~progpolicy_envs.panda.PandaSlideEnv`; see :class:`PandaVectorEnv`."""

    make_single: ClassVar[EntryPoint] = make_slide


class PandaStackVectorEnv(PandaVectorEnv):
    """N :class:`~progpolicy_envs.panda.PandaStackEnv`; see :class:`PandaVectorEnv`."""

    make_single: ClassVar[EntryPoint] = make_stack
