"""Where a branch is divided: where the policy gradient of its controller points another way."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from progpolicy_envs.symmetry import Permutation, Symmetry
from sb3_progpolicy.policies import ProgrammaticPolicy
from sb3_progpolicy.reptile_ppo.divisions import MIN_STATES, Experience, rank_divisions, tries

OBSERVATIONS = spaces.Box(-1, 1, (4,), np.float32)
SWAP = Symmetry("swap", Permutation.of([0, 1, 3, 2]), Permutation.of([1, 0]))


def policy_of(action_space=None, n_conditions=0, **kwargs):
    th.manual_seed(0)
    policy = ProgrammaticPolicy(OBSERVATIONS, action_space or spaces.Discrete(2), lambda _: 1e-3, depth=3, **kwargs)
    policy.module.search.select(n_conditions)
    return policy


def experience_of(policy, advantage, n=3000, seed=0):
    """Random states and actions; ``advantage`` says how good an action is in a state."""
    rng = np.random.default_rng(seed)
    observations = rng.uniform(-1, 1, (n, 4)).astype(np.float32)
    if isinstance(policy.action_space, spaces.Discrete):
        actions = rng.integers(2, size=n)
    else:
        actions = rng.standard_normal((n, 1)).astype(np.float32)
    good = np.asarray(advantage(observations, actions.reshape(n, -1)[:, 0]), dtype=np.float32)
    tensors = (th.from_numpy(array) for array in (observations, actions, good))
    observations, actions, good = tensors
    with th.no_grad():
        values = policy.condition_values(observations)
    return Experience(observations, values, actions, good)


def either_or(x, action):
    """The first two inputs say together which action is right; the others say nothing."""
    return np.where(x[:, 0] * x[:, 1] > 0, 1, -1) * (2 * (action > 0.5) - 1)


@pytest.mark.parametrize("action_space", [spaces.Discrete(2), spaces.Box(-1, 1, (1,), np.float32)])
def test_inputs_that_change_what_is_right_come_first(action_space):
    policy = policy_of(action_space)
    candidates = rank_divisions(policy, experience_of(policy, either_or))
    statistics = {candidate.input: candidate.statistic for candidate in candidates}
    assert [candidate.statistic for candidate in candidates] == sorted(statistics.values(), reverse=True)
    assert min(statistics[0], statistics[1]) > 10 * max(statistics[2], statistics[3])
    best = next(candidate for candidate in candidates if candidate.input in (0, 1))
    weight = np.array(best.division.weight)
    assert np.flatnonzero(weight).tolist() == [best.input]
    assert -best.division.bias / weight[best.input] == pytest.approx(0, abs=0.15), "where the sign changes"
    assert weight[best.input] == pytest.approx(3**0.5, rel=0.05), "of standard deviation 1"


def test_slanted_division_is_found_where_two_inputs_decide_together():
    policy = policy_of()

    def slanted(x, action):
        return np.where((x[:, 0] + x[:, 1] > 0) == (x[:, 2] > 0), 1, -1) * (2 * (action > 0.5) - 1)

    best = rank_divisions(policy, experience_of(policy, slanted))[0]
    sums = np.random.default_rng(1).uniform(-1, 1, (4000, 4)) @ np.array(best.division.weight) + best.division.bias
    assert sums.std() == pytest.approx(1, rel=0.1)
    assert abs(sums.mean()) < 0.3


def test_nothing_stands_out_where_one_controller_is_right_everywhere():
    policy = policy_of()
    candidates = rank_divisions(policy, experience_of(policy, lambda x, action: np.ones(len(x))))
    noise = rank_divisions(
        policy, experience_of(policy, lambda x, action: np.random.default_rng(2).normal(size=len(x)))
    )
    assert all(candidate.statistic < 4 for candidate in (*candidates, *noise) if candidate.input >= 0)


def test_branch_that_disagrees_is_the_one_to_divide():
    policy = policy_of(n_conditions=1)
    with th.no_grad():
        policy.module.conditions.affine.weight.copy_(th.tensor([[0, 0, 0, 50.0]] * 2))
        policy.module.conditions.affine.bias.zero_()
    for then in (True, False):

        def in_branch(x, action, then=then):
            return np.where((x[:, 3] >= 0) == then, either_or(x, action), 0)

        candidates = rank_divisions(policy, experience_of(policy, in_branch, n=6000))
        assert candidates[0].division.then == then
        assert {candidate.division.then for candidate in candidates} == {False, True}


def test_branch_that_is_hardly_reached_is_not_divided():
    policy = policy_of(n_conditions=1)
    with th.no_grad():
        policy.module.conditions.affine.weight.zero_()
        policy.module.conditions.affine.bias.fill_(20.0)
    candidates = rank_divisions(policy, experience_of(policy, either_or))
    assert {candidate.division.then for candidate in candidates} == {True}
    assert rank_divisions(policy_of(), experience_of(policy_of(), either_or, n=MIN_STATES - 1)) == []


def test_tied_program_is_divided_by_what_the_symmetry_leaves_alone():
    policy = policy_of(symmetries=[SWAP])

    def turned(x, action):
        return np.where(x[:, 0] > 0, 1, -1) * np.sign(x[:, 2] - x[:, 3]) * (2 * (action > 0.5) - 1)

    best = rank_divisions(policy, experience_of(policy, turned))
    assert best[0].input in (0, -1)
    assert next(candidate.input for candidate in best if candidate.input >= 0) == 0
    assert {candidate.input for candidate in best} <= {0, 1, 2, -1}, "the last two have one mean"


def test_inputs_that_never_change_are_passed_over():
    policy = policy_of()
    experience = experience_of(policy, either_or)
    experience.observations[:, 3] = 0.5
    assert 3 not in {candidate.input for candidate in rank_divisions(policy, experience)}


def test_candidates_are_tried_one_after_the_other():
    policy = policy_of()
    candidates = rank_divisions(policy, experience_of(policy, either_or))
    assert [tries(candidates, number) for number in range(len(candidates) + 1)] == [*candidates, candidates[0]]
    assert tries([], 3) is None
