"""Vectorised environments: the fastest one there is for an id, and an adapter for Gymnasium's batched ones."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from progpolicy_envs import DOMAINS
from sb3_progpolicy.grouped import GroupedSubprocVecEnv, GroupedVecEnv, even_shares, usable_cores


class BatchedVecEnv(VecEnv):
    """A Gymnasium ``VectorEnv`` that resets within the step, as an SB3 ``VecEnv``.

    Attributes and methods reached through ``get_attr``, ``set_attr`` and ``env_method`` are the batch's own, the same
    for every environment of it, whatever indices are given. A variation is set by ``set_options(variation)`` and the
    next ``reset``, one for all environments, or a list with one for each. Infos are given where an episode ends.

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
        # What an option is not given for keeps the value in force, which a batch has to be told.
        in_force = getattr(self.env, "row_variations", [{}] * self.num_envs)
        rows = [{**old, **new} for old, new in zip(in_force, self._options, strict=True)]
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
            infos[row] = {
                **_info_of_row(batch.get("final_info", batch), row),
                "terminal_observation": batch["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
            }
        return observations, rewards.astype(np.float32), dones, infos

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """Return one picture per environment, ``None`` without a render mode."""
        pictures: Any = self.env.render() if self.render_mode else [None] * self.num_envs
        return list(pictures)

    def close(self) -> None:
        """Close the batch."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the batch's attribute, once per environment asked for."""
        return [getattr(self.env, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set the batch's attribute."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call the batch's method once; its result is returned once per environment asked for."""
        return [getattr(self.env, method_name)(*args, **kwargs)] * len(self._rows(indices))

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """A batch has no single-environment wrappers."""
        return [False] * len(self._rows(indices))

    def _rows(self, indices: VecEnvIndices) -> Sequence[int]:
        return list(self._get_indices(indices))


def _info_of_row(infos: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Return one environment's info. By Gymnasium's convention ``_name`` tells which environments gave ``name``."""
    info = {}
    for name, values in infos.items():
        given = infos.get(f"_{name}")
        if name.startswith("_") or name in ("final_obs", "final_info") or (given is not None and not given[row]):
            continue
        value = _info_of_row(values, row) if isinstance(values, Mapping) else values[row]
        info[name] = value.item() if isinstance(value, np.generic) else value
    return info


def make_fast_vec_env(env_id: str, n_envs: int, seed: int | None = None, **env_kwargs: Any) -> VecEnv:
    """Build the fastest vectorised environment of an id, monitored.

    The batched form is taken where the id has one that resets within the step; several environments of a domain that
    is a simulation are batched in as many processes as there are cores to use. All others run in this process, one
    after the other. So do those with a window, and the goal forms of the simulations, these in as many
    processes: a replay buffer needs their infos of every step, which a batch gives only where an episode ends.

    :param env_id: a registered id, with or without a module prefix
    :param n_envs: number of environments, at least 1
    :param seed: environment ``i`` gets ``seed + i``
    :param env_kwargs: passed to ``gym.make`` or ``gym.make_vec``
    """
    if n_envs < 1:
        raise ValueError(f"n_envs={n_envs} is not accepted; it is at least 1")
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)  # registers the id; gym.spec does not know the prefix
    domain = DOMAINS.get(name)
    simulation = domain is not None and domain.simulation
    # Such processes as those of a multiprocessing.Pool may not start others.
    may_start = simulation and not multiprocessing.current_process().daemon
    n_processes = min(n_envs, usable_cores()) if may_start else 1
    goal = simulation and env_kwargs.get("observation") == "goal"
    render_mode = env_kwargs.get("render_mode")
    venv: VecEnv | None = None
    if (
        gym.spec(name).vector_entry_point is not None
        and not goal
        and (render_mode is None or (simulation and render_mode != "human"))
    ):
        if n_processes > 1:
            shares = even_shares(n_envs, n_processes)
            venv = GroupedVecEnv([partial(_simulations, env_id, len(share), env_kwargs) for share in shares])
        else:
            venv = _batch(env_id, n_envs, env_kwargs)
    if venv is not None:
        venv.seed(seed)
        return VecMonitor(venv)
    # SB3 names its own two classes here and takes any other.
    vec_env_cls: Any = GroupedSubprocVecEnv if n_processes > 1 else DummyVecEnv
    return make_vec_env(env_id, n_envs=n_envs, seed=seed, env_kwargs=env_kwargs, vec_env_cls=vec_env_cls)


def _batch(env_id: str, n_envs: int, env_kwargs: Mapping[str, Any]) -> BatchedVecEnv | None:
    """Return the batched form of an id, ``None`` if it does not reset within the step."""
    kwargs = {name: value for name, value in env_kwargs.items() if name != "disable_env_checker"}
    if kwargs.get("max_episode_steps", 0) is None:  # means the registered number, to gym.make
        del kwargs["max_episode_steps"]
    batch = gym.make_vec(env_id, num_envs=n_envs, vectorization_mode="vector_entry_point", **kwargs)
    try:
        return BatchedVecEnv(batch)
    except ValueError:
        batch.close()
        return None


def _simulations(env_id: str, n_envs: int, env_kwargs: Mapping[str, Any]) -> VecEnv:
    """Return the batch of one process, of a domain that has one."""
    batch = _batch(env_id, n_envs, env_kwargs)
    assert batch is not None
    return batch
