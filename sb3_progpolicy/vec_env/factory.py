"""The fastest vectorised environment of an id."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from functools import partial
from importlib import import_module
from typing import Any

import gymnasium as gym
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from progpolicy_envs import find_domain
from sb3_progpolicy.vec_env.batched import BatchedVecEnv
from sb3_progpolicy.vec_env.grouped import GroupedSubprocVecEnv, GroupedVecEnv, even_shares, usable_cores

_IN_THIS_PROCESS: ContextVar[bool] = ContextVar("in_this_process", default=False)


@contextlib.contextmanager
def simulations_in_this_process() -> Iterator[None]:
    """Let :func:`make_fast_vec_env` start no processes, so that a training keeps to one core."""
    token = _IN_THIS_PROCESS.set(True)
    try:
        yield
    finally:
        _IN_THIS_PROCESS.reset(token)


def make_fast_vec_env(env_id: str, n_envs: int, seed: int | None = None, **env_kwargs: Any) -> VecEnv:
    """Build the fastest vectorised environment of an id, monitored.

    * The Panda tasks run in as many processes as there are cores, with one batch in each; in this one alone within
      :func:`simulations_in_this_process`.
    * Their goal form (``observation="goal"``) runs in as many processes, with single environments in each. A replay
      buffer needs the infos of every step, and a batch gives only those of the steps that end an episode.
    * Other ids run in this process: as one batch if they have a form that resets within the step and no picture is
      asked for, one environment after the other if not.
    * An environment that opens a window (``render_mode="human"``) is never batched.

    :param env_id: a registered id, with or without a module prefix
    :param n_envs: number of environments, at least 1
    :param seed: environment ``i`` gets ``seed + i``
    :param env_kwargs: passed to ``gym.make`` or ``gym.make_vec``
    :raises ValueError: if ``n_envs`` is less than 1
    """
    if n_envs < 1:
        raise ValueError(f"n_envs={n_envs} is not accepted; it is at least 1")
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)  # registers the id; gym.spec does not know the prefix
    domain = find_domain(name)
    simulation = domain is not None and domain.simulation
    # A daemonic process, such as one of a multiprocessing.Pool, may not start others.
    may_start = simulation and not (multiprocessing.current_process().daemon or _IN_THIS_PROCESS.get())
    n_processes = min(n_envs, usable_cores()) if may_start else 1
    venv: VecEnv | None = None
    if gym.spec(name).vector_entry_point is not None and _batch_suffices(simulation, env_kwargs):
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


def _batch_suffices(simulation: bool, env_kwargs: Mapping[str, Any]) -> bool:
    """Return whether the batched form can do what the arguments ask for; only those of simulations draw pictures."""
    render_mode = env_kwargs.get("render_mode")
    if not simulation:
        return render_mode is None
    return render_mode != "human" and env_kwargs.get("observation") != "goal"


def _batch(env_id: str, n_envs: int, env_kwargs: Mapping[str, Any]) -> BatchedVecEnv | None:
    """Return the batched form of an id, ``None`` if it does not reset within the step."""
    kwargs = {name: value for name, value in env_kwargs.items() if name != "disable_env_checker"}
    if kwargs.get("max_episode_steps", 0) is None:  # to gym.make, None means the registered number
        del kwargs["max_episode_steps"]
    batch = gym.make_vec(env_id, num_envs=n_envs, vectorization_mode="vector_entry_point", **kwargs)
    try:
        return BatchedVecEnv(batch)
    except ValueError:
        batch.close()
        return None


def _simulations(env_id: str, n_envs: int, env_kwargs: Mapping[str, Any]) -> VecEnv:
    """Return the batch of one process."""
    batch = _batch(env_id, n_envs, env_kwargs)
    assert batch is not None, "the batched form of a simulation resets within the step"
    return batch
