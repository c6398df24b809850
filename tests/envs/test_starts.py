"""States and starts as data: read, set, given to reset; and what is said to those who give something else."""

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from progpolicy_envs import DOMAINS
from progpolicy_envs.layouts import LAYOUTS

PLANNING = [domain.id for domain in DOMAINS.values() if not domain.simulation]
PANDA = [domain.id for domain in DOMAINS.values() if domain.simulation]


def make(env_id: str, **arguments: Any) -> Any:
    return gym.make(env_id, disable_env_checker=True, **arguments).unwrapped


def make_vec(env_id: str, num_envs: int = 2, **arguments: Any) -> Any:
    return gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **arguments)


def is_solved(env: Any) -> bool:
    return not env.plan()


@pytest.mark.parametrize("size", [1, 4])
@pytest.mark.parametrize("env_id", PLANNING)
def test_state_goes_through_json_into_another_environment_and_has_the_same_future(env_id: str, size: int) -> None:
    env, other = make(env_id, **{DOMAINS[env_id].size: size}), make(env_id)
    env.reset(seed=3, options={"layout": "random"} if "Hiking" in env_id else None)
    other.reset(seed=0)
    generator = np.random.default_rng(0)
    for _ in range(30):
        np.testing.assert_array_equal(other.set_state(json.loads(json.dumps(env.state))), env.set_state({}))
        assert other.state == env.state
        assert other.plan() == env.plan()
        action = env.plan()[0] if generator.random() < 0.3 else int(generator.integers(env.action_space.n))
        for one, twin in zip(env.step(action), other.step(action), strict=True):
            np.testing.assert_array_equal(one, twin)
        if is_solved(env):
            break
    assert other.set_state(env.state) is not None
    assert other.reset()[1]["variation"] == {**other.variation}, "the variation in force is not part of a state"


@pytest.mark.parametrize("env_id", PLANNING)
def test_reset_takes_a_state_in_single_and_in_batched_form(env_id: str) -> None:
    env = make(env_id, **{DOMAINS[env_id].size: 3})
    env.reset(seed=5)
    env.step(env.plan()[0])
    state = env.state
    _, info = make(env_id).reset(seed=0, options=state)
    assert info["optimal_steps"] == len(env.plan())
    batched = make_vec(env_id, 3)
    starts = {name: [None, value, value] for name, value in state.items() if name in env.variations.starts}
    options = {name: [value] * 3 for name, value in state.items() if name not in env.variations.starts}
    observations, infos = batched.reset(seed=5, options={**options, **starts})
    single, drawn = make(env_id).reset(seed=5, options={name: value[0] for name, value in options.items()})
    np.testing.assert_array_equal(observations, [single, env.set_state({}), env.set_state({})])
    assert infos["optimal_steps"].tolist() == [drawn["optimal_steps"], *[info["optimal_steps"]] * 2]
    for action in env.plan():
        expected = env.step(action)
        observations, rewards, terminated, _, infos = batched.step(np.full(3, action))
        seen = infos["final_obs"][1] if terminated[1] else observations[1]
        np.testing.assert_array_equal(seen, expected[0])
        assert (rewards[1], terminated[1]) == expected[1:3]
    assert terminated.tolist()[1:] == [True, True]


@pytest.mark.parametrize("env_id", PLANNING)
def test_batch_tells_the_optimal_steps_of_the_present_states(env_id: str) -> None:
    singles = [make(env_id, **{DOMAINS[env_id].size: 4}) for _ in range(8)]
    batched = make_vec(env_id, 8, **{DOMAINS[env_id].size: 4})
    batched.reset(seed=0)
    for row, env in enumerate(singles):
        env.reset(seed=row)
    for number in range(15):
        actions = [env.plan()[0] if number % 2 else number % env.action_space.n for env in singles]
        if any(env.step(action)[2] for env, action in zip(singles, actions, strict=True)):
            break
        batched.step(np.array(actions))
        assert batched.optimal_steps().tolist() == [len(env.plan()) for env in singles]


STATES: list[tuple[str, dict[str, Any], str]] = [
    ("Hanoi-v0", {"discs": [0, 0]}, r"discs=\[0, 0\] is not accepted; discs are 3 pegs"),
    ("Hanoi-v0", {"discs": [0, 0, 3]}, "is not accepted"),
    ("Hanoi-v0", {"discs": [0, 0, "random"]}, "each is a peg from 0 to 2"),
    ("Hanoi-v0", {"discs": "000"}, "discs='000' is not accepted"),
    ("Hiking-v0", {"hiker": [1, 0]}, r"hiker: \[1, 0\] is not accepted; no way leads there"),
    ("Hiking-v0", {"hiker": [8, 0]}, "a cell is a row from 0 to 7 and a column from 0 to 9"),
    ("HikingEgo-v0", {"stars": [[0, 1], [0, 1]]}, "a cell of their own"),
    ("Hiking-v0", {"stars": [[0, 0]]}, "a cell of their own"),
    ("Hiking-v0", {"stars": [[0, 1]] * 4}, "up to n_stars=3"),
    ("Hiking-v0", {"stars": 3}, "stars=3 is not accepted"),
    ("Stacking-v0", {"plates": [[0, 0]] * 2}, "each plate has a cell of its own"),
    ("Stacking-v0", {"plates": [[0, 1], [0, 2], [0, 3], [0, 4]]}, "up to n_plates=3"),
    ("Stacking-v0", {"gripper": [0.0, 1]}, "a cell is a row from 0 to 4 and a column from 0 to 4"),
    ("Stacking-v0", {"gripper": [True, 1]}, "a cell is"),
]


@pytest.mark.parametrize(("env_id", "state", "said"), STATES)
def test_what_is_not_a_state_is_refused_and_the_present_one_stays(
    env_id: str, state: dict[str, Any], said: str
) -> None:
    env = make(env_id)
    env.reset(seed=0)
    before = env.state
    with pytest.raises(ValueError, match=said):
        env.set_state(state)
    assert env.state == before
    with pytest.raises(ValueError, match=said):
        env.reset(options=state)
    with pytest.raises(ValueError, match=said):
        make_vec(env_id).reset(options={name: [value, None] for name, value in state.items()})


@pytest.mark.parametrize("env_id", PLANNING)
def test_parts_of_a_state_that_do_not_exist_are_refused(env_id: str) -> None:
    env = make(env_id)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\['colour'\] are not parts of a state; its parts are n_"):
        env.set_state({"colour": 3})


def test_random_is_no_state() -> None:
    for env_id, part in (("Hanoi-v0", {"source": "random"}), ("Hiking-v0", {"layout": "random"})):
        env = make(env_id)
        env.reset(seed=0)
        with pytest.raises(ValueError, match="'random' is not accepted in a state"):
            env.set_state(part)


def test_state_of_a_hand_drawn_map_names_it_and_that_of_another_draws_it() -> None:
    env = make("HikingEgo-v0", layout="comb")
    env.reset(seed=0)
    assert env.state["layout"] == "comb"
    env.reset(options={"layout": "random"})
    rows = env.state["layout"].splitlines()
    assert [len(row) for row in rows] == [10] * 8
    assert tuple(rows) not in {layout.rows for layout in LAYOUTS.values()}


def test_start_that_is_given_is_for_one_episode() -> None:
    env = make("Stacking-v0", n_plates=2)
    plates, gripper = [[0, 0], [4, 4]], [2, 2]
    observation, info = env.reset(seed=0, options={"plates": plates, "gripper": gripper})
    assert info["variation"] == {"n_plates": 2}
    assert env.state == {"n_plates": 2, "plates": plates, "gripper": gripper}
    assert (env.reset()[0] != observation).any()


def start_of(env_id: str, size: int) -> dict[str, Any]:
    env = make(env_id, **{DOMAINS[env_id].size: size})
    env.reset(seed=9)
    start = env.start
    env.close()
    return json.loads(json.dumps(start))


@pytest.mark.parametrize("env_id", PANDA)
def test_start_of_a_panda_episode_reproduces_it(env_id: str) -> None:
    start, size = start_of(env_id, 3), DOMAINS[env_id].size
    env, twin, batched = make(env_id, **{size: 3}), make(env_id), make_vec(env_id)
    first, _ = env.reset(seed=9)
    observation, info = twin.reset(seed=1, options=start)
    assert info["variation"] == {size: 3}
    assert twin.start == start
    options = {name: 3 if name == size else [value, None] for name, value in start.items()}
    observations, _ = batched.reset(seed=5, options=options)
    for expected in (observation, observations[0]):
        np.testing.assert_array_equal(first, expected)
    assert (observations[1] != first).any()
    for action, _ in zip(env.plan(), range(15), strict=False):
        first = env.step(action)[0]
        np.testing.assert_array_equal(first, twin.step(action)[0])
        np.testing.assert_array_equal(first, batched.step(np.array([action, action]))[0][0])
    for each in (env, twin, batched):
        each.close()


@pytest.mark.parametrize("env_id", PANDA)
def test_targets_alone_may_be_given_and_are_solved(env_id: str) -> None:
    env = make(env_id)
    target = {"PandaReach-v0": [0.05, -0.15, 0.25], "PandaSlide-v0": [0.4, 0.0]}.get(env_id, [0.05, 0.05])
    for seed in range(4):
        env.reset(seed=seed, options={"targets": [target]})
        assert env.start["targets"][0][: len(target)] == target
        for action, _ in zip(env.plan(), range(200), strict=False):
            info = env.step(action)[4]
        if info["is_success"]:
            break
    assert info["is_success"]
    env.close()


@pytest.mark.parametrize(
    ("env_id", "start", "said"),
    [
        ("PandaReach-v0", {"targets": [[0.1, 0.1]]}, "targets are 1 places in metres, each x, y and z"),
        ("PandaReach-v0", {"targets": [[0.1, 0.1, -0.1]]}, "above the table"),
        ("PandaReach-v0", {"starts": [[0.1, 0.1]]}, "unknown variation parameter 'starts'"),
        ("PandaPush-v0", {"starts": [[0.0, 0.1]] * 2}, "starts are 1 places"),
        ("PandaPush-v0", {"starts": [["a", 0.1]]}, "starts are 1 places"),
        ("PandaPush-v0", {"starts": [[np.nan, 0.1]]}, "starts are 1 places"),
        ("PandaPush-v0", {"starts": [[0.0, 0.1, 0.3]]}, r"z, if it is given, is \[0.02\]"),
        ("PandaPush-v0", {"starts": [[0.3, 0.1]]}, r"on the table x is from -0.85 to 0.25"),
        ("PandaPush-v0", {"starts": [[-0.6, 0.1]]}, "the robot stands there"),
        ("PandaSlide-v0", {"targets": [[0.4, 0.4]]}, "y from -0.35 to 0.35"),
        ("PandaSlide-v0", {"n_objects": 2, "starts": [[0.0, 0.0], [0.03, 0.03]]}, "objects 0 and 1 overlap"),
        ("PandaStack-v0", {"n_objects": 2, "targets": [[0.0, 0.0], [0.03, 0.03]]}, "the same in all"),
    ],
)
def test_panda_start_that_is_not_accepted_is_refused(env_id: str, start: dict[str, Any], said: str) -> None:
    env, batched = make(env_id), make_vec(env_id)
    before = env.variation
    with pytest.raises(ValueError, match=said):
        env.reset(seed=0, options=start)
    assert env.variation == before
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(4, np.float32))
    with pytest.raises(ValueError, match=said):
        batched.reset(options={name: v if name == "n_objects" else [v, v] for name, v in start.items()})
    assert batched.row_variations == [before, before]
    env.close()
    batched.close()


@pytest.mark.parametrize("env_id", DOMAINS)
@pytest.mark.parametrize("options", ["abc", 3, ["n_discs"]])
def test_options_that_are_no_mapping_are_refused(env_id: str, options: Any) -> None:
    for env in (make(env_id), make_vec(env_id)):
        with pytest.raises(ValueError, match=r"options=.* is not accepted; they are a mapping from names"):
            env.reset(options=options)
        env.close()


@pytest.mark.parametrize("env_id", DOMAINS)
def test_step_before_reset_says_so(env_id: str) -> None:
    env, batched = make(env_id), make_vec(env_id)
    for call in (
        lambda: env.step(env.action_space.sample()),
        lambda: env.plan(),
        lambda: env.render(),
        lambda: batched.step(batched.action_space.sample()),
    ):
        with pytest.raises(ResetNeeded, match="needs an episode; call reset\\(\\) first"):
            call()
    env.close()
    batched.close()
