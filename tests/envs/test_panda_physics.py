"""The Panda robot and its world: kinematics, contacts, sleep, and how finely all of it is simulated."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS

pybullet = pytest.importorskip("pybullet", reason="pybullet is not installed")
from progpolicy_envs.panda.physics import BULLET_MARGIN, CONTROL_STEP, PANDA_GYM_PHYSICS, Physics  # noqa: E402
from progpolicy_envs.panda.robot import arm_angles  # noqa: E402
from progpolicy_envs.panda.scene import Scene  # noqa: E402
from progpolicy_envs.panda.tasks import Push, Slide, Stack  # noqa: E402


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
    env = gym.make("PandaReach-v0", disable_env_checker=True, n_targets=8)
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


@pytest.mark.parametrize("env_id", [domain.id for domain in DOMAINS.values() if domain.simulation])
@pytest.mark.parametrize("physics", [Physics(), Physics(frequency=180, substeps=6, delicate_substeps=12)])
def test_physics_steps_made_in_one_call_are_those_made_in_many(env_id, physics, monkeypatch):
    if env_id in ("PandaPush-v0", "PandaSlide-v0"):
        # A rigid body that is woken in a call has its weight from the next call on, so here none sleeps.
        physics = replace(physics, sleeping=False)

    def trajectory():
        env = gym.make(env_id, disable_env_checker=True, physics=physics, **{DOMAINS[env_id].size: 3})
        env.reset(seed=1)
        observations = [env.step(action)[0] for action in islice(env.unwrapped.plan(), 60)]
        env.close()
        assert len(observations) >= 10
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
    env = gym.make("PandaPush-v0", disable_env_checker=True, n_objects=3)
    env.reset(seed=0)
    assert env.unwrapped.scene.physics.contact_margin < BULLET_MARGIN
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
