"""Gymnasium's vector environments as SB3's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn


class BatchedVecEnv(VecEnv):
    """A Gymnasium ``VectorEnv`` that resets within the step, as an SB3 ``VecEnv``.

    ``get_attr``, ``set_attr`` and ``env_method`` reach the attributes and methods of the batch as a whole, whatever
    indices are given. ``set_options`` takes a variation for all environments, or a list with one for each; it holds
    from the next ``reset``. The infos of a step are empty except for environments whose episode ends. After such an end
    ``reset_infos`` have the new episode's variation, and not its ``optimal_steps``, which the batch is asked for.

    :param env: a vector environment whose autoreset mode is ``SAME_STEP``
    :raises ValueError: for another autoreset mode
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"autoreset mode {mode} is not accepted; an SB3 VecEnv resets within the step (SAME_STEP)")
        self.env = env
        self.render_mode = env.render_mode
        self._actions: NDArray[Any] = np.zeros(0)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> NDArray[Any]:
        """Reset every environment, with the seeds and options given since the last reset."""
        seeds = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        names = {name for options in self._options for name in options}
        # A batch takes every option for all environments. Those that were not given it keep their present value, and a
        # part of a start that they were not given is drawn.
        present = getattr(self.env, "row_variations", [{}] * self.num_envs)
        space = getattr(self.env, "variations", None)
        if space is not None:
            drawn = dict.fromkeys(space.starts)
            present = [{**drawn, **space.whole(variation)} for variation in present]
        rows = [{**old, **new} for old, new in zip(present, self._options, strict=True)]
        if any(not names <= set(row) for row in rows):
            raise ValueError(f"every environment needs the same option names; given: {self._options}")
        options = {name: [row[name] for row in rows] for name in sorted(names)}
        observations, infos = self.env.reset(seed=seeds, options=options or None)  # type: ignore[arg-type]
        self.reset_infos = [_info_of_row(infos, row) for row in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step the batch."""
        observations, rewards, terminated, truncated, batch = self.env.step(self._actions)
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in dones.nonzero()[0]:
            self.reset_infos[row] = self._info_of_reset(batch, row)
            infos[row] = {
                **_info_of_row(batch.get("final_info", batch), row),
                "terminal_observation": batch["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
            }
        return observations, rewards.astype(np.float32), dones, infos

    def _info_of_reset(self, batch: Mapping[str, Any], row: int) -> dict[str, Any]:
        """Return the info of the reset that followed the end of an episode.

        A batch of this package's domains, which has ``row_variations``, gives the variation alone: what a planner needs
        from the new start costs as much as a step.
        """
        variations = getattr(self.env, "row_variations", None)
        return _info_of_row(batch, row) if variations is None else {"variation": dict(variations[row])}

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """Return one picture per environment, ``None`` without a render mode."""
        pictures: Any = self.env.render() if self.render_mode else [None] * self.num_envs
        return list(pictures)

    def close(self) -> None:
        """Close the batch."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the batch's attribute once per environment asked for."""
        return [getattr(self.env, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set the batch's attribute."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call the batch's method once and return its result once per environment asked for."""
        return [getattr(self.env, method_name)(*args, **kwargs)] * len(self._rows(indices))

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return ``False`` once per environment asked for: a batch has no wrappers of single environments."""
        return [False] * len(self._rows(indices))

    def _rows(self, indices: VecEnvIndices) -> Sequence[int]:
        return list(self._get_indices(indices))


def _info_of_row(infos: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return one environment's info. In Gymnasium's form ``_name`` says which environments have a ``name``."""
    info = {}
    for name, values in infos.items():
        present = infos.get(f"_{name}")
        if name.startswith("_") or name in ("final_obs", "final_info") or (present is not None and not present[row]):
            continue
        value = _info_of_row(values, row) if isinstance(values, Mapping) else values[row]
        info[name] = value.item() if isinstance(value, np.generic) else value
    return info
