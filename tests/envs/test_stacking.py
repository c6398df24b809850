"""Stacking-v0: the rules, the shortest solutions, and a program that is optimal for any number of plates."""

from collections import deque

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from progpolicy_envs.planners import stacking as planner
from progpolicy_envs.stacking import ACTION_NAMES, OBSERVATION_NAMES, StackingEnv
from tests.envs.helpers import (
    assert_checkers_are_silent,
    assert_long_run_stays_sound,
    assert_picture_shows_the_state,
    assert_window_opens_shows_and_closes,
)
from tests.handwritten.evaluate import Player, play, play_batch, size_of
from tests.handwritten.stacking import stacking_program

NORTH, EAST, SOUTH, WEST, PICK = range(5)
Cell = tuple[int, int]


class Referee:
    """The task in its own words: numbered plates on a table, the largest one first onto the stack."""

    def __init__(self, gripper: Cell, plates: dict[Cell, int]) -> None:
        self.gripper, self.table, self.stack = gripper, dict(plates), list[int]()

    def act(self, action: int) -> bool:
        """Take an action, if it is legal, and say whether it was."""
        if action == PICK:
            if self.table.get(self.gripper) != max(self.table.values(), default=None) or not self.table:
                return False
            self.stack.append(self.table.pop(self.gripper))
            return True
        row, column = self.gripper
        moved = {NORTH: (row - 1, column), EAST: (row, column + 1), SOUTH: (row + 1, column), WEST: (row, column - 1)}
        if not {*moved[action]} <= {0, 1, 2, 3, 4}:
            return False
        self.gripper = moved[action]
        return True


def referee_of(env: StackingEnv) -> Referee:
    return Referee(env.gripper, {plate: len(env.plates) - rank for rank, plate in enumerate(env.plates)})


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("n_plates", [1, 2, 3])
def test_planner_is_as_short_as_breadth_first_search(n_plates: int, seed: int) -> None:
    env = StackingEnv(n_plates=n_plates)
    env.reset(seed=seed)
    start = (env.gripper, tuple(env.plates))
    distance, queue = {start: 0}, deque([start])
    while queue:
        gripper, plates = queue.popleft()
        for action in range(5):
            referee = Referee(gripper, {plate: len(plates) - rank for rank, plate in enumerate(plates)})
            referee.act(action)
            state = (referee.gripper, tuple(plate for plate in plates if plate in referee.table))
            if state not in distance:
                distance[state] = distance[gripper, plates] + 1
                queue.append(state)
    shortest = min(steps for (_, plates), steps in distance.items() if not plates)
    assert planner.optimal_steps(env.gripper, env.plates) == shortest


@pytest.mark.parametrize("n_plates", range(1, 9))
def test_environment_takes_the_plan_and_ends_at_its_last_pick_only(n_plates: int) -> None:
    env = StackingEnv(n_plates=n_plates)
    for seed in range(10):
        _, info = env.reset(seed=seed)
        referee, actions = referee_of(env), env.plan()
        assert all(referee.act(action) for action in actions)
        assert referee.stack == list(range(n_plates, 0, -1))
        assert len(actions) == info["optimal_steps"]
        results = [env.step(action) for action in actions]
        assert [result[2] for result in results] == [False] * (len(actions) - 1) + [True]
        assert sum(result[1] for result in results) == pytest.approx(n_plates - 0.01 * len(actions))
        assert results[-1][4]["is_success"]


@settings(max_examples=80, deadline=None)
@given(
    n_plates=st.integers(1, 8),
    seed=st.integers(0, 2**31),
    actions=st.lists(st.one_of(st.integers(0, 4), st.just("fetch")), max_size=60),
)
def test_any_actions_obey_the_rules_and_the_observation_shows_the_state(
    n_plates: int, seed: int, actions: list[int | str]
) -> None:
    env = StackingEnv(n_plates=n_plates)
    observation, _ = env.reset(seed=seed)
    referee = referee_of(env)
    assert len(referee.table) == n_plates
    for choice in actions:
        assert_observation_shows(observation, referee, n_plates)
        assert env.observation_space.contains(observation)
        # Random actions hardly ever pick; "fetch" goes on with the plan, so that late states are seen too.
        action = env.plan()[0] if isinstance(choice, str) else choice
        n_picked, legal = len(referee.stack), referee.act(action)
        observation, reward, terminated, _, _ = env.step(action)
        assert reward == pytest.approx(-0.01 - 0.05 * (not legal) + (len(referee.stack) - n_picked))
        assert terminated == (not referee.table)
        if terminated:
            break


def assert_observation_shows(observation: np.ndarray, referee: Referee, n_plates: int) -> None:
    """Rebuild every number of an observation from the referee's own state."""
    named = dict(zip(OBSERVATION_NAMES, observation, strict=True))
    for row in range(5):
        for column in range(5):
            size = referee.table.get((row, column))
            larger = sum(other > size for other in referee.table.values()) if size else 0
            assert named[f"table[{row},{column}]"] == (8.0**-larger if size else 0)
    for slot in range(8):
        expected = referee.stack[slot] / n_plates if slot < len(referee.stack) else 0
        assert named[f"stack[{slot}]"] == pytest.approx(expected)
    assert named["gripper[row]"] == referee.gripper[0] / 2 - 1
    assert named["gripper[column]"] == referee.gripper[1] / 2 - 1


@pytest.mark.parametrize("n_plates", range(1, 9))
def test_handwritten_program_is_optimal_on_training_and_unseen_variations(n_plates: int) -> None:
    program = stacking_program()
    assert size_of(program) == (4, 5)
    episodes = play_batch(program, "Stacking-v0", 100, n_plates=n_plates)
    assert all(episode.success for episode in episodes)
    assert [episode.steps for episode in episodes] == [episode.optimal for episode in episodes]


def test_handwritten_program_stays_optimal_when_its_history_survives_episodes() -> None:
    policy, env = Player(stacking_program()), gym.make("Stacking-v0")
    episodes = [play(policy, env, seed=seed, n_plates=1 + seed % 8) for seed in range(16)]
    assert [episode.steps for episode in episodes] == [episode.optimal for episode in episodes]


def test_only_the_largest_plate_can_be_picked_up() -> None:
    env = StackingEnv(n_plates=2)
    env.reset(seed=0)
    env.gripper, before = env.plates[1], list(env.plates)
    _, reward, _, _, _ = env.step(PICK)
    assert (env.plates, reward) == (before, pytest.approx(-0.06))
    env.gripper = env.plates[0]
    _, reward, _, _, _ = env.step(PICK)
    assert (env.plates, reward) == (before[1:], pytest.approx(0.99))


def test_positions_follow_the_seed_and_change_from_episode_to_episode() -> None:
    env, twin = StackingEnv(n_plates=5), StackingEnv(n_plates=5)
    for seed in (5, None, None):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], twin.reset(seed=seed)[0])
    assert len({(env.reset()[0].tobytes()) for _ in range(10)}) == 10


@pytest.mark.parametrize("action", [-1, 5, None])
def test_action_out_of_range_is_refused(action: object) -> None:
    env = StackingEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="integers from 0 to 4"):
        env.step(action)  # type: ignore[arg-type]


def test_text_shows_table_gripper_and_stack() -> None:
    env = StackingEnv(n_plates=3, render_mode="ansi")
    env.reset(seed=0)
    env.gripper = env.plates[0]
    row, column = env.gripper
    lines = env.render().splitlines()
    assert lines[row][3 * column : 3 * column + 3] == "[3]"
    assert lines[-1] == "stack:"
    env.step(PICK)
    lines = env.render().splitlines()
    assert lines[row][3 * column : 3 * column + 3] == "[.]"
    assert lines[-1] == "stack: 3"
    assert sum(line.count(size) for line in lines[:5] for size in "12") == 2


def test_picture_shows_the_state() -> None:
    env = gym.make("Stacking-v0", render_mode="rgb_array")
    env.reset(seed=0)
    row = env.unwrapped.gripper[0]  # type: ignore[attr-defined]
    assert_picture_shows_the_state(env, action=SOUTH if row < 4 else NORTH)


def test_window_opens_shows_and_closes() -> None:
    assert_window_opens_shows_and_closes("Stacking-v0")


@pytest.mark.parametrize("n_plates", [1, 8])
def test_environment_checkers_find_nothing(n_plates: int) -> None:
    assert_checkers_are_silent("Stacking-v0", n_plates=n_plates)


def test_long_run_of_random_actions() -> None:
    assert_long_run_stays_sound("Stacking-v0", 1_000_000, [{"n_plates": n} for n in (1, 3, 8)])


def test_actions_are_named_in_their_order() -> None:
    assert ACTION_NAMES == ("north", "east", "south", "west", "pick")
