"""Starts in the middle: episodes that begin with some of their objects finished."""

import copy
import math

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS

PLANNING = ("Hiking-v0", "Hiking-v1", "HikingEgo-v0", "Stacking-v0")
PANDA = ("PandaReach-v0", "PandaPush-v0", "PandaSlide-v0", "PandaStack-v0")


def make(env_id, size=3, **arguments):
    return gym.make(env_id, **{DOMAINS[env_id].size: size, **arguments})


def n_left(env):
    env = env.unwrapped
    if hasattr(env, "task"):
        return env.task.finished.count(False)
    return len(env.state["stars" if "stars" in env.state else "plates"])


@pytest.mark.parametrize("env_id", PLANNING + PANDA)
def test_so_many_are_finished_and_the_plan_finishes_the_others(env_id):
    env = make(env_id, 5, n_done=3)
    for seed in range(2):
        _, info = env.reset(seed=seed)
        assert info["variation"]["n_done"] == 3
        assert n_left(env) == 2
        actions = env.unwrapped.plan()
        for taken, action in enumerate(actions):
            *_, terminated, _, info = env.step(action)
            if not taken:
                assert n_left(env) <= 2, "what is finished stays so"
        assert terminated
        assert info["is_success"]
    _, info = env.reset(options={"n_done": 0})
    assert n_left(env) == 5
    assert info["variation"] == gym.make(env_id).reset(options={DOMAINS[env_id].size: 5})[1]["variation"]


@pytest.mark.parametrize("env_id", PLANNING + PANDA)
def test_what_is_drawn_does_not_depend_on_how_many_are_finished(env_id):
    whole, begun = make(env_id), make(env_id, n_done=1)
    for seed in range(3):
        whole.reset(seed=seed)
        begun.reset(seed=seed)
        if env_id in PANDA:
            states = [env.unwrapped.start for env in (whole, begun)]
            assert states[1] == {**states[0], "n_done": 1}
        elif env_id == "Stacking-v0":
            states = [env.unwrapped.state for env in (whole, begun)]
            assert states[1] == {**states[0], "plates": states[0]["plates"][1:]}
        else:
            states = [env.unwrapped.state for env in (whole, begun)]
            (collected,) = [star for star in states[0]["stars"] if star not in states[1]["stars"]]
            assert states[1]["hiker"] == collected
    assert whole.unwrapped.np_random.random() == begun.unwrapped.np_random.random()


@pytest.mark.parametrize("env_id", PLANNING + PANDA)
def test_random_numbers_are_drawn_anew_for_every_episode(env_id):
    n_episodes = 20 if env_id in PANDA else 200
    env = make(env_id, n_done="random")
    env.reset(seed=0)
    left = []
    for _ in range(n_episodes):
        _, info = env.reset()
        assert info["variation"]["n_done"] == "random"
        left.append(n_left(env))
    assert set(left) == {1, 2, 3}
    assert max(map(left.count, left)) < 0.6 * n_episodes


@pytest.mark.parametrize("env_id", PLANNING + PANDA)
@pytest.mark.parametrize("n_done", [2, "random"])
def test_batched_environments_begin_as_single_ones(env_id, n_done):
    size, n = DOMAINS[env_id].size, 3
    batch = gym.make_vec(
        env_id, num_envs=n, vectorization_mode="vector_entry_point", max_episode_steps=2, **{size: 3}, n_done=n_done
    )
    singles = [make(env_id, n_done=n_done, max_episode_steps=2) for _ in range(n)]
    observations, infos = batch.reset(seed=7)
    for row, env in enumerate(singles):
        observation, info = env.reset(seed=7 + row)
        np.testing.assert_array_equal(observation, observations[row])
        assert info["variation"] == infos["variation"][row]
        if "optimal_steps" in info:
            assert info["optimal_steps"] == infos["optimal_steps"][row]
    for _ in range(4):  # through the ends of two episodes
        actions = np.stack([env.action_space.sample() for env in singles])
        observations, rewards, *_ = batch.step(actions)
        for row, env in enumerate(singles):
            observation, reward, terminated, truncated, _ = env.step(actions[row])
            if terminated or truncated:
                observation, _ = env.reset()
            np.testing.assert_array_equal(observation, observations[row])
            assert reward == pytest.approx(rewards[row])


@pytest.mark.parametrize("env_id", PLANNING + PANDA)
def test_something_is_left_to_be_done(env_id):
    size = DOMAINS[env_id].size
    for n_done, message in ((3, f"n_done=3 is not accepted with {size}=3"), (-1, "n_done=-1"), ("all", "n_done='all'")):
        with pytest.raises(ValueError, match=message):
            make(env_id, n_done=n_done)
    env = make(env_id, n_done=2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"n_done=2 is not accepted with {size}=2"):
        env.reset(options={size: 2})
    env.reset(options={size: 2, "n_done": "random"})


@pytest.mark.parametrize("env_id", PLANNING + PANDA)
def test_it_is_no_part_of_the_observation(env_id):
    shapes = {make(env_id, context="observed", n_done=n_done).observation_space.shape for n_done in (0, 1, "random")}
    names = DOMAINS[env_id].space.context_names
    plain = gym.make(env_id).observation_space.shape[0]
    assert shapes == {(plain + len(names),)}
    assert "n_done" not in names


def test_hanoi_has_none_and_says_why():
    with pytest.raises(TypeError, match="n_done"):
        gym.make("Hanoi-v0", n_done=1)
    assert "n_done" in type(gym.make("Hanoi-v0").unwrapped).__doc__


@pytest.mark.parametrize(("env_id", "variation", "count"), [
    ("Stacking-v0", {"n_plates": 3, "n_done": 2}, 25 * 25),
    ("Stacking-v0", {"n_plates": 8, "n_done": 7}, 25 * 25),
    ("HikingEgo-v0", {"n_stars": 2, "n_done": 1, "layout": ["H..", ".#."]}, 4 * 3),
    ("Hiking-v0", {"n_stars": 3, "n_done": 1, "layout": ["H..", ".#."]}, 6 * 2),
])  # fmt: skip
def test_starts_in_the_middle_are_counted(env_id, variation, count):
    venv = gym.make_vec(env_id, num_envs=count, vectorization_mode="vector_entry_point").unwrapped
    assert venv.count_starts(variation) == count
    observations, single = venv.reset_to(variation, np.arange(count)), gym.make(env_id)
    assert len(np.unique(observations, axis=0)) == count
    for row in range(0, count, 7):
        observation, info = single.reset(options=venv.state_of(row))
        np.testing.assert_array_equal(observation, observations[row])
        assert info["optimal_steps"] == venv.optimal_steps()[row]
    with pytest.raises(ValueError, match="cannot be counted"):
        venv.count_starts({**variation, "n_done": "random"})


# ----------------------------------------------------------------------------------------------------------- Panda


@pytest.mark.parametrize("env_id", PANDA)
def test_a_start_in_the_middle_is_begun_again_and_copied(env_id):
    env = make(env_id, n_done="random")
    env.reset(seed=4)
    while env.unwrapped.task.n_done == 0:
        env.reset()
    start, action = env.unwrapped.start, np.array([0.3, -0.2, 0.4, 1.0], np.float32)
    other = gym.make(env_id)
    observation, _ = other.reset(options=start)
    copied = copy.deepcopy(env.unwrapped)
    np.testing.assert_array_equal(env.unwrapped._observation(), observation)
    for _ in range(5):
        expected = env.step(action)
        for found in (other.step(action), copied.step(action)):
            np.testing.assert_array_equal(found[0], expected[0])
            assert found[1] == expected[1]


def test_the_gripper_is_where_it_finished_the_last_one():
    for env_id in PANDA:
        env = make(env_id, n_done=2)
        for seed in range(3):
            observation, _ = env.reset(seed=seed)
            task, gripper = env.unwrapped.task, observation[:3]
            done = np.array(task.targets[1])
            if env_id == "PandaReach-v0":
                np.testing.assert_allclose(gripper, done, atol=1e-3)
            elif env_id == "PandaPush-v0":
                assert gripper[2] == pytest.approx(0.02, abs=1e-3)
                way = done[:2] - task.starts[1][:2]
                np.testing.assert_allclose(done[:2] - gripper[:2], 0.05 * way / math.hypot(*way), atol=1e-3)
            elif env_id == "PandaStack-v0":
                np.testing.assert_allclose(gripper, np.add(done, (0, 0, 0.06)), atol=1e-3)
                assert observation[6] == pytest.approx(0.08)
            else:
                np.testing.assert_array_equal(observation[:7], gym.make(env_id).reset(seed=0)[0][:7])


@pytest.mark.parametrize("env_id", ["PandaPush-v0", "PandaSlide-v0", "PandaStack-v0"])
def test_nothing_touches_at_the_start(env_id):
    still = np.zeros(4, np.float32)
    for size in (4, 8):
        env = make(env_id, size, n_done=size - 1)
        for seed in range(10):
            env.reset(seed=seed)
            before = env.unwrapped.task.positions
            for _ in range(5):
                *_, info = env.step(still)
            assert not info["is_failure"]
            assert n_left(env) == 1
            np.testing.assert_allclose(env.unwrapped.task.positions, before, atol=2e-3)


def test_delivered_pucks_are_off_the_table():
    env = make("PandaSlide-v0", n_done=2)
    env.reset(seed=0)
    env.unwrapped.scene.read()
    assert [position[2] < -1 for position in env.unwrapped.scene.positions] == [True, True, False]
    np.testing.assert_allclose(env.unwrapped.task.positions[:2], env.unwrapped.task.targets[:2])


def test_starts_that_are_given_do_not_overlap_with_what_is_finished():
    given = {"targets": [[0.0, 0.1], [0.1, -0.1]], "starts": [[-0.2, 0.1], [0.0, 0.12]]}
    env = make("PandaPush-v0", 2)
    env.reset(options=given)
    with pytest.raises(ValueError, match="1 finished and 1 others: objects 0 and 1 overlap"):
        env.reset(options={**given, "n_done": 1})
    env.reset(options={**given, "starts": [[0.0, 0.11], [-0.2, 0.0]], "n_done": 1})
    assert env.unwrapped.task.positions[0][:2] == (0.0, 0.1), "it is where its target is"


def test_a_begun_tower_is_that_of_n_done_with_the_arm_in_its_neutral_pose():
    begun, given = make("PandaStack-v0", 4), make("PandaStack-v0", 4, n_done=2)
    begun.reset(seed=3)
    observation, middle = begun.unwrapped.begin_tower(2), given.reset(seed=3)[0]
    assert begun.unwrapped.task.positions == given.unwrapped.task.positions
    assert begun.unwrapped.task.finished == given.unwrapped.task.finished == [True, True, False, False]
    np.testing.assert_array_equal(observation[:7], make("PandaStack-v0", 4).reset(seed=0)[0][:7])
    np.testing.assert_array_equal(observation[13:16], middle[13:16])
    assert begun.unwrapped.start == given.unwrapped.start
