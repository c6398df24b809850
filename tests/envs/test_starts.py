"""All starts of a variation, by number."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs.counting import arrangements, subsets


def make(env_id, n):
    return gym.make_vec(env_id, num_envs=n, vectorization_mode="vector_entry_point")


def in_order(state):
    """The state with its stars, which are a set, in one order."""
    return {name: sorted(value) if name == "stars" else value for name, value in state.items()}


@pytest.mark.parametrize(("env_id", "variation", "count"), [
    ("Hanoi-v0", {"n_discs": 3}, 6),
    ("Hanoi-v0", {"n_discs": 3, "source": 1}, 2),
    ("Hanoi-v0", {"n_discs": 3, "source": 1, "target": 0}, 1),
    ("Stacking-v0", {"n_plates": 2}, 25 * 24 * 25),
    ("Hiking-v0", {"n_stars": 2, "layout": "fork"}, None),
    ("HikingEgo-v0", {"n_stars": 2, "layout": ["H..", ".*.", "..*"]}, 1),
    ("HikingEgo-v0", {"n_stars": 2, "layout": ["H..", ".#."]}, 6),
])  # fmt: skip
def test_every_start_comes_once_and_single_environments_can_begin_in_it(env_id, variation, count):
    single = gym.make(env_id)
    venv = make(env_id, 1).unwrapped
    found = venv.count_starts(variation)
    if count is None:
        count = math.comb(2 + int((single.reset(options=variation)[0] == 0).sum()), 2)
    assert found == count
    venv = make(env_id, count).unwrapped
    observations = venv.reset_to(variation, np.arange(count))
    states = [venv.state_of(row) for row in range(count)]
    assert len({str(sorted((k, str(v)) for k, v in state.items())) for state in states}) == count
    for row in np.random.default_rng(0).choice(count, min(count, 40), replace=False):
        observation, info = single.reset(options=states[row])
        np.testing.assert_array_equal(observation, observations[row])
        assert in_order(single.unwrapped.state) == in_order(states[row])
        assert info["optimal_steps"] == venv.optimal_steps()[row]


def test_starts_are_those_that_are_drawn():
    drawn, env = set(), gym.make("Stacking-v0", n_plates=1)
    for seed in range(3000):
        env.reset(seed=seed)
        drawn.add(str(env.unwrapped.state))
    venv = make("Stacking-v0", 625).unwrapped
    venv.reset_to({"n_plates": 1}, np.arange(625))
    known = {str(venv.state_of(row)) for row in range(625)}
    assert drawn <= known
    assert len(drawn) > 500


def test_all_legal_states_of_hanoi():
    venv = make("Hanoi-v0", 6 * 27).unwrapped
    assert venv.count_starts({"n_discs": 3}, any_state=True) == 6 * 27
    venv.reset_to({"n_discs": 3}, np.arange(6 * 27), any_state=True)
    states = [venv.state_of(row) for row in range(6 * 27)]
    expected = {
        (*discs, *pegs)
        for discs in itertools.product(range(3), repeat=3)
        for pegs in itertools.permutations(range(3), 2)
    }
    assert {(*state["discs"], state["source"], state["target"]) for state in states} == expected


def test_going_on_begins_no_new_episode():
    venv = make("Hanoi-v0", 1).unwrapped
    venv.reset_to({"n_discs": 1, "source": 0, "target": 2}, np.array([0]))
    observation, reward, solved = venv.advance(np.array([1]))
    assert solved[0]
    assert reward[0] == pytest.approx(0.99)
    single = gym.make("Hanoi-v0", n_discs=1)
    single.reset()
    np.testing.assert_array_equal(single.step(1)[0], observation[0])
    assert venv.state_of(0)["discs"] == [2]


@pytest.mark.parametrize(("env_id", "variation", "any_state"), [
    ("Stacking-v0", {"n_plates": 2}, True),
    ("Hiking-v0", {"n_stars": 1}, True),
    ("Hiking-v0", {"n_stars": 1, "layout": "random"}, False),
])  # fmt: skip
def test_what_cannot_be_counted_is_said(env_id, variation, any_state):
    with pytest.raises(ValueError, match="cannot be counted"):
        make(env_id, 1).unwrapped.count_starts(variation, any_state)


def test_numbers_beyond_the_last_start_are_refused():
    with pytest.raises(ValueError, match="1 from 0 to 5"):
        make("Hanoi-v0", 1).unwrapped.reset_to({"n_discs": 2}, np.array([6]))


@pytest.mark.parametrize(("n_things", "size"), [(5, 3), (6, 1), (4, 4), (7, 2)])
def test_numbers_name_choices_one_to_one(n_things, size):
    found = arrangements(np.arange(math.perm(n_things, size)), n_things, size)
    assert set(map(tuple, found.tolist())) == set(itertools.permutations(range(n_things), size))
    found = subsets(np.arange(math.comb(n_things, size)), n_things, size)
    assert sorted(tuple(sorted(row)) for row in found.tolist()) == list(itertools.combinations(range(n_things), size))
