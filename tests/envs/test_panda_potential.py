"""The Panda tasks' reward by potential: what it pays, and that nothing pays twice."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS
from progpolicy_envs.panda.potential import FULL_WAY, not_left, way_after, way_behind, way_onto

IDS = [domain.id for domain in DOMAINS.values() if domain.simulation]
STEP, FAILURE, PROGRESS, APPROACH = -0.01, -5.0, 10.0, 5.0


def make(env_id, size=1, reward_type="potential", **arguments):
    return gym.make(env_id, **{DOMAINS[env_id].size: size, "reward_type": reward_type, **arguments})


@pytest.mark.parametrize("observation", ["flat", "goal"])
@pytest.mark.parametrize("env_id", IDS)
def test_an_episode_pays_what_its_potential_gained_whatever_happened_in_between(env_id, observation):
    rng = np.random.default_rng(0)
    ends = set()
    for size, seed in ((1, 0), (3, 1), (8, 2)):
        env = make(env_id, size, observation=observation, n_done="random")
        env.reset(seed=seed)
        begun, paid, steps, info = env.unwrapped.potential(), 0.0, 0, {}
        for action in itertools.islice(env.unwrapped.plan(), 400):
            for each in (action, rng.uniform(-1, 1, 4).astype(np.float32))[: 1 + (steps % 12 == 0)]:
                _, reward, terminated, _, info = env.step(each)
                paid, steps = paid + reward, steps + 1
                if terminated:
                    break
            if terminated:
                break
        ends.add(info["is_success"])
        expected = env.unwrapped.potential() - begun + STEP * steps + FAILURE * info["is_failure"]
        assert paid == pytest.approx(expected, abs=1e-3)
    assert True in ends


def steps_of(env, action, n):
    """The rewards of so many steps with one action, without what each step costs."""
    return [env.step(np.array(action, np.float32))[1] - STEP for _ in range(n)]


def test_shoving_another_block_away_costs_at_once():
    # The hand is behind the second block, which is not in focus, and pushes it away from its target.
    given = {"starts": [[-0.2, -0.2], [0.0, 0.0]], "targets": [[-0.05, -0.2], [-0.1, 0.1]]}
    costs = {}
    for reward_type in ("dense", "potential"):
        env = make("PandaPush-v0", 2, reward_type)
        env.reset(options=given)
        steps_of(env, (-0.6, 0, 0, 0), 8)
        steps_of(env, (0, 0, -1, 0), 12)
        task, before = env.unwrapped.task, env.unwrapped.task.positions[1]
        found = []
        for _ in range(6):
            left, way = task.distance_left(), task.way_left(env.unwrapped.scene)
            reward = sum(steps_of(env, (1, 0, 0, 0), 1))
            others = APPROACH * (task.way_left(env.unwrapped.scene) - way) if reward_type == "potential" else 0.0
            found.append((reward + others, left - task.distance_left()))
        assert task.positions[1][0] > before[0] + 0.03
        costs[reward_type] = found
    for reward, progress in costs["potential"]:
        assert reward == pytest.approx(PROGRESS * progress, abs=1e-6)
    assert sum(progress for _, progress in costs["potential"]) < -0.02
    assert min(progress for _, progress in costs["dense"]) < 0


def test_dragging_a_finished_block_costs_before_it_has_left_its_disc():
    env = make("PandaPush-v0", 2, n_done=1)
    env.reset(options={"starts": [[-0.1, 0.0], [-0.2, -0.2]], "targets": [[0.0, 0.0], [-0.1, -0.2]]})
    task = env.unwrapped.task
    left = task.distance_left()
    steps_of(env, (0.6, 0, 0, 0), 3)
    assert task.finished == [True, False]
    assert task.distance_left() > left + 0.01


def free(point):
    """Whether the tips of closed fingers are neither in the table nor in a block at the origin."""
    return point[2] >= 0 and not (abs(point[0]) < 0.029 and abs(point[1]) < 0.029 and point[2] < 0.042)


def test_from_everywhere_around_the_block_some_way_is_shorter():
    block, target, move = (0.0, 0.0, 0.02), (0.3, 0.0, 0.02), 0.005

    def way(point):
        return way_behind(tuple(point), block, target, 0.05, 0.03)

    ways = [np.array(way) * move for way in itertools.product((-1, 0, 1), repeat=3) if np.abs(way).sum() == 1]
    grid = itertools.product(np.arange(-0.15, 0.151, 0.01), np.arange(0, 0.121, 0.01), np.arange(0, 0.161, 0.01))
    n_points = 0
    for point in map(np.array, grid):
        if free(point) and way(point) > 0.012:
            n_points += 1
            assert max(way(point) - way(point + by) for by in ways if free(point + by)) > 1e-4, point
    assert n_points > 5000
    assert way((-0.05, 0, 0.02)) == way((-0.03, 0, 0.02)) == 0, "to be in contact is no loss"


def test_the_gripper_flies_and_opens_before_it_grasps():
    block = (0.0, 0.0, 0.02)
    assert way_onto((0.0, 0.0, 0.02), 0.0, block, 0.08) == 0, "closed around it"
    assert way_onto((0.0, 0.0, 0.05), 0.08, block, 0.08) < way_onto((0.0, 0.0, 0.05), 0.0, block, 0.08)
    beside = [way_onto((0.1, 0.0, z), 0.08, block, 0.08) for z in (0.02, 0.05, 0.1)]
    assert beside == sorted(beside, reverse=True), "low beside it, it has to rise"


def test_leaving_a_finished_block_upwards_is_paid_before_the_way_to_the_next():
    options = {"starts": [[-0.1, 0.0], [-0.2, -0.2]], "targets": [[0.0, 0.0], [-0.1, -0.2]]}
    gains = {}
    for name, action in (("rise", (0, 0, 1, 0)), ("aside", (0, -1, 0, 0)), ("through", (1, 0, 0, 0))):
        env = make("PandaPush-v0", 2, n_done=1)
        env.reset(options=options)
        gains[name] = sum(steps_of(env, action, 3))
    assert gains["rise"] > 1
    assert gains["aside"] < 0.5 * gains["rise"]
    assert gains["through"] < -0.3
    here = (0.0, 0.0, 0.02)
    assert not_left((0.03, 0, 0.02), [here]) == 1
    assert 0 < not_left((0.03, 0, 0.06), [here]) < 1
    assert way_after(0.3, (0.03, 0, 0.02), [here]) == FULL_WAY
    assert way_after(0.05, (0.03, 0, 0.02), [here]) == 0.05, "it works beside it"
    assert not_left((0.03, 0, 0.081), [here]) == not_left((0.13, 0, 0.02), [here]) == not_left(here, []) == 0


def test_the_way_to_the_others_is_counted_so_that_finishing_one_costs_nothing():
    for env_id in ("PandaPush-v0", "PandaSlide-v0", "PandaStack-v0"):
        env = make(env_id, 3)
        env.reset(seed=0)
        task, scene = env.unwrapped.task, env.unwrapped.scene
        assert 2 * FULL_WAY < task.way_left(scene) <= 3 * FULL_WAY
        lefts = [3]
        for action in env.unwrapped.plan():
            reward = env.step(action)[1]
            left = task.finished.count(False)
            if left < lefts[-1]:
                assert reward > 0.5
                lefts.append(left)
        assert lefts == [3, 2, 1, 0]
        assert task.way_left(scene) == 0


@pytest.mark.parametrize(("env_id", "place"), [("PandaPush-v0", (0.22, 0.1)), ("PandaStack-v0", (0.24, -0.1))])
def test_what_is_out_of_reach_is_a_failure(env_id, place):
    near = {"starts": [[-0.2, 0.2], [-0.2, -0.2]], "targets": [[0.0, 0.0], [0.0, 0.0]]}
    if env_id == "PandaPush-v0":
        near["targets"] = [[0.0, 0.2], [0.0, -0.2]]
    far = {**near, "starts": [near["starts"][0], place]}
    still = np.zeros(4, np.float32)
    for reward_type, options, fails in (("potential", far, True), ("potential", near, False), ("dense", far, False)):
        env = make(env_id, 2, reward_type)
        env.reset(options=options)
        _, reward, terminated, _, info = env.step(still)
        assert (terminated, info["is_failure"], info["is_success"]) == (fails, fails, False)
        assert (reward < -4) == fails


def test_a_puck_beyond_reach_has_failed_when_it_lies_still_and_not_before():
    options = {"starts": [[0.3, 0.0]], "targets": [[0.5, 0.0]]}
    still = np.zeros(4, np.float32)
    for speed, fails in ((0.0, True), (0.4, False)):
        env = make("PandaSlide-v0")
        env.reset(options=options)
        scene = env.unwrapped.scene
        if speed:
            import pybullet

            pybullet.resetBaseVelocity(scene.objects[0], (speed, 0, 0), (0, 0, 0), physicsClientId=scene.client)
            pybullet.changeDynamics(
                scene.objects[0], -1, activationState=pybullet.ACTIVATION_STATE_WAKE_UP, physicsClientId=scene.client
            )
        *_, info = env.step(still)
        assert info["is_failure"] == fails
        if speed:
            while not (info["is_failure"] or info["is_success"]):
                *_, info = env.step(still)
            assert env.unwrapped.task.positions[0][0] > 0.33


@pytest.mark.parametrize("env_id", IDS)
def test_the_scripted_controller_solves_it_without_a_failure_and_is_paid_more_than_for_standing_still(env_id):
    for size, seed in ((1, 0), (4, 1), (8, 2)):
        env = make(env_id, size)
        env.reset(seed=seed)
        total = sum(env.step(action)[1] for action in env.unwrapped.plan())
        assert env.unwrapped.task.finished == [True] * size
        assert total > 2 * size


def test_reach_pays_the_way_that_is_left_through_all_targets():
    env = make("PandaReach-v0", 3)
    env.reset(seed=0)
    task = env.unwrapped.task
    corners = np.array([task.positions[0], *task.targets])
    assert task.distance_left() == pytest.approx(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
    assert env.unwrapped.potential() == pytest.approx(-PROGRESS * task.distance_left())


def test_potential_needs_an_episode_and_is_told_for_every_reward():
    env = make("PandaPush-v0")
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.potential()
    env.reset(seed=1)
    other = make("PandaPush-v0", reward_type="sparse")
    other.reset(seed=1)
    assert env.unwrapped.potential() == other.unwrapped.potential()
