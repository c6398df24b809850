"""The Panda environments: checkers, determinism, variations, rewards and controllers."""

from __future__ import annotations

import inspect
import pickle
import warnings
from itertools import islice, repeat

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import load_env_creator
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium_robotics.core import GoalEnv
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from progpolicy_envs import DOMAINS

pybullet = pytest.importorskip("pybullet", reason="pybullet is not installed")
from progpolicy_envs.panda import PandaPushEnv, PandaPushGoalEnv, make_push  # noqa: E402
from progpolicy_envs.panda.tasks import Slide  # noqa: E402

IDS = [domain.id for domain in DOMAINS.values() if domain.simulation]
OBJECT_IDS = [env_id for env_id in IDS if DOMAINS[env_id].size == "n_objects"]


def size_of(env_id: str) -> str:
    return DOMAINS[env_id].size


def make(env_id: str, size: int = 1, **kwargs):
    return gym.make(env_id, disable_env_checker=True, **{size_of(env_id): size}, **kwargs)


def rollout(env, env_id: str, seed: int, size: int, steps: int = 80) -> np.ndarray:
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed, options={size_of(env_id): size})
    trajectory = [np.append(observation, 0.0)]
    for _ in range(steps):
        # A bias downwards makes the gripper meet objects and the table.
        action = np.clip(rng.uniform((-1, -1, -1.3, -1), (1, 1, 0.7, 1)), -1, 1).astype(np.float32)
        observation, reward, terminated, _, _ = env.step(action)
        trajectory.append(np.append(observation, reward))
        if terminated:
            break
    return np.array(trajectory)


@pytest.mark.parametrize("env_id", IDS)
def test_checkers_are_silent_for_every_option_at_smallest_and_largest_size(env_id):
    for size, observation, reward_type in ((1, "flat", "dense"), (8, "goal", "sparse"), (1, "goal", "dense")):
        env = make(env_id, size, observation=observation, reward_type=reward_type)
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            sb3_check_env(env.unwrapped, skip_render_check=True)
            gymnasium_check_env(env.unwrapped, skip_render_check=True)
        assert isinstance(env.unwrapped, GoalEnv) == (observation == "goal")
        env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_equal_seeds_give_equal_trajectories_whatever_was_played_before(env_id):
    plan = ((0, 8), (1, 1), (2, 3))
    env = make(env_id)
    first = [rollout(env, env_id, seed, size) for seed, size in plan]
    for index in (2, 0, 1, 0):
        assert np.array_equal(rollout(env, env_id, *plan[index]), first[index])
    other = make(env_id)
    assert np.array_equal(rollout(other, env_id, *plan[1]), first[1])
    assert not np.array_equal(rollout(other, env_id, 5, 1)[0], first[1][0])
    for trajectory in first:
        assert np.isfinite(trajectory).all()
        assert np.abs(trajectory[:, :32]).max() <= 10


@pytest.mark.parametrize("env_id", IDS)
def test_variation_is_set_by_constructor_or_options_and_stays_in_force(env_id):
    name = size_of(env_id)
    env = make(env_id, 3)
    observation, info = env.reset(seed=0)
    assert info["variation"] == {name: 3}
    assert observation[25] == pytest.approx(3 / 8)
    assert env.reset(options={name: 5})[1]["variation"] == {name: 5}
    assert env.reset()[1]["variation"] == {name: 5}
    for wrong in (0, 9, 2.5, "2"):
        with pytest.raises(ValueError, match=f"{name}=.*{wrong}.*1 to 8"):
            env.reset(options={name: wrong})
    with pytest.raises(ValueError, match="n_disks"):
        env.reset(options={"n_disks": 1})
    assert env.reset()[1]["variation"] == {name: 5}


@pytest.mark.parametrize("keyword", ["observation", "reward_type", "render_mode"])
def test_unknown_options_are_refused_by_name(keyword):
    with pytest.raises(ValueError, match=f"{keyword}='nonsense'"):
        make_push(**{keyword: "nonsense"})


def test_bad_actions_are_refused_and_large_ones_clipped():
    env = make("PandaReach-v0")
    env.reset(seed=0)
    for wrong in (np.zeros(3), np.array([np.nan, 0, 0, 0])):
        with pytest.raises(ValueError, match="4 finite numbers"):
            env.step(wrong)
    clipped = env.step(np.full(4, 50.0, np.float32))[0]
    env.reset(seed=0)
    assert np.array_equal(env.step(np.ones(4, np.float32))[0], clipped)


def test_each_form_is_a_class_of_its_own_and_only_the_goal_form_computes_rewards():
    for observation, env_class in (("flat", PandaPushEnv), ("goal", PandaPushGoalEnv)):
        env = make("PandaPush-v0", observation=observation).unwrapped
        assert type(env) is pickle.loads(pickle.dumps(env_class)) is env_class
        assert isinstance(env, PandaPushEnv)
        assert isinstance(env, GoalEnv) == hasattr(env, "compute_reward") == (observation == "goal")
        env.close()


@pytest.mark.parametrize("env_id", IDS)
def test_docstring_is_complete_and_about_its_own_task(env_id):
    text = inspect.getdoc(load_env_creator(gym.spec(env_id).entry_point))
    assert "$" not in text
    assert f'gym.make("{env_id}", {size_of(env_id)}=5)' in text
    headings = [line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")]
    assert headings[:4] == ["Description", "Action Space", "Observation Space", "Rewards"]
    assert headings[4:] == [
        *("Starting State", "Episode End", "Information", "Arguments", "References", "Version History")
    ]


@pytest.mark.parametrize("env_id", IDS)
def test_goal_form_holds_the_flat_numbers_and_computes_the_step_reward(env_id):
    for reward_type in ("dense", "potential", "sparse"):
        flat = make(env_id, 3, reward_type=reward_type)
        goal = make(env_id, 3, observation="goal", reward_type=reward_type)
        flat.reset(seed=4)
        goal.reset(seed=4)
        infos, rewards, achieved, desired = [], [], [], []
        for action in islice(goal.unwrapped.plan(), 60):
            numbers, reward, *_ = flat.step(action)
            parts, goal_reward, terminated, _, info = goal.step(action)
            assert np.array_equal(
                numbers, np.concatenate([parts[key] for key in ("observation", "achieved_goal", "desired_goal")])
            )
            assert goal_reward == pytest.approx(reward, abs=1e-4)
            infos.append(info)
            rewards.append(reward)
            achieved.append(parts["achieved_goal"])
            desired.append(parts["desired_goal"])
            assert goal.unwrapped.compute_terminated(achieved[-1], desired[-1], info) == terminated
        assert infos
        computed = goal.unwrapped.compute_reward(np.array(achieved), np.array(desired), infos)
        assert computed == pytest.approx(np.array(rewards), abs=1e-4)
    with pytest.raises(ValueError, match="copy_info_dict=True"):
        make(env_id, observation="goal").unwrapped.compute_reward(np.zeros((1, 3)), np.zeros((1, 3)), [{}])


@pytest.mark.parametrize("env_id", OBJECT_IDS)
def test_starts_do_not_overlap_and_lie_on_the_table(env_id):
    env = make(env_id, 8)
    for seed in range(20):
        env.reset(seed=seed)
        task = env.unwrapped.task
        positions = np.array(task.positions)[:, :2]
        gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + 9 * np.eye(8)
        assert gaps.min() > (0.09 if task.kind.shape == "cylinder" else 0.069)
        assert (np.hypot(positions[:, 0] + 0.6, positions[:, 1]) < 0.75).all()
        if isinstance(task, Slide):
            assert (np.array(task.targets)[:, 0] + 0.6 > 0.88).all()


def test_focus_is_on_the_first_unfinished_object_and_returns_to_a_disturbed_one():
    env = make("PandaPush-v0", 3)
    env.reset(seed=0)
    scene, task = env.unwrapped.scene, env.unwrapped.task
    still = np.zeros(4, np.float32)
    assert task.focus == 0
    start = scene.positions[0]
    for where, focus, left in ((task.targets[0], 1, 2), (start, 0, 3)):
        pybullet.resetBasePositionAndOrientation(scene.objects[0], where, (0, 0, 0, 1), scene.client)
        observation = env.step(still)[0]
        assert task.focus == focus
        assert observation[25] == pytest.approx(left / 8)
        assert observation[26:29] == pytest.approx(task.positions[focus], abs=1e-6)
        assert observation[29:32] == pytest.approx(task.targets[focus], abs=1e-6)


def test_line_features_agree_with_the_positions():
    env = make("PandaPush-v0", 2)
    observation, _ = env.reset(seed=3)
    value = dict(zip(env.unwrapped.observation_names, observation.tolist(), strict=True))
    line = np.array([value["target_x"] - value["object_x"], value["target_y"] - value["object_y"]])
    offset = np.array([value["gripper_x"] - value["object_x"], value["gripper_y"] - value["object_y"]])
    unit = line / np.linalg.norm(line)
    assert value["distance"] == pytest.approx(np.linalg.norm(line), abs=1e-5)
    assert [value["line_x"], value["line_y"]] == pytest.approx(unit, abs=1e-5)
    assert value["along"] == pytest.approx(offset @ unit, abs=1e-5)
    assert value["across"] == pytest.approx(unit[0] * offset[1] - unit[1] * offset[0], abs=1e-5)
    assert value["reach"] == pytest.approx(np.linalg.norm(offset), abs=1e-5)


@pytest.mark.parametrize("env_id", OBJECT_IDS)
def test_object_that_leaves_the_table_ends_the_episode_as_a_failure(env_id):
    env = make(env_id, 2)
    env.reset(seed=0)
    scene = env.unwrapped.scene
    pybullet.resetBasePositionAndOrientation(scene.objects[1], (0.9, 0, -0.1), (0, 0, 0, 1), scene.client)
    _, reward, terminated, truncated, info = env.step(np.zeros(4, np.float32))
    assert terminated
    assert not truncated
    assert not info["is_success"]
    assert reward < -4


def test_sliding_puck_counts_once_inside_its_disc_and_leaves_the_table():
    env = make("PandaSlide-v0", 2)
    env.reset(seed=0)
    scene, task = env.unwrapped.scene, env.unwrapped.task
    pybullet.resetBasePositionAndOrientation(scene.objects[0], task.targets[0], (0, 0, 0, 1), scene.client)
    for _ in range(3):
        _, _, terminated, _, info = env.step(np.zeros(4, np.float32))
    assert task.finished == [True, False]
    assert not terminated
    assert not info["is_success"]
    assert scene.positions[0][0] > 5


def test_gripper_wakes_a_sleeping_block_and_pushes_it():
    env = make("PandaPush-v0")
    observation, _ = env.reset(seed=0)
    begin = observation[26:29].copy()
    for _ in range(100):
        observation = env.step(np.zeros(4, np.float32))[0]
    assert observation[26:29] == pytest.approx(begin, abs=1e-3)
    *_, (*_, info) = (env.step(action) for action in islice(env.unwrapped.plan(), 60))
    assert info["is_success"]


@pytest.mark.parametrize(("env_id", "size"), [(env_id, size) for env_id in IDS for size in (1, 3)])
def test_plan_solves_small_variations_and_ends_with_the_episode(env_id, size):
    env = gym.make(env_id, disable_env_checker=True)
    for seed in range(100, 103):
        env.reset(seed=seed, options={size_of(env_id): size})
        for action in env.unwrapped.plan():
            _, _, terminated, truncated, info = env.step(action)
            assert not truncated
        assert terminated
        assert info["is_success"], (env_id, size, seed)


@pytest.mark.parametrize("env_id", IDS)
def test_dense_return_of_the_controller_beats_standing_still(env_id):
    returns = []
    for planned in (True, False):
        env = make(env_id)
        env.reset(seed=1)
        actions = env.unwrapped.plan() if planned else repeat(np.zeros(4, np.float32))
        returns.append(sum(env.step(action)[1] for action in islice(actions, 100)))
    assert returns[0] > returns[1] + 1


def test_picture_shows_object_and_target_in_the_same_hue_and_changes_with_the_state():
    env = make("PandaPush-v0", render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (360, 480, 3)
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    reddish = (red > green + 40) & (red > blue + 40)
    assert reddish.sum() > 100
    env.reset(seed=1)
    assert not np.array_equal(env.render(), picture)
    env.close()


@pytest.mark.slow
def test_sac_with_hindsight_learns_to_reach():
    env = make("PandaReach-v0", observation="goal", reward_type="sparse", max_episode_steps=30)
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        learning_starts=300,
        gamma=0.9,
        tau=0.05,
        learning_rate=2e-3,
        ent_coef="auto_0.05",
        policy_kwargs={"net_arch": [64, 64]},
        seed=0,
    )
    model.learn(2000)
    solved = 0
    for seed in range(10):
        observation, _ = env.reset(seed=1000 + seed)
        terminated = truncated = False
        while not (terminated or truncated):
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
        solved += info["is_success"]
    assert solved >= 8
