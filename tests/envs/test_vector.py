"""The batched form of every planning domain does what the single form does, step for step."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from progpolicy_envs import DOMAINS
from progpolicy_envs.layouts import LAYOUTS

Draw = Callable[[np.random.Generator, int], dict[str, Any]]


def draw_hanoi(generator: np.random.Generator, num_envs: int) -> dict[str, Any]:
    pegs = generator.permuted(np.tile(np.arange(3), (num_envs, 1)), axis=1)
    source, target = ([*pegs[:-9, column].tolist(), *["random"] * 9] for column in (0, 1))
    return {"n_discs": generator.integers(1, 13, num_envs), "source": source, "target": target}


def draw_hiking(generator: np.random.Generator, num_envs: int) -> dict[str, Any]:
    layouts = [*LAYOUTS, "random"]
    # Up to 7 stars only: the planner's table doubles with each, and its own tests go to 12.
    return {"n_stars": generator.integers(1, 8, num_envs), "layout": list(generator.choice(layouts, num_envs))}


def draw_stacking(generator: np.random.Generator, num_envs: int) -> dict[str, Any]:
    return {"n_plates": generator.integers(1, 9, num_envs)}


CASES: dict[str, Draw] = {
    "Hanoi-v0": draw_hanoi,
    "Hiking-v0": draw_hiking,
    "Hiking-v1": draw_hiking,
    "HikingEgo-v0": draw_hiking,
    "Stacking-v0": draw_stacking,
}
NUM_ENVS, LIMIT, STEPS = 64, 37, 90


def make_vec(env_id: str, num_envs: int = NUM_ENVS, **arguments: Any) -> gym.vector.VectorEnv:
    return gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **arguments)


@pytest.mark.parametrize("seed", [0, 1, 12345])
@pytest.mark.parametrize("env_id", CASES)
def test_batched_equals_single_step_for_step(env_id: str, seed: int) -> None:
    generator = np.random.default_rng(seed)
    batched = make_vec(env_id, max_episode_steps=LIMIT)
    singles = [gym.make(env_id, max_episode_steps=LIMIT, disable_env_checker=True) for _ in range(NUM_ENVS)]
    for change in range(4):
        options = CASES[env_id](generator, NUM_ENVS) if change else {}
        row_options = [{name: values[row] for name, values in options.items()} for row in range(NUM_ENVS)]
        row_seeds = [seed + row if change == 0 else None for row in range(NUM_ENVS)]
        observations, infos = batched.reset(seed=seed if change == 0 else None, options=options or None)
        for row, env in enumerate(singles):
            observation, info = env.reset(seed=row_seeds[row], options=row_options[row])
            np.testing.assert_array_equal(observations[row], observation)
            assert infos["variation"][row] == info["variation"]
            assert infos["optimal_steps"][row] == info["optimal_steps"]
            assert infos["is_success"][row] == info["is_success"]
        for _ in range(STEPS):
            actions = generator.integers(batched.single_action_space.n, size=NUM_ENVS)
            compare_one_step(batched, singles, actions)


@pytest.mark.parametrize("env_id", CASES)
def test_batched_equals_single_where_episodes_succeed(env_id: str) -> None:
    generator = np.random.default_rng(2)
    batched, singles = (
        make_vec(env_id),
        [gym.make(env_id, disable_env_checker=True) for _ in range(NUM_ENVS)],
    )
    batched.reset(seed=0)
    for row, env in enumerate(singles):
        env.reset(seed=row)
    n_successes = 0
    for _ in range(150):
        planned = np.array([env.unwrapped.plan()[0] for env in singles])
        random = generator.integers(batched.single_action_space.n, size=NUM_ENVS)
        actions = np.where(generator.random(NUM_ENVS) < 0.8, planned, random)
        n_successes += compare_one_step(batched, singles, actions)
    assert n_successes > NUM_ENVS


def compare_one_step(
    batched: gym.vector.VectorEnv, singles: list[gym.Env[Any, Any]], actions: np.ndarray[Any, Any]
) -> int:
    """Step both forms, starting new episodes where they end, and return how many reached the goal."""
    observations, rewards, terminated, truncated, infos = batched.step(actions)
    for row, env in enumerate(singles):
        observation, reward, single_terminated, single_truncated, info = env.step(actions[row])
        assert (rewards[row], terminated[row], truncated[row]) == (reward, single_terminated, single_truncated)
        assert infos["is_success"][row] == info["is_success"]
        ended = single_terminated or single_truncated
        assert bool(infos.get("_final_info", np.zeros(row + 1))[row]) == ended
        if ended:
            np.testing.assert_array_equal(infos["final_obs"][row], observation)
            observation, _ = env.reset()
        np.testing.assert_array_equal(observations[row], observation)
    return int(terminated.sum())


@pytest.mark.parametrize("env_id", CASES)
class TestEveryBatchedForm:
    def test_spaces_are_those_of_the_single_form(self, env_id: str) -> None:
        batched, single = make_vec(env_id, 3), gym.make(env_id)
        assert batched.single_observation_space == single.observation_space
        assert batched.single_action_space == single.action_space
        assert batched.observation_space.shape == (3, *single.observation_space.shape)
        assert batched.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
        assert batched.observation_names == single.unwrapped.observation_names
        assert batched.action_names == single.unwrapped.action_names

    def test_returned_observations_are_not_written_to_later(self, env_id: str) -> None:
        env = make_vec(env_id)
        observations, _ = env.reset(seed=0)
        copy = observations.copy()
        for action in range(env.single_action_space.n):
            env.step(np.full(NUM_ENVS, action))
        np.testing.assert_array_equal(observations, copy)

    def test_equal_seeds_give_equal_trajectories(self, env_id: str) -> None:
        def trajectory() -> list[np.ndarray]:
            env = make_vec(env_id, max_episode_steps=20)
            env.reset(seed=7, options=CASES[env_id](np.random.default_rng(5), NUM_ENVS))
            generator = np.random.default_rng(9)
            actions = generator.integers(env.single_action_space.n, size=(50, NUM_ENVS))
            return [env.step(row)[0] for row in actions]

        np.testing.assert_array_equal(trajectory(), trajectory())

    def test_variation_stays_in_force_until_it_is_changed(self, env_id: str) -> None:
        env = make_vec(env_id)
        _, infos = env.reset(seed=0, options=CASES[env_id](np.random.default_rng(3), NUM_ENVS))
        _, later = env.reset()
        assert list(later["variation"]) == list(infos["variation"])

    @pytest.mark.parametrize(
        ("actions", "message"),
        [([0, 0], "shape"), ([0, 0, -1], "integers from 0"), ([0, 99, 0], "integers from 0")],
    )
    def test_actions_out_of_range_are_refused(self, env_id: str, actions: list[int], message: str) -> None:
        env = make_vec(env_id, 3)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=message):
            env.step(np.array(actions))


def test_seed_sequence_must_have_one_seed_per_environment() -> None:
    with pytest.raises(ValueError, match="2 seeds given for 3 environments"):
        make_vec("Hanoi-v0", 3).reset(seed=[1, 2])


def test_option_sequence_must_have_one_value_per_environment() -> None:
    with pytest.raises(ValueError, match="n_discs: 2 values given for 3 environments"):
        make_vec("Hanoi-v0", 3).reset(options={"n_discs": [1, 2]})


def test_number_of_environments_is_at_least_one() -> None:
    with pytest.raises(ValueError, match="num_envs=0"):
        make_vec("Hanoi-v0", 0)


def test_refused_variation_leaves_the_old_one_in_force() -> None:
    env = make_vec("Hanoi-v0", 2, n_discs=2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"n_discs=13 .* an integer from 1 to 12"):
        env.reset(options={"n_discs": [3, 13]})
    _, infos = env.reset()
    assert [variation["n_discs"] for variation in infos["variation"]] == [2, 2]


@pytest.mark.parametrize("env_id", DOMAINS)
def test_ended_episodes_are_told_in_the_form_of_gymnasium(env_id: str) -> None:
    limited = partial(gym.make, env_id, max_episode_steps=5)
    theirs = SyncVectorEnv([limited] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    ours = make_vec(env_id, 3, max_episode_steps=5)
    theirs.reset(seed=0)
    ours.reset(seed=0)
    ours.action_space.seed(0)
    for step in range(1, 8):
        actions = ours.action_space.sample()
        (*_, expected), (*_, infos) = theirs.step(actions), ours.step(actions)
        names = {name for name in expected if "final" in name}
        assert {name for name in infos if "final" in name} == names
        assert step != 5 or names == {"final_obs", "_final_obs", "final_info", "_final_info"}
        if names:
            np.testing.assert_array_equal(infos["_final_obs"], expected["_final_obs"])
            np.testing.assert_array_equal(infos["_final_info"], expected["_final_info"])
            for row in np.flatnonzero(infos["_final_info"]):
                np.testing.assert_array_equal(infos["final_obs"][row], expected["final_obs"][row])
                assert infos["final_info"].keys() == expected["final_info"].keys()
                for name, values in infos["final_info"].items():
                    assert tuple(np.ravel(values[row])) == tuple(np.ravel(expected["final_info"][name][row]))
    theirs.close()
    ours.close()
