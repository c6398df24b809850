"""The Panda environments: checkers, determinism, variations, rewards, physics and controllers."""

from __future__ import annotations

import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pybullet
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium_robotics.core import GoalEnv
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import progpolicy_envs
from progpolicy_envs.panda.robot import arm_angles
from progpolicy_envs.panda.scene import BULLET_MARGIN, CONTROL_STEP, PANDA_GYM_PHYSICS, Physics, Scene
from progpolicy_envs.panda.tasks import Push, Slide, Stack
from progpolicy_envs.planners.panda import CONTROLLERS

IDS = ("PandaReach-v0", "PandaPush-v0", "PandaSlide-v0", "PandaStack-v0")
OBJECT_IDS = IDS[1:]


def size_of(env_id: str) -> str:
    return progpolicy_envs.get_domain(env_id).size


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
        progpolicy_envs_panda().PandaPushEnv(**{keyword: "nonsense"})


def progpolicy_envs_panda():
    import progpolicy_envs.panda

    return progpolicy_envs.panda


def test_bad_actions_are_refused_and_large_ones_clipped():
    env = make("PandaReach-v0")
    env.reset(seed=0)
    for wrong in (np.zeros(3), np.array([np.nan, 0, 0, 0])):
        with pytest.raises(ValueError, match="4 finite numbers"):
            env.step(wrong)
    clipped = env.step(np.full(4, 50.0, np.float32))[0]
    env.reset(seed=0)
    assert np.array_equal(env.step(np.ones(4, np.float32))[0], clipped)


@pytest.mark.parametrize("env_id", IDS)
def test_goal_form_holds_the_flat_numbers_and_computes_the_step_reward(env_id):
    for reward_type in ("dense", "sparse"):
        flat = make(env_id, 3, reward_type=reward_type)
        goal = make(env_id, 3, observation="goal", reward_type=reward_type)
        numbers, _ = flat.reset(seed=4)
        parts, _ = goal.reset(seed=4)
        infos, rewards, achieved, desired = [], [], [], []
        for _ in range(60):
            action = CONTROLLERS[env_id](numbers)
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
            if terminated:
                break
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


def gripper_with(scene: Scene, angles: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return position and orientation of the gripper at arm angles."""
    for joint, angle in enumerate(angles):
        pybullet.resetJointState(scene.robot.body, joint, angle, 0.0, scene.client)
    link = pybullet.getLinkState(scene.robot.body, 11, False, True, scene.client)
    return np.array(link[0]), np.array(link[1])


def test_arm_angles_bring_the_gripper_exactly_where_it_shall_be_pointing_down():
    scene = Scene(Push.table, None)
    for place in np.random.default_rng(0).uniform((-0.3, -0.3, 0.0), (0.1, 0.3, 0.3), (50, 3)):
        position, orientation = gripper_with(scene, arm_angles(*place))
        assert position == pytest.approx(place, abs=1e-6)
        assert np.abs(orientation) == pytest.approx((1, 0, 0, 0), abs=1e-6)
    scene.close()


@pytest.mark.parametrize(
    "place", [(2.0, 0.5, 0.1), (-0.6, 0.0, 0.2), (-0.5, 0.0, 1.5), (-1.2, 0.1, 0.0), (-0.4, 0.0, -3.0)]
)
def test_arm_angles_stay_within_the_limits_where_the_arm_cannot_reach(place):
    scene = Scene(Push.table, None)
    for joint, angle in enumerate(arm_angles(*place)):
        low, high = pybullet.getJointInfo(scene.robot.body, joint, scene.client)[8:10]
        assert low < angle < high
    scene.close()


@pytest.mark.parametrize("direction", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, 1), (0.7, -0.7, 0)])
def test_gripper_goes_straight_where_the_action_says(direction):
    env = make("PandaReach-v0", 8)
    env.reset(seed=0)
    robot = env.unwrapped.scene.robot
    env.step(np.array([*direction, 0], np.float32))
    begin = np.array(robot.position)
    for _ in range(4):
        env.step(np.array([*direction, 0], np.float32))
    way = np.array(robot.position) - begin
    along = way @ np.array(direction) / np.linalg.norm(direction)
    assert along > 4 * 0.5 * 0.05 * np.linalg.norm(direction) * 0.85
    assert np.linalg.norm(way - along * np.array(direction) / np.linalg.norm(direction)) < 0.05 * along


def wake(scene, body):
    pybullet.changeDynamics(body, -1, activationState=pybullet.ACTIVATION_STATE_WAKE_UP, physicsClientId=scene.client)


def settle(scene: Scene, seconds: float) -> np.ndarray:
    for _ in range(round(30 * seconds)):
        scene.step()
    return np.array(scene.positions)


def test_dropped_block_comes_to_rest_on_the_table():
    scene = Scene(Push.table, Push.kind)
    scene.place([(-0.1, 0.2, 0.12)])
    positions = settle(scene, 2)
    assert positions[0] == pytest.approx((-0.1, 0.2, 0.02), abs=2e-3)
    assert np.linalg.norm(scene.object_state(0).velocity) < 1e-3
    scene.close()


def test_stack_of_eight_stands_for_ten_seconds_awake_or_not():
    for sleeping in (True, False):
        scene = Scene(Stack.table, Stack.kind, Physics(sleeping=sleeping))
        offsets = np.random.default_rng(0).uniform(-0.004, 0.004, (8, 2))
        scene.place([(x, 0.2 + y, 0.02 + 0.04 * level) for level, (x, y) in enumerate(offsets.tolist())])
        begin = settle(scene, 0.2)
        assert np.abs(settle(scene, 10) - begin).max() < 0.01
        scene.close()


def substeps(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return how many physics steps the next control step takes."""
    calls = []
    step = pybullet.stepSimulation
    with monkeypatch.context() as patch:
        patch.setattr(pybullet, "stepSimulation", lambda client: (calls.append(client), step(client)))
        engine = pybullet.getPhysicsEngineParameters(scene.client)
        scene.step()
    assert len(calls) * engine["fixedTimeStep"] == pytest.approx(CONTROL_STEP)
    return len(calls) * engine["numSubSteps"]


def test_physics_are_finer_while_something_is_off_the_table_or_between_the_fingers(monkeypatch):
    scene = Scene(Push.table, Push.kind)
    coarse, fine = Physics().substeps, Physics().delicate_substeps
    gripper = scene.robot.position
    parameters = {
        "on the table": ([(-0.1, 0.2, 0.02)], coarse, 10),
        "in the air": ([(-0.1, 0.2, 0.12)], fine, 60),
        "between the fingers": ([(gripper[0] + 0.01, gripper[1], gripper[2])], fine, 60),
    }
    for positions, steps, iterations in parameters.values():
        scene.place(positions)
        engine = pybullet.getPhysicsEngineParameters(scene.client)
        assert engine["numSolverIterations"] == iterations
        assert substeps(scene, monkeypatch) == steps
    scene.close()


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("physics", [Physics(), Physics(frequency=180, substeps=6, delicate_substeps=12)])
def test_physics_steps_made_in_one_call_are_those_made_in_many(env_id, physics, monkeypatch):
    if env_id in ("PandaPush-v0", "PandaSlide-v0"):
        # A rigid body that is woken in a call has its weight from the next call on, so here none sleeps.
        physics = replace(physics, sleeping=False)

    def trajectory():
        env = make(env_id, 3, physics=physics)
        controller = CONTROLLERS[env_id]
        observation, _ = env.reset(seed=1)
        observations = [observation]
        for _ in range(60):
            observations.append(env.step(controller(observations[-1]))[0])
        env.close()
        return np.array(observations)

    few = trajectory()
    in_order = Scene._set_steps
    monkeypatch.setattr(Scene, "_set_steps", lambda scene, calls, each: in_order(scene, calls * each, 1))
    assert np.array_equal(few, trajectory())


def push_off(scene: Scene, velocity: tuple[float, float, float]) -> None:
    """Wake the first object and give it a velocity, in metres per second."""
    wake(scene, scene.objects[0])
    scene.step()
    pybullet.resetBaseVelocity(scene.objects[0], velocity, physicsClientId=scene.client)


@pytest.mark.parametrize(("physics", "tolerance"), [(Physics(), 0.02), (PANDA_GYM_PHYSICS, 0.05)])
def test_a_puck_slides_as_far_as_friction_and_damping_let_it(physics, tolerance):
    speed, friction, gravity, damping = 0.4, Slide.kind.friction * 0.5, 9.81, 0.04
    expected = speed / damping - friction * gravity / damping**2 * np.log1p(damping * speed / (friction * gravity))
    scene = Scene(Slide.table, Slide.kind, physics)
    scene.place([(-0.1, 0.2, 0.015)])
    push_off(scene, (speed, 0, 0))
    assert settle(scene, 3)[0, 0] + 0.1 == pytest.approx(expected, rel=tolerance)
    scene.close()


@pytest.mark.parametrize("task", [Push, Slide, Stack])
@pytest.mark.parametrize(("vx", "vy"), [(1.0, 0.0), (0.7, 0.7), (0.3, -0.1)])
def test_what_slides_goes_straight_and_neither_sinks_in_nor_tilts(task, vx, vy):
    scene = Scene(task.table, task.kind)
    height = task.kind.height
    scene.place([(-0.3, -0.1, height)])
    push_off(scene, (vx, vy, 0))
    for _ in range(15):
        scene.step()
        (x, y, z), (qx, qy, _, _) = pybullet.getBasePositionAndOrientation(scene.objects[0], scene.client)
        assert z == pytest.approx(height, abs=2e-4)
        assert 2 * np.hypot(qx, qy) < 0.005, "radians from upright"
        way_x, way_y = x + 0.3, y + 0.1
        assert way_x * vy - way_y * vx == pytest.approx(0, abs=0.02 * np.hypot(way_x, way_y))
    scene.close()


def test_a_puck_turns_as_lightly_as_a_cylinder():
    scene = Scene(Slide.table, Slide.kind)
    mass, _, inertia = pybullet.getDynamicsInfo(scene.objects[0], -1, scene.client)[:3]
    (radius, _, half), kind = Slide.kind.half_extents, Slide.kind
    across = kind.mass * (radius**2 / 4 + half**2 / 3)
    assert (mass, *inertia) == pytest.approx((kind.mass, across, across, kind.mass * radius**2 / 2))
    scene.close()


def test_a_block_at_rest_falls_asleep_and_falls_when_what_bears_it_is_taken_away():
    scene = Scene(Stack.table, Stack.kind)
    scene.place([(-0.1, 0.2, 0.02), (-0.1, 0.2, 0.06)])
    settle(scene, 1)
    asleep = scene.positions[1]
    settle(scene, 0.2)
    assert scene.positions[1] == asleep, "a sleeping block does not move by a single bit"
    wake(scene, scene.objects[0])
    scene.step()
    pybullet.resetBaseVelocity(scene.objects[0], (3, 0, 0), physicsClientId=scene.client)
    assert settle(scene, 1)[1, 2] == pytest.approx(0.02, abs=2e-3)
    scene.close()


def test_other_worlds_of_the_process_keep_their_margin_around_bodies():
    env = make("PandaPush-v0", 3)
    env.reset(seed=0)
    assert env.unwrapped.scene.physics.margin < BULLET_MARGIN
    other = pybullet.connect(pybullet.DIRECT)
    box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[0.1] * 3, physicsClientId=other)
    body = pybullet.createMultiBody(1, box, physicsClientId=other)
    for beyond, found in ((0.9, True), (1.1, False)):
        env.step(env.action_space.sample())
        pybullet.performCollisionDetection(physicsClientId=other)
        spot = (0.1 + beyond * BULLET_MARGIN, 0, 0)
        near = pybullet.getOverlappingObjects(spot, spot, physicsClientId=other) or ()
        assert (body in [near_body for near_body, _ in near]) == found
    pybullet.disconnect(other)
    env.close()


def test_pushed_block_does_not_tunnel_through_another():
    scene = Scene(Push.table, Push.kind)
    scene.place([(-0.1, 0.0, 0.02), (0.0, 0.0, 0.02)])
    for block in scene.objects[:2]:
        wake(scene, block)
    scene.step()
    pybullet.resetBaseVelocity(scene.objects[0], (2, 0, 0), physicsClientId=scene.client)
    (first, *_), (second, *_) = settle(scene, 1).tolist()
    assert second > 0.02
    assert second - first > 0.035
    scene.close()


def test_gripper_wakes_a_sleeping_block_and_pushes_it():
    env = make("PandaPush-v0")
    observation, _ = env.reset(seed=0)
    begin = observation[26:29].copy()
    for _ in range(100):
        observation = env.step(np.zeros(4, np.float32))[0]
    assert observation[26:29] == pytest.approx(begin, abs=1e-3)
    for _ in range(60):
        observation, _, terminated, _, info = env.step(CONTROLLERS["PandaPush-v0"](observation))
        if terminated:
            break
    assert info["is_success"]


@pytest.mark.parametrize(("env_id", "size"), [(env_id, size) for env_id in IDS for size in (1, 3)])
def test_controller_solves_small_variations(env_id, size):
    env = gym.make(env_id, disable_env_checker=True)
    for seed in range(100, 103):
        observation, _ = env.reset(seed=seed, options={size_of(env_id): size})
        terminated = truncated = False
        while not (terminated or truncated):
            observation, _, terminated, truncated, info = env.step(CONTROLLERS[env_id](observation))
        assert info["is_success"], (env_id, size, seed)


@pytest.mark.parametrize("env_id", IDS)
def test_dense_return_of_the_controller_beats_standing_still(env_id):
    returns = []
    for control in (CONTROLLERS[env_id], lambda _: np.zeros(4, np.float32)):
        env = make(env_id)
        observation, _ = env.reset(seed=1)
        total = 0.0
        for _ in range(100):
            observation, reward, terminated, _, _ = env.step(control(observation))
            total += reward
            if terminated:
                break
        returns.append(total)
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
