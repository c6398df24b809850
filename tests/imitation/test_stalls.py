"""Stalls: standing still and going round in a circle are found, moving on is not."""

from types import SimpleNamespace

import numpy as np
import pytest

from sb3_progpolicy.imitation.rollouts import Pool, play
from sb3_progpolicy.imitation.stalls import VISITS, Patience, Stalls


def counts(path, state=None):
    """Return how often each state of a path was visited, by a tracker that knows the deviations."""
    stalls = Stalls(1)
    stalls.deviations = np.ones(len(path[0]))
    env = SimpleNamespace()
    env.unwrapped = env
    found = []
    for index, place in enumerate(path):
        if state is not None:
            env.state = {"at": state[index]}
        found.append(int(stalls.visits([env], np.array([place], dtype=np.float32))[0]))
    return found


def test_cycle_that_drifts_is_a_stall():
    cycle = [(0.0, 0.0), (0.3, 0.0), (0.3, 0.4), (0.0, 0.4)]
    path = [(x + 0.002 * step, y) for step, (x, y) in enumerate(cycle * 4)]
    assert counts(path)[4 * (VISITS - 1) :] == [3, 3, 3, 3, 4, 4, 4, 4]


def test_way_that_leads_on_is_none():
    assert max(counts([(0.06 * step, np.sin(step)) for step in range(50)])) == 1


def test_what_differs_in_one_input_is_another_state():
    assert counts([(0.0, 0.0), (0.0, 1.0), (0.0, 0.0), (0.0, 1.0)]) == [1, 1, 2, 2]


def test_state_of_the_environment_decides_where_there_is_one():
    assert counts([(0.0,)] * 4, state=["a", "b", "c", "a"]) == [1, 1, 1, 2]


@pytest.mark.parametrize(("known", "way", "expected"), [(True, 0.04, 2), (False, 0.04, 1), (False, 1e-4, 2)])
def test_episodes_are_apart_and_only_equal_states_count_before_deviations_are_known(known, way, expected):
    stalls = Stalls(2)
    if known:
        stalls.deviations = np.ones(1)
    env = SimpleNamespace()
    env.unwrapped = env
    inputs = np.zeros((2, 1), dtype=np.float32)
    assert stalls.visits([env, env], inputs).tolist() == [1, 1]
    stalls.forget(0)
    assert stalls.visits([env, env], inputs + np.float32(way)).tolist() == [1, expected]


@pytest.mark.parametrize(("way", "limit", "least", "most"), [(0.0, 1000, 11, 25), (1.0, 30, 30, 30)])
def test_validation_gives_up_what_stands_still_or_takes_far_too_long(way, limit, least, most):
    taken = []

    def act(observations):
        """Stand still, or go around."""
        taken.append(len(observations))
        moves = [way * np.sin(len(taken) / 7), way * np.cos(len(taken) / 7), 0.0, -1.0]
        return np.tile(np.array(moves, dtype=np.float32), (len(observations), 1))

    patience = Patience(2, limit)
    patience.stalls.deviations = np.full(32, 0.4)
    with Pool("PandaReach-v0", 2) as pool:
        whole = play(pool, [{"n_targets": 3}], 2, 0, act)
        assert len(taken) == pool.cap
        taken.clear()
        given_up = play(pool, [{"n_targets": 3}], 2, 0, act, patience=patience)
    assert least <= len(taken) <= most
    assert not whole.successes.any()
    assert given_up.successes.tolist() == [False, False]
    assert given_up.steps.tolist() == whole.steps.tolist() == [pool.cap, pool.cap]
