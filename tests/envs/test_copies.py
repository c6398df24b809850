"""A copy of an environment is an environment of its own in the same state; one that is dropped is freed."""

import copy
import gc
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS

IDS = list(DOMAINS)
PANDA_IDS = [domain.id for domain in DOMAINS.values() if domain.simulation]
COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}


def make(env_id: str, num_envs: int | None, **arguments: Any) -> Any:
    """Make a single environment, or a batch, at a size above the smallest."""
    arguments = {**arguments, DOMAINS[env_id].size: 3}
    if num_envs is None:
        return gym.make(env_id, disable_env_checker=True, **arguments)
    return gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **arguments)


def play(env: Any, seed: int, steps: int) -> list[Any]:
    """Step with random actions, downwards in the Panda tasks, so that things are met; return what can be seen."""
    generator, seen = np.random.default_rng(seed), []
    for _ in range(steps):
        if isinstance(env.action_space, gym.spaces.Box):
            actions = generator.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            actions[..., 2] -= 0.4
        elif isinstance(env.action_space, gym.spaces.Discrete):
            actions = generator.integers(env.action_space.n)
        else:
            actions = generator.integers(env.single_action_space.n, size=env.num_envs)
        observation, reward, terminated, truncated, _ = env.step(actions)
        seen += [observation, reward, terminated, truncated]
        if np.ndim(reward) == 0 and (terminated or truncated):
            seen.append(env.reset()[0])
    return [np.array(part) for part in seen]


def assert_equal(one: list[Any], other: list[Any]) -> None:
    assert len(one) == len(other)
    for part, twin in zip(one, other, strict=True):
        np.testing.assert_array_equal(part, twin)


@pytest.mark.parametrize("way", COPIES)
@pytest.mark.parametrize("num_envs", [None, 2])
@pytest.mark.parametrize("env_id", IDS)
def test_copy_goes_on_as_the_original_would_and_leaves_it_alone(env_id: str, num_envs: int | None, way: str) -> None:
    original, twin = make(env_id, num_envs), make(env_id, num_envs)
    for env in (original, twin):
        env.reset(seed=3)
        play(env, seed=0, steps=25)
    other = COPIES[way](original)
    expected = play(twin, seed=1, steps=40)
    assert_equal(play(other, seed=1, steps=40), expected)
    other.close()
    assert_equal(play(original, seed=1, steps=40), expected)
    original.close()
    twin.close()


@pytest.mark.parametrize("env_id", PANDA_IDS)
def test_copy_of_a_world_with_pictures_shows_the_same_and_has_a_goal_form_too(env_id: str) -> None:
    env = make(env_id, None, render_mode="rgb_array", observation="goal")
    env.reset(seed=1)
    for action, _ in zip(env.unwrapped.plan(), range(40), strict=False):
        env.step(action)
    other = copy.deepcopy(env)
    assert type(other.unwrapped) is type(env.unwrapped)
    np.testing.assert_array_equal(other.render(), env.render())


def test_copy_of_a_closed_environment_is_closed() -> None:
    env = make("PandaPush-v0", None)
    env.close()
    copy.deepcopy(env).close()


@pytest.mark.parametrize("num_envs", [None, 2])
def test_panda_environment_that_is_dropped_frees_its_worlds(num_envs: int | None) -> None:
    pybullet = pytest.importorskip("pybullet", reason="pybullet is not installed")
    env = make("PandaPush-v0", num_envs)
    env.reset(seed=0)
    clients = [single.scene.client for single in getattr(env.unwrapped, "envs", [env.unwrapped])]
    assert all(pybullet.getConnectionInfo(client)["isConnected"] for client in clients)
    del env
    gc.collect()
    assert not any(pybullet.getConnectionInfo(client)["isConnected"] for client in clients)


def test_copy_of_an_environment_with_an_open_window_opens_another() -> None:
    pytest.importorskip("pygame", reason="pygame is not installed")
    from tests.envs.helpers import run_python

    run_python(
        "import copy, gymnasium as gym, progpolicy_envs\n"
        "env = gym.make('Hanoi-v0', render_mode='human'); env.reset(seed=0)\n"
        "other = copy.deepcopy(env); env.close(); other.step(0); other.close()\n",
        SDL_VIDEODRIVER="dummy",
    )
