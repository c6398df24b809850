"""What once went wrong without a word in the domains and their batches, each with the right value."""

import copy
import itertools
import re

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import domains
from progpolicy_envs.hanoi import HanoiVectorEnv
from progpolicy_envs.panda.physics import PANDA_GYM_PHYSICS, Physics
from sb3_progpolicy import TaskDistribution, evaluate_program, imitate
from sb3_progpolicy.pretrained import load_pretrained
from sb3_progpolicy.reptile.tasks import make_tasks
from sb3_progpolicy.vec_env.factory import make_fast_vec_env


def batch(env_id, num_envs=2, **arguments):
    return gym.make_vec(env_id, num_envs, vectorization_mode="vector_entry_point", **arguments)


def refused(call, *parts):
    with pytest.raises(ValueError, match=re.escape(parts[0])) as caught:
        call()
    for part in parts[1:]:
        assert part in str(caught.value)


def test_a_batch_goes_back_to_nothing_done():
    env = batch("PandaPush-v0", 1, n_objects=3)
    env.reset(seed=0, options={"n_done": 2})
    observations, infos = env.reset(seed=0, options={"n_done": 0})
    assert infos["variation"][0] == {"n_objects": 3}
    single, _ = gym.make("PandaPush-v0", n_objects=3).reset(seed=0)
    np.testing.assert_array_equal(observations[0], single)
    env.reset(options={"n_done": 2})
    env.reset(options={"n_objects": 1, "n_done": 0})
    assert env.unwrapped.row_variations == [{"n_objects": 1}]
    env.close()


def test_an_array_of_seeds_is_one_seed_for_each():
    env = batch("Stacking-v0")
    by_list = env.reset(seed=[1, 2])[0]
    np.testing.assert_array_equal(env.reset(seed=np.array([1, 2]))[0], by_list)
    np.testing.assert_array_equal(env.reset(seed=np.int64(1))[0], by_list)


@pytest.mark.parametrize("actions", [np.array([1.0, 1.0]), np.array([np.nan, 1.0]), np.array([True, True])])
def test_actions_of_another_type_are_refused(actions):
    env = batch("Hanoi-v0")
    env.reset(seed=0)
    refused(lambda: env.step(actions), f"type {actions.dtype}", "integers from 0 to 5")


def test_an_episode_that_ends_at_its_limit_is_truncated_too():
    env = batch("Hanoi-v0", 1, n_discs=1, max_episode_steps=1)
    env.reset(seed=0)
    _, _, terminated, truncated, _ = env.step(np.array([1]))
    assert terminated[0]
    assert truncated[0]
    single = gym.make("Hanoi-v0", n_discs=1, max_episode_steps=1)
    single.reset(seed=0)
    assert single.step(1)[2:4] == (True, True)
    venv = make_fast_vec_env("Hanoi-v0", 1, max_episode_steps=1, n_discs=1)
    venv.reset()
    assert venv.step(np.array([1]))[3][0]["TimeLimit.truncated"] is False, "the goal was reached"


def test_infos_of_a_reset_are_never_those_of_an_episode_before():
    venv = make_fast_vec_env("Stacking-v0", 4, max_episode_steps=1, n_plates=2)
    venv.seed(0)
    venv.reset()
    assert all(info["optimal_steps"] > 0 for info in venv.unwrapped.reset_infos)
    venv.step(np.zeros(4, dtype=np.int64))
    assert venv.unwrapped.reset_infos == [{"variation": {"n_plates": 2}}] * 4
    assert (venv.env_method("optimal_steps")[0] > 0).all()


def test_options_of_one_environment_alone():
    venv = make_fast_vec_env("Stacking-v0", 2)
    venv.set_options([{"n_done": 1, "gripper": [0, 0]}, {}])
    venv.reset()
    assert venv.get_attr("row_variations")[0] == [{"n_plates": 3, "n_done": 1}, {"n_plates": 3}]
    assert venv.env_method("state_of", 0)[0]["gripper"] == [0, 0]


@pytest.mark.parametrize("env_id", ["Hiking-v0", "Hiking-v1", "HikingEgo-v0"])
def test_what_is_drawn_makes_room_for_what_is_given(env_id):
    env, many = gym.make(env_id), batch(env_id, 1)
    known = [list(cell) for cell in env.reset(seed=0) and env.unwrapped.state["stars"]]
    for seed, options in itertools.product(range(40), ({"hiker": known[0]}, {"stars": known[:2], "n_done": 1})):
        env.reset(seed=seed, options={"n_done": 0, **options})
        state = env.unwrapped.state
        assert state["hiker"] not in state["stars"]
        assert len(state["stars"]) == 3 - options.get("n_done", 0)
        for name in ("hiker", "stars"):
            if name in options:
                assert state[name] == sorted(options[name]) if name == "stars" else options[name]
        many.reset(seed=seed, options={name: [value] for name, value in {"n_done": 0, **options}.items()})
        assert many.unwrapped.state_of(0)["hiker"] == state["hiker"]
        assert sorted(many.unwrapped.state_of(0)["stars"]) == sorted(state["stars"])


@pytest.mark.parametrize(("env_id", "size", "options"), [
    ("Stacking-v0", "n_plates", {"plates": [[0, 0], [1, 1], [2, 2]]}),
    ("Hiking-v0", "n_stars", {"stars": [[0, 3], [7, 1], [7, 5]]}),
])  # fmt: skip
def test_a_start_gives_as_many_things_as_n_done_leaves(env_id, size, options):
    ((name, things),) = options.items()
    message = f"3 {name} are not accepted with n_done=2 and {size}=3, which leave 1"
    refused(lambda: gym.make(env_id, n_done=2).reset(options=options), message)
    refused(lambda: batch(env_id, 1, n_done=2).reset(options={name: [things]}), message)
    gym.make(env_id).reset(options={name: things[:2]})  # the others are done


@pytest.mark.parametrize(("env_id", "start"), [
    ("Hanoi-v0", {"discs": [2, 2, 2]}), ("Hiking-v0", {"stars": []}), ("Stacking-v0", {"plates": []}),
])  # fmt: skip
def test_a_start_leaves_something_to_do(env_id, start):
    refused(lambda: gym.make(env_id).reset(options=start), "nothing is left to be done", repr(start))
    many = batch(env_id, 2)
    refused(lambda: many.reset(options={name: [value, None] for name, value in start.items()}), "nothing is left")
    assert len(many.reset(seed=0)[0]) == 2


def test_context_shows_the_state_that_was_set():
    env = gym.make("Hanoi-v0", context="observed")
    env.reset(seed=0)
    state = {"n_discs": 5, "source": 0, "target": 2, "discs": [0] * 5}
    shown = env.unwrapped.set_state(state)[9:]
    np.testing.assert_array_equal(shown, gym.make("Hanoi-v0", context="observed", n_discs=5).reset(seed=0)[0][9:])
    np.testing.assert_array_equal(env.step(0)[0][9:], shown)
    observation, info = env.reset(seed=0)
    assert info["variation"]["n_discs"] == 3
    assert observation[9] != shown[0]
    drawn = gym.make("Hanoi-v0", context="observed", source="random")
    before = drawn.reset(seed=0)[0][9:]
    np.testing.assert_array_equal(drawn.unwrapped.set_state({"discs": [1, 0, 0]})[9:], before)


def test_starts_are_counted_with_one_peg_given():
    assert HanoiVectorEnv.count_starts({"source": 2}) == 2
    assert HanoiVectorEnv.count_starts({"source": 1}) == 2
    assert HanoiVectorEnv.count_starts({"target": 0}) == 2
    env = HanoiVectorEnv(2)
    env.reset_to({"source": 2, "n_discs": 2}, np.arange(2))
    assert [env.state_of(row)["discs"] for row in range(2)] == [[2, 2]] * 2
    assert {env.state_of(row)["target"] for row in range(2)} == {0, 1}


def test_starts_are_no_variations():
    variations = [{"n_discs": 3, "discs": [0, 2, 2]}]
    program = load_pretrained("Hanoi-v0")
    assert evaluate_program(program, "Hanoi-v0", variations)[0].optimal_steps_mean == 1
    message = "discs is part of a start, which holds for one"
    refused(lambda: evaluate_program(program, "Hanoi-v0", variations, n_episodes=2), message, "n_discs, source")
    refused(lambda: make_tasks(TaskDistribution(variations), None, "Hanoi-v0", True, None), message)
    refused(lambda: imitate("planner", "Hanoi-v0", tasks=variations, interaction=True), message)


def test_push_controller_solves_starts_in_the_middle():
    env = gym.make("PandaPush-v0", n_objects=3)
    for seed in (1, 39):
        env.reset(seed=seed, options={"n_done": 2})
        for action in env.unwrapped.plan():
            *_, truncated, info = env.step(action)
            assert not truncated
        assert info["is_success"]
    env.close()


def test_a_plan_ends_with_a_failure():
    env = gym.make("PandaPush-v0", reward_type="potential")
    env.reset(seed=0, options={"starts": [[0.25, 0.0]]})
    assert env.unwrapped.task.out_of_reach
    steps = [env.step(action) for action in env.unwrapped.plan()]
    assert [terminated for _, _, terminated, _, _ in steps] == [True]
    assert steps[0][4]["is_failure"]
    env.reset(seed=0)
    assert next(env.unwrapped.plan()).shape == (4,)
    env.close()


def test_goals_and_infos_are_of_one_number():
    env = gym.make("PandaPush-v0", observation="goal", reward_type="sparse").unwrapped
    goals = np.zeros((3, 3))
    info = {"settled": True}
    np.testing.assert_array_equal(env.compute_reward(goals, goals, [info] * 3), np.zeros(3))
    assert env.compute_reward(goals[0], goals[0], info) == 0
    for infos in ({}, [info], [info] * 2):
        refused(lambda infos=infos: env.compute_reward(goals, goals, infos), f"{len(infos) or 1} infos", "(3, 3)")
    env.close()


@pytest.mark.parametrize("change", [
    {"frequency": -120}, {"substeps": 0}, {"solver_iterations": 2.5}, {"contact_margin": float("nan")},
    {"contact_margin": -1.0}, {"delicate_substeps": True},
])  # fmt: skip
def test_physics_are_checked(change):
    ((name, value),) = change.items()
    refused(lambda: Physics(**change), f"{name}={value!r} is not accepted")


@pytest.mark.parametrize("physics", [{"frequency": 240}, {}, 0])
def test_physics_are_physics(physics):
    refused(lambda: gym.make("PandaPush-v0", physics=physics), f"physics={physics!r} is not accepted")


def test_frames_last_as_long_as_the_control_step():
    env = gym.make("PandaPush-v0", physics=PANDA_GYM_PHYSICS)
    assert env.metadata["render_fps"] == 25
    assert gym.make("PandaPush-v0").metadata["render_fps"] == 30
    env.close()


@pytest.mark.parametrize("env_id", ["Hanoi-v0", "Hiking-v0", "Stacking-v0", "PandaReach-v0"])
def test_render_modes_are_checked_and_frames_can_be_drawn_on(env_id):
    known = domains.get_domain(env_id)
    make = gym.envs.registration.load_env_creator(known.entry_point)
    refused(lambda: make(render_mode="rgb"), "render_mode='rgb' is not accepted", "'rgb_array'")
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    env.render()[0, 0] = 0
    env.close()


def test_a_closed_environment_with_pictures_can_be_copied():
    env = gym.make("PandaReach-v0", render_mode="rgb_array")
    env.reset(seed=0)
    env.close()
    copy.deepcopy(env.unwrapped).close()


def test_parts_of_a_start_are_known():
    env = gym.make("PandaPush-v0").unwrapped
    with pytest.raises(gym.error.ResetNeeded):
        env.replace_start({"starts": [[0.0, 0.0]]})
    env.reset(seed=0)
    refused(lambda: env.replace_start({"strats": [[0.0, 0.0]]}), "'strats'", "starts, targets")
    env.close()


def test_a_text_with_lines_is_a_map():
    refused(lambda: gym.make("Hiking-v0", layout="...\n.#*"), "0 starts")
    rows = ["H..", "#.#", "#.."]
    env = batch("Hiking-v0", 3, n_stars=1)
    env.reset(seed=0, options={"layout": rows})
    assert [variation["layout"] for variation in env.unwrapped.row_variations] == ["\n".join(rows)] * 3
    env.reset(seed=0, options={"layout": ["valley", "comb", "valley"]})
    assert [variation["layout"] for variation in env.unwrapped.row_variations] == ["valley", "comb", "valley"]


def test_targets_are_within_the_arms_reach():
    env = gym.make("PandaReach-v0")
    for target in ([2.0, 0.0, 0.1], [100.0, 0.0, 0.1], [-0.6, 0.0, 0.3]):
        refused(lambda target=target: env.reset(options={"targets": [target]}), "comes no nearer", str(target))
    env.reset(seed=0, options={"targets": [[0.1, 0.1, 0.1]]})
    assert len(list(zip(range(100), env.unwrapped.plan(), strict=False))) == 100, "it is not there yet"
    env.close()


def test_sizes_of_a_domain_are_numbers_of_any_type():
    sets = {"train": ({"n_discs": np.int64(1)},), "validation": ({"n_discs": 2},), "unseen": ({"n_discs": 3},)}
    assert domains.Domain(id="Own-v0", size="n_discs", **sets).train[0]["n_discs"] == 1
    refused(lambda: domains.Domain(id="Own-v0", size="n_discs", **{**sets, "train": ("n_discs",)}), "mappings")
    refused(
        lambda: domains.Domain(id="Own-v0", size="n_discs", **{**sets, "train": ({"n_discs": True},)}), "as a number"
    )
