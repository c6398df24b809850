"""Reset options that stay in force when an episode has ended."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from progpolicy_envs import find_domain


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


def repeat_options(venv: VecEnv) -> None:
    """Wrap environments that are stepped one by one in :class:`RepeatOptions`, unless they are of a domain or wrapped.

    The domains' keep a variation in force by themselves. Those in other processes or of one batch cannot be wrapped
    from here; a warning says so for SB3's.

    :param venv: environments, whose ``envs`` are replaced
    """
    bare: Any = venv.unwrapped
    if isinstance(bare, SubprocVecEnv):
        ids = [getattr(spec, "id", None) for spec in bare.get_attr("spec")]
        wrapped = bare.env_is_wrapped(RepeatOptions)
        if any(not is_wrapped and find_domain(name) is None for name, is_wrapped in zip(ids, wrapped, strict=True)):
            warnings.warn(
                "environments of a SubprocVecEnv get their reset options once, and one that reads them for a single "
                "reset, as Gymnasium's do, loses them when an episode ends; make each of them as RepeatOptions(env) "
                "(sb3_progpolicy.vec_env.repeat), or use a DummyVecEnv",
                stacklevel=2,
            )
    if not isinstance(bare, DummyVecEnv):
        return
    for row, env in enumerate(bare.envs):
        if not isinstance(env, RepeatOptions) and find_domain(getattr(env.spec, "id", None)) is None:
            bare.envs[row] = RepeatOptions(env)
