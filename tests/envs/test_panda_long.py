"""Long runs of random actions on the Panda tasks; the full length with ``make test-long``."""

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS

TASKS = [domain for domain in DOMAINS.values() if domain.simulation]
#: Every tenth episode is played again in another environment.
REPLAYED = 10


def play(env, domain, episode: int) -> np.ndarray:
    """Play an episode of random actions, seeds and size by its number; return observations and rewards."""
    rng = np.random.default_rng(episode)
    observation, info = env.reset(seed=episode, options={domain.size: 1 + episode % 8})
    assert info["variation"] == {domain.size: 1 + episode % 8}
    # Every other episode with a bias downwards, which makes the gripper meet objects and the table.
    low, high = ((-1, -1, -1.3, -1), (1, 1, 0.7, 1)) if episode % 2 else ((-1,) * 4, (1,) * 4)
    rows, ended = [np.append(observation, 0.0)], False
    while not ended:
        action = np.clip(rng.uniform(low, high), -1, 1).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        rows.append(np.append(observation, reward))
        ended = terminated or truncated
    return np.array(rows)


def assert_long_run_stays_sound(domain, n_actions: int, **arguments) -> None:
    env, other = (gym.make(domain.id, disable_env_checker=True, **arguments) for _ in range(2))
    bounds = env.observation_space.high
    taken = episode = 0
    while taken < n_actions:
        rows = play(env, domain, episode)
        assert np.isfinite(rows).all(), episode
        assert (np.abs(rows[:, :-1]) <= bounds).all(), episode
        if episode % REPLAYED == 0:
            assert np.array_equal(play(other, domain, episode), rows), episode
        taken += len(rows) - 1
        episode += 1
    env.close()
    other.close()


@pytest.mark.parametrize("domain", TASKS, ids=lambda domain: domain.id)
def test_random_actions_at_every_size_stay_sound(domain) -> None:
    assert_long_run_stays_sound(domain, 1600, max_episode_steps=100)


@pytest.mark.slow
@pytest.mark.parametrize("domain", TASKS, ids=lambda domain: domain.id)
def test_hundred_thousand_random_actions_stay_sound(domain) -> None:
    assert_long_run_stays_sound(domain, 100_000)
