"""Checks that every planning domain has to pass."""

import gc
import os
import subprocess
import sys
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env


def assert_checkers_are_silent(env_id: str, **arguments: Any) -> None:
    """Run the environment checkers of Gymnasium and SB3 with every warning an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check_env(gym.make(env_id, render_mode="rgb_array", **arguments).unwrapped)
        sb3_check_env(gym.make(env_id, **arguments).unwrapped)


def resident_bytes() -> int:
    """Return the memory that this process holds now."""
    gc.collect()
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def assert_long_run_stays_sound(env_id: str, n_actions: int, options: list[dict[str, Any]], **arguments: Any) -> None:
    """Take random actions in the batched form, through changes of variation; check every observation and the memory.

    :param n_actions: how many actions in all
    :param options: variations, taken in turn
    """
    num_envs = 1000
    env = gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **arguments)
    low, high = env.single_observation_space.low, env.single_observation_space.high
    generator = np.random.default_rng(0)
    env.reset(seed=0)
    steps = n_actions // num_envs
    after_warm_up = 0
    for step in range(steps):
        if step % 50 == 0:
            env.reset(options=options[step // 50 % len(options)])
        if step == steps // 2:
            after_warm_up = resident_bytes()
        observations, rewards, *_ = env.step(generator.integers(env.single_action_space.n, size=num_envs))
        assert (observations >= low).all()
        assert (observations <= high).all()
        assert np.isfinite(rewards).all()
    assert resident_bytes() - after_warm_up < 8 * 2**20


def assert_picture_shows_the_state(env: gym.Env[Any, Any], action: int) -> None:
    """Check the form of a picture, that it changes with the state, and that reading it does not change the state."""
    env.reset(seed=0)
    before = env.render()
    assert before.dtype == np.uint8
    assert before.ndim == 3
    assert before.shape[2] == 3
    np.testing.assert_array_equal(before, env.render())
    env.step(action)
    assert (before != env.render()).any()


def run_python(code: str, **environment: str) -> str:
    """Run code in a process of its own; fail if it does; return what it writes."""
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    result = subprocess.run(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=variables,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stdout
    return result.stdout


def assert_window_opens_shows_and_closes(env_id: str) -> None:
    """Run ``render_mode="human"`` without a screen."""
    pytest.importorskip("pygame")
    run_python(
        "import gymnasium as gym, progpolicy_envs, pygame\n"
        f"env = gym.make({env_id!r}, render_mode='human'); env.reset(seed=0); env.step(0)\n"
        "assert pygame.display.get_init(); env.close(); assert not pygame.display.get_init()\n",
        SDL_VIDEODRIVER="dummy",
    )
