"""Decision lists recovered from labels that a known list gave."""

import numpy as np
import pytest

from sb3_progpolicy.imitation.conditions import fit_condition, fit_sparse_condition, improve
from sb3_progpolicy.imitation.conversion import rounded, significant, to_program
from sb3_progpolicy.imitation.decision_list import Data, DecisionList, Scaler
from sb3_progpolicy.imitation.fitting import alternate, drop_branches, fit_planes, grow, sparsify
from sb3_progpolicy.imitation.losses import BoxLoss, DiscreteLoss, eliminate, mean_loss
from sb3_progpolicy.imitation.tuning import fine_tune
from sb3_progpolicy.programs import ProgramRunner
from sb3_progpolicy.spaces import ActionSpec

BOX, DISCRETE = BoxLoss(np.array([True, True])), DiscreteLoss()


def data_of(program, n=2000, seed=0, encode=lambda outputs: np.clip(outputs, -1, 1)):
    rng = np.random.default_rng(seed)
    inputs = np.column_stack([rng.normal(size=(n, program.controllers.shape[2] - 1)), np.ones(n)])
    return Data(inputs, encode(program.outputs(inputs)), np.ones(n))


@pytest.fixture
def known():
    """Three branches on five inputs."""
    conditions = np.array([[1.0, 0, 0, 0, 0, -0.5], [0, 1.0, -1.0, 0, 0, 0]])
    controllers = np.zeros((3, 2, 6))
    controllers[0, :, 5] = 0.5, -0.5
    controllers[1, 0, 2], controllers[1, 1, 3] = 0.4, -0.6
    controllers[2, 0, 0], controllers[2, 1, 4] = -0.5, 0.3
    return DecisionList(conditions, controllers)


def one_hot(outputs):
    return np.eye(outputs.shape[1])[outputs.argmax(axis=1)]


@pytest.mark.parametrize("fit", ["grow", "planes"])
def test_list_of_three_branches_is_recovered(known, fit):
    data, rng = data_of(known), np.random.default_rng(0)
    found = grow(BOX, data, 6, rng) if fit == "grow" else fit_planes(BOX, data, 4, 6, rng)
    found = alternate(BOX, fine_tune(BOX, found, data, 800, seed=0), data)
    fresh = data_of(known, seed=1)
    # Growing is greedy: it needs more branches than there are. Its start competes with the other one.
    assert mean_loss(BOX, found, fresh) < (0.1 if fit == "grow" else 0.02)
    assert mean_loss(BOX, grow(BOX, data, 1, rng), fresh) > 0.4


def test_list_for_discrete_actions_is_recovered():
    program = DecisionList(np.array([[1.0, 0, 0, 0.0]]), np.zeros((2, 3, 4)))
    program.controllers[0, :, 1] = 1, -1, 0
    program.controllers[1, :, 2] = 0, 1, -1
    data = data_of(program, encode=one_hot)
    found = fine_tune(DISCRETE, grow(DISCRETE, data, 4, np.random.default_rng(0)), data, 800, seed=0)
    fresh = data_of(program, seed=1, encode=one_hot)
    assert np.mean(found.outputs(fresh.inputs).argmax(axis=1) == fresh.targets.argmax(axis=1)) > 0.97


def test_sparse_list_reads_what_the_known_one_reads(known):
    data = data_of(known)
    dense = fine_tune(BOX, known, data, 50, seed=0)
    assert (dense.conditions != 0).all()
    sparse = sparsify(BOX, dense, data, 0.003)
    assert ((sparse.conditions[:, :-1] != 0) == (known.conditions[:, :-1] != 0)).all()
    assert ((sparse.controllers[..., :-1] != 0) == (known.controllers[..., :-1] != 0)).all()
    tuned = fine_tune(BOX, sparse, data, 50, seed=0, keep_zeros=True)
    assert ((tuned.controllers == 0) == (sparse.controllers == 0)).all()


def test_sparse_discrete_controller_reads_one_input():
    program = DecisionList(np.zeros((0, 6)), np.zeros((1, 2, 6)))
    program.controllers[0, 0, 2] = 1.0
    data = data_of(program, encode=one_hot)
    sparse = DISCRETE.fit_sparse(data, np.zeros((2, 6)), 0.01)
    assert set(np.nonzero(sparse[:, :-1])[1]) == {2}


def test_controller_beyond_a_bound_that_the_label_is_at_costs_nothing():
    inputs = np.column_stack([np.linspace(-3, 3, 300), np.ones(300)])
    targets = np.clip(inputs[:, :1] * [1.0, -2.0], -1, 1)
    fitted = BOX.fit(Data(inputs, targets, np.ones(300)))
    np.testing.assert_allclose(fitted, [[1, 0], [-2, 0]], atol=0.1)
    unbounded = BoxLoss(np.array([False, False])).fit(Data(inputs, targets, np.ones(300)))
    assert unbounded[0, 0] < 0.6


def test_overshoot_of_a_shortened_direction_is_cheap():
    data = Data(np.ones((1, 1)), np.array([[1.0, 0.5]]), np.ones(1))
    over, under = np.array([[[1.0], [0.7]]]), np.array([[[1.0], [0.3]]])
    directed = BoxLoss(np.array([True, True]), direction=(0, 1))
    assert directed.matrix(data, over) < 0.2 * directed.matrix(data, under)
    assert BOX.matrix(data, over) == pytest.approx(BOX.matrix(data, under))


def test_condition_holds_where_there_is_something_to_gain():
    rng = np.random.default_rng(0)
    inputs = np.column_stack([rng.normal(size=(1000, 6)), np.ones(1000)])
    gains = np.where(inputs[:, 3] > 0.4, 1.0, -0.5)
    condition, value = fit_condition(inputs, gains)
    assert value > 0.97 * gains[gains > 0].sum()
    sparse = fit_sparse_condition(inputs, gains, condition, tolerance=5.0)
    assert np.flatnonzero(sparse[:-1]).tolist() == [3]
    assert -sparse[-1] / sparse[3] == pytest.approx(0.4, abs=0.05)
    assert fit_condition(inputs, -np.ones(1000))[0] is None


def test_condition_is_improved_by_its_true_gain():
    rng = np.random.default_rng(0)
    inputs = np.column_stack([rng.normal(size=(2000, 3)), np.ones(2000)])
    true = np.array([1.0, -0.7, 0.0, 0.3])
    gains = np.where(inputs @ true > 0, 1.0, -1.0)
    start = np.array([1.0, 0.2, 0.3, -0.2])
    condition, value = improve(inputs, gains, start, cycles=20)
    assert value == gains[inputs @ condition >= 0].sum() > 0.99 * gains[gains > 0].sum()


def test_needed_input_is_eliminated_last():
    masks, _ = zip(*eliminate(np.eye(4), np.array([0.1, 2.0, 0.5, 9.0])), strict=True)
    assert [mask[:-1].tolist() for mask in masks[1:3]] == [[False, True, True], [False, True, False]]
    assert all(mask[-1] for mask in masks)


def test_branch_that_nothing_enters_is_dropped(known):
    longer = known.insert(1, np.array([0, 0, 0, 0, 0, -1.0]), np.ones((2, 6)))
    assert drop_branches(BOX, longer, data_of(known)).n_branches == 3


@pytest.mark.parametrize("index", [0, 1, 2])
def test_list_without_a_branch_leaves_the_others_as_they_are(known, index):
    shorter = known.without(index)
    assert shorter.n_branches == 2
    np.testing.assert_array_equal(shorter.controllers, np.delete(known.controllers, index, axis=0))


def test_standardised_list_is_the_same_on_raw_inputs(known):
    rng = np.random.default_rng(0)
    observations = rng.normal([5, 0, -3, 1, 2], [0.1, 3, 1, 1, 20], size=(500, 5))
    scaler = Scaler.of(observations, np.ones(5, dtype=bool))
    raw = DecisionList(scaler.to_raw(known.conditions), scaler.to_raw(known.controllers))
    with_constant = np.column_stack([observations, np.ones(500)])
    np.testing.assert_allclose(raw.outputs(with_constant), known.outputs(scaler(observations)), atol=1e-9)
    np.testing.assert_allclose(scaler.from_raw(raw.controllers), known.controllers, atol=1e-9)


def test_constant_and_forbidden_inputs_are_not_read():
    observations = np.column_stack([np.arange(9.0), np.full(9, 7.0), np.arange(9.0) ** 2])
    assert Scaler.of(observations, np.array([True, True, False])).kept.tolist() == [True, False, False]


def test_program_acts_as_the_list(known):
    spec = ActionSpec("box", (2,), (-1.0, -1.0), (1.0, 1.0))
    program = to_program(known, spec, tuple("abcde"), ("x", "y"), False, learned_by="imitation")
    inputs = data_of(known, n=200).inputs
    expected = np.clip(known.outputs(inputs), -1, 1)
    np.testing.assert_allclose(ProgramRunner(program, 200).act(inputs[:, :-1]), expected, atol=1e-6)


def test_numbers_are_rounded_to_significant_digits(known):
    np.testing.assert_array_equal(significant(np.array([0.012345, -678.9, 0.0]), 2), [0.012, -680, 0])
    doubled = DecisionList(2 * known.conditions, known.controllers)
    unit = np.ones(2)
    np.testing.assert_array_equal(rounded(doubled, 2, unit).conditions, rounded(known, 2, unit).conditions)
    small = DecisionList(known.conditions, known.controllers + 0.004)
    assert (rounded(small, 2, unit).controllers[2, :, -1] == 0).all()
    assert (rounded(small, 2, unit).controllers[2, :, 1] == 0.004).all()


def test_no_constant_of_a_condition_parts_equal_values():
    inputs = np.column_stack([np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0]), np.ones(6)])
    gains = np.array([1.0, -3.0, 1.0, 1.0, 1.0, -1.0])
    condition, gain = fit_condition(inputs, gains)
    assert gain == pytest.approx(2.0)
    assert gains[inputs @ condition >= 0].sum() == pytest.approx(gain)
