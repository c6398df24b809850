"""The batched form of the Panda environments does what the single form does, step for step."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from progpolicy_envs import DOMAINS

IDS = [domain.id for domain in DOMAINS.values() if domain.simulation]
SIZES = (1, 3, 8)


def make_vec(env_id: str, num_envs: int = len(SIZES), **arguments: Any) -> gym.vector.VectorEnv:
    return gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **arguments)


def flat(observation: Any) -> np.ndarray:
    return np.concatenate(list(observation.values()), axis=-1) if isinstance(observation, dict) else observation


@pytest.mark.parametrize("observation", ["flat", "goal"])
@pytest.mark.parametrize("reward_type", ["dense", "potential", "sparse"])
@pytest.mark.parametrize("env_id", IDS)
def test_batched_equals_single_step_for_step(env_id, reward_type, observation):
    size = DOMAINS[env_id].size
    arguments = {"observation": observation, "reward_type": reward_type, "max_episode_steps": 70}
    batched = make_vec(env_id, **arguments)
    singles = [gym.make(env_id, disable_env_checker=True, **arguments) for _ in SIZES]
    rng = np.random.default_rng(0)
    ends = {"success": 0, "truncation": 0, "failure": 0}
    for sizes in (SIZES, SIZES[::-1]):
        seed = None if ends["truncation"] else 4
        observations, infos = batched.reset(seed=seed, options={size: sizes})
        for row, env in enumerate(singles):
            single, info = env.reset(seed=None if seed is None else seed + row, options={size: sizes[row]})
            np.testing.assert_array_equal(flat(observations)[row], flat(single))
            assert infos["variation"][row] == info["variation"]
        for step in range(150):
            actions = np.array([next(env.unwrapped.plan()) for env in singles])
            if step % 10 == 9:
                actions = rng.uniform(-1.3, 1.3, actions.shape).astype(np.float32)
            observations, rewards, terminated, truncated, infos = batched.step(actions)
            assert observations in batched.observation_space
            for row, env in enumerate(singles):
                single, reward, end, cut, info = env.step(actions[row])
                assert (rewards[row], terminated[row], truncated[row]) == (reward, end, cut and not end)
                assert {name: infos[name][row].tolist() for name in info} == {
                    name: np.array(value).tolist() for name, value in info.items()
                }
                if end or cut:
                    np.testing.assert_array_equal(flat(infos["final_obs"][row]), flat(single))
                    ends["success" if info["is_success"] else "truncation" if not end else "failure"] += 1
                    single, _ = env.reset()
                np.testing.assert_array_equal(flat(observations)[row], flat(single))
    assert min(ends["success"], ends["truncation"]) > 0, "episodes of both ends are compared"
    for env in (batched, *singles):
        env.close()


def test_form_is_that_of_the_single_environments():
    batched, single = make_vec("PandaPush-v0"), gym.make("PandaPush-v0")
    assert batched.single_observation_space == single.observation_space
    assert batched.single_action_space == single.action_space
    assert batched.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert batched.observation_names == single.unwrapped.observation_names
    assert batched.action_names == single.unwrapped.action_names
    batched.close()
    single.close()


def test_pictures_are_those_of_the_single_environments():
    batched = make_vec("PandaReach-v0", 2, render_mode="rgb_array", n_targets=2)
    single = gym.make("PandaReach-v0", render_mode="rgb_array", n_targets=2)
    batched.reset(seed=3)
    single.reset(seed=4)
    np.testing.assert_array_equal(batched.render()[1], single.render())
    assert (batched.render()[0] != batched.render()[1]).any()
    batched.close()
    single.close()


@pytest.mark.parametrize(
    ("actions", "said"), [(np.zeros((2, 4)), r"shape \(3, 4\)"), (np.full((3, 4), np.nan), "finite numbers")]
)
def test_actions_that_are_not_accepted_are_refused(actions, said):
    env = make_vec("PandaReach-v0")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=said):
        env.step(actions)
    env.close()


@pytest.mark.parametrize(
    ("num_envs", "arguments", "said"),
    [(0, {}, "num_envs=0"), (1, {"n_objects": 9}, "n_objects=9"), (1, {"render_mode": "human"}, "human")],
)
def test_arguments_that_are_not_accepted_are_refused(num_envs, arguments, said):
    with pytest.raises(ValueError, match=said):
        make_vec("PandaStack-v0", num_envs, **arguments)
