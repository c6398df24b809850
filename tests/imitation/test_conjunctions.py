"""Conditions of several sums: found, kept in lists, written as programs."""

from dataclasses import replace

import numpy as np
import pytest

from sb3_progpolicy.evaluation import evaluate_program
from sb3_progpolicy.imitation import candidates, imitate
from sb3_progpolicy.imitation.actions import ActionCodec
from sb3_progpolicy.imitation.candidates import Plain
from sb3_progpolicy.imitation.conjunctions import ConditionFitter, holds
from sb3_progpolicy.imitation.conversion import rounded, to_program
from sb3_progpolicy.imitation.decision_list import Data, DecisionList
from sb3_progpolicy.imitation.learner import Learner, Settings
from sb3_progpolicy.imitation.losses import BoxLoss, mean_loss
from sb3_progpolicy.imitation.ordering import Ordering
from sb3_progpolicy.imitation.saving import State, load_state, save_state
from sb3_progpolicy.imitation.tuning import fine_tune
from sb3_progpolicy.programs import ActionSpec, ProgramRunner

# Both 0.3 - x0 and x1 - 0.2 have to be there, or x2 alone.
SUMS = np.array([[-1.0, 0, 0, 0.3], [0, 1.0, 0, -0.2], [0, 0, 1.0, -1.2]])
CONTROLLERS = np.zeros((3, 1, 4))
CONTROLLERS[:, 0, 3] = 0.8, -0.2, -0.8
KNOWN = DecisionList(SUMS, CONTROLLERS, np.array([0, 0, 1]))


def some_inputs(n=4000, seed=0):
    return np.column_stack([np.random.default_rng(seed).normal(size=(n, 3)), np.ones(n)])


def test_list_holds_where_all_sums_of_a_condition_do():
    inputs = some_inputs()
    both = (inputs[:, 0] <= 0.3) & (inputs[:, 1] >= 0.2)
    np.testing.assert_array_equal(KNOWN.branches(inputs), np.where(both, 0, np.where(inputs[:, 2] >= 1.2, 1, 2)))
    np.testing.assert_array_equal(KNOWN.sums_of(0), SUMS[:2])
    np.testing.assert_array_equal(holds(inputs, SUMS[:2]), both)


def test_branches_go_with_all_their_sums():
    assert KNOWN.n_branches == 3
    shorter = [KNOWN.without(index) for index in range(3)]
    assert [one.owners.tolist() for one in shorter] == [[0], [0, 0], [0, 0]]
    np.testing.assert_array_equal(shorter[0].conditions, SUMS[2:])
    np.testing.assert_array_equal(shorter[1].controllers[:, 0, 3], [0.8, -0.8])
    np.testing.assert_array_equal(shorter[2].controllers[:, 0, 3], [0.8, -0.2])


def test_condition_of_two_sums_is_found_and_one_that_needs_no_second_has_none():
    inputs, fitter = some_inputs(), ConditionFitter(price=1.0, worth=5.0, most=3)
    gains = np.where(holds(inputs, SUMS[:2]), 1.0, -1.0)
    sums, value = fitter.first(inputs, gains, np.array([-1.0, 1.0, 0, 0]))
    assert len(sums) == 2
    assert value == fitter.value(inputs, gains, sums) == pytest.approx(gains[gains > 0].sum() - 7, abs=5)
    again = fitter.again(inputs, gains, np.vstack([sums, [0, 0, 0, 1.0]]), same_inputs=False)
    assert len(again) == 2  # what always holds is not worth its place
    assert fitter.price_of(again) == 2 + 5
    assert fitter.value(inputs, gains, again) >= value
    alone = np.where(holds(inputs, SUMS[:1]), 1.0, -1.0)
    assert len(fitter.first(inputs, alone, SUMS[0])[0]) == 1
    assert len(ConditionFitter(1.0, 5.0, 1).first(inputs, gains, sums[0])[0]) == 1


def test_order_asks_for_several_things_at_once_where_that_pays():
    inputs = some_inputs()
    data = Data(inputs, KNOWN.outputs(inputs), np.ones(len(inputs)))
    losses = BoxLoss(np.array([True])).matrix(data, CONTROLLERS)
    single, several = (Ordering(data, losses, 3, most) for most in (1, 3))
    order = several.fit()
    assert sorted(map(len, order.conditions)) == [1, 2]
    found = order.as_list(CONTROLLERS)
    assert (found.branches(inputs) == KNOWN.branches(inputs)).mean() > 0.99
    assert several.cost(order) < 0.2 * single.cost(single.fit())
    assert several.cost(several.fit(order)) <= several.cost(order)


def test_list_becomes_a_program_of_the_same_actions():
    inputs = some_inputs(200)
    action = ActionSpec("box", (1,), (-1.0,), (1.0,))
    program = to_program(KNOWN, action, ("a", "b", "c"), ("move",), False)
    assert [condition.cell for condition in program.conditions] == ["min", "affine"]
    np.testing.assert_allclose(ProgramRunner(program, 200).act(inputs[:, :3]), KNOWN.outputs(inputs), rtol=1e-6)
    digits = rounded(replace(KNOWN, conditions=3.3 * SUMS), 2, np.ones(1))
    np.testing.assert_allclose(digits.conditions, SUMS)
    assert digits.owners.tolist() == [0, 0, 1]


def test_numbers_of_all_sums_are_tuned():
    inputs = some_inputs()
    data, loss = Data(inputs, KNOWN.outputs(inputs), np.ones(len(inputs))), BoxLoss(np.array([True]))
    shifted = replace(KNOWN, conditions=SUMS + np.array([0, 0, 0, 0.3]))
    tuned = fine_tune(loss, shifted, data, 300, 0, (0.1, 0.02), keep_zeros=True)
    assert tuned.owners.tolist() == [0, 0, 1]
    assert mean_loss(loss, tuned, data) < 0.3 * mean_loss(loss, shifted, data)


def test_state_keeps_which_condition_each_sum_is_of(tmp_path):
    empty, plain = np.zeros((0, 3), dtype=np.float32), Plain(KNOWN, (0.5, 0.75), 3)
    state = State(1, 2, {}, empty, np.zeros((0, 1)), np.zeros(0), KNOWN, (plain,), (0.5, KNOWN), (), {}, 0.0, True)
    save_state(tmp_path / "state.npz", {}, state)
    found = load_state(tmp_path / "state.npz", {})
    assert (found.plain[0].scores, found.plain[0].n_lost) == ((0.5, 0.75), 3)
    assert found.has_goal
    for program in (found.present, found.best[1], found.plain[0].candidate):
        np.testing.assert_array_equal(program.branches(some_inputs()), KNOWN.branches(some_inputs()))


def test_learner_makes_lists_of_several_sums_and_goes_on_from_them():
    spec = ActionSpec("box", (1,), (-1.0,), (1.0,))
    codec = ActionCodec(spec, ("move",))
    learners = {most: Learner(codec, np.ones(3, dtype=bool), Settings(4, 0, max_sums=most)) for most in (1, 3)}
    inputs = some_inputs()
    for learner in learners.values():
        learner.add(inputs[:, :-1].astype(np.float32), KNOWN.outputs(inputs), np.ones(len(inputs)))
    [single], [several] = (learner.plain([], anew=False) for learner in learners.values())
    assert len(single.owners) == single.n_branches - 1
    assert several.owners.tolist() in ([0, 0, 1], [0, 1, 1])
    assert (several.outputs(inputs) - KNOWN.outputs(inputs)).std() < 0.1
    again = learners[3].plain([several], anew=False)
    assert again[0].owners.tolist() == several.owners.tolist()


def test_list_with_several_sums_takes_one_more_branch():
    longer = KNOWN.insert(1, np.ones(4), np.ones((1, 4)))
    assert longer.owners.tolist() == [0, 0, 1, 2]
    np.testing.assert_array_equal(longer.conditions[[0, 1, 3]], SUMS)
    assert KNOWN.insert(0, np.ones(4), np.ones((1, 4))).owners.tolist() == [0, 1, 1, 2]
    with pytest.raises(AssertionError, match="each condition has a sum"):
        DecisionList(SUMS, CONTROLLERS)


def test_plain_list_is_taken_and_rounds_end_once_it_has_lost_no_episode_of_many(monkeypatch):
    assert not Plain(KNOWN, (0.9,) * 5, 1).is_sure
    assert not Plain(KNOWN, (0.9,) * 3).and_then(0.9, 0).is_sure
    assert Plain(KNOWN, (0.9,) * 3).and_then(0.9, 0).and_then(0.9, 0).is_sure
    monkeypatch.setattr(candidates, "_SURE", 2)
    seen = []
    arguments = {"n_timesteps": 1000, "n_episodes": 4, "max_conditions": 2, "n_envs": 4, "cell": "min"}
    program = imitate("planner", "PandaReach-v0", **arguments, callback=seen.append)
    rounds = [progress.round for progress in seen]
    assert rounds == [*range(1, 7), seen[0].n_rounds]  # plain lists are made from the sixth round on
    assert {condition.cell for condition in program.conditions} <= {"affine", "min"}
    assert len(program.conditions) <= 2
    (row,) = evaluate_program(program, "PandaReach-v0", [{"n_targets": 2}], 4)
    assert row.success_rate == 1


def test_discrete_actions_are_not_accepted():
    with pytest.raises(ValueError, match="cell='min' is not accepted for discrete actions; for Box actions it is"):
        imitate(lambda observations: np.zeros(len(observations)), "CartPole-v1", n_timesteps=2000, cell="min")
    with pytest.raises(ValueError, match="cell='min' is not accepted with max_conditions=0; with at least 1 it is"):
        imitate("planner", "PandaReach-v0", n_timesteps=2000, cell="min", max_conditions=0)
    with pytest.raises(ValueError, match=r"plain_tolerance=0\.1 is not accepted with cell='min'"):
        imitate("planner", "PandaReach-v0", n_timesteps=2000, cell="min", plain_tolerance=0.1)
