"""Stalls: standing still and going round in a circle are found, moving on is not."""

from types import SimpleNamespace

import numpy as np
import pytest

from sb3_progpolicy.imitation.stalls import VISITS, Stalls


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
