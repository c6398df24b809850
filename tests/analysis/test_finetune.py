"""Pruned programs trained on: what is zero stays zero, and only what is better is taken."""

import dataclasses

import numpy as np
import pytest

from sb3_progpolicy import evaluate_program, load_pretrained, simplify
from sb3_progpolicy.analysis import prune
from sb3_progpolicy.analysis.finetune import finetune
from sb3_progpolicy.cli import run
from sb3_progpolicy.programs import Condition, Controller, IfThenElse
from tests.analysis import point

VARIATIONS = [{"distance": 0.5}, {"distance": 1.0}]


@pytest.fixture(autouse=True, scope="module")
def domain():
    with point.registered():
        yield


def steps(program):
    return np.mean([row.steps_mean for row in evaluate_program(program, point.ID, VARIATIONS, 10)])


@pytest.fixture(scope="module")
def trained(domain):
    return finetune(point.slow(), point.ID, VARIATIONS, [point.SWAP], 8_192, 0)


def test_numbers_that_are_not_zero_are_trained_and_the_others_stay_zero(trained):
    program, learned_by = trained
    before, after = (np.array(one.controllers[0].weights) for one in (point.slow(), program))
    np.testing.assert_array_equal(after != 0, before != 0)
    assert after[0, 0] < -1.05, "it goes faster"
    assert steps(program) < steps(point.slow())
    assert learned_by == "imitation+reinforcement"


def test_numbers_that_a_symmetry_ties_stay_tied(trained):
    weights = np.array(trained[0].controllers[0].weights)
    assert weights[0, 0] == weights[1, 1]


def test_conditions_and_branches_that_never_act_stay(trained):
    assert trained[0].conditions == point.slow().conditions
    np.testing.assert_allclose(trained[0].controllers[1].weights, point.slow().controllers[1].weights, rtol=1e-6)


def test_simplified_program_is_trained_on_and_says_so():
    found = simplify(point.slow(), episodes=4, finetune=8_192)
    (controller,) = found.program.controllers
    assert np.count_nonzero(controller.weights) == found.terms_after == 2
    assert steps(found.program) < steps(point.slow())
    assert found.program.metadata["simplified"]["finetuned"] == 8_192
    assert found.program.learned_by == "imitation+reinforcement"
    assert found.notes == ()
    numbers = np.array(controller.weights).ravel()
    assert all(number == float(f"{number:.2e}") for number in numbers), "at most three digits"


def outcome(before, after, good):
    """What is made of a pruned program when training changes its success and steps."""
    worse = prune.Point(2, point.slow(), *before)
    pruned = prune.Pruned(worse, (worse,), 10, 10, False, ())
    learned = (point.slow(-2.345678), "imitation+reinforcement")
    return prune._finetuned(pruned, lambda program: learned, 100, lambda program: after, lambda *one: good(*one))


@pytest.mark.parametrize(
    ("before", "after", "taken"),
    [
        ((1.0, 30.0), (1.0, 20.0), True),
        ((0.9, 30.0), (1.0, 40.0), True),
        ((1.0, 30.0), (0.9, 20.0), False),
        ((1.0, 30.0), (1.0, 30.0), False),
        ((1.0, 30.0), (1.0, 31.0), False),
    ],
)
def test_only_what_is_better_is_taken(before, after, taken):
    found = outcome(before, after, lambda success, steps: True)
    assert found.finetuned == (100 if taken else 0)
    assert (found.point.success_rate, found.point.steps_mean) == (after if taken else before)
    if taken:
        assert found.point.program.controllers[0].weights[0][0] == -2, "the roundest number that is better"
        assert found.learned_by == "imitation+reinforcement"
    else:
        assert found.point.program == point.slow()
        assert found.notes[0].startswith("100 steps of training made it no better (")


def test_what_is_within_the_tolerance_does_not_leave_it():
    few_steps = (1.0, 50.0)
    assert not outcome((0.9, 30.0), few_steps, lambda success, steps: steps < 40).finetuned
    # A point of the curve that was asked for may be without the tolerance before and after.
    assert outcome((0.9, 60.0), few_steps, lambda success, steps: steps < 40).finetuned


def test_program_with_a_switch_is_not_trained_and_it_is_said():
    plain = point.slow()
    switch = Condition(
        "switch", ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)), ((0.0,), (0.0,)), (-0.5, -0.5), (0.0, 0.0), (1.0,), -0.5
    )
    two = (Controller(((gain, 0.0, 0.0), (0.0, gain, 0.0)), (0.0, 0.0)) for gain in (-1.0, -3.0))
    found = simplify(dataclasses.replace(plain, body=IfThenElse(switch, *two)), episodes=2, finetune=1000)
    assert found.notes[-1] == "it was not trained on: a switch has no gradient, so that training cannot start from it"
    assert found.program.learned_by == "imitation"


def test_decisions_are_not_trained():
    with pytest.raises(ValueError, match="finetune=100 is not accepted for Discrete"):
        simplify(load_pretrained("Hanoi-v0"), finetune=100)
    with pytest.raises(ValueError, match="finetune=0 is not accepted; it is at least 1"):
        simplify(point.slow(), finetune=0)


def test_command_passes_it_on(tmp_path, monkeypatch):
    asked = []

    def simplified(*arguments, finetune, **others):
        asked.append(finetune)
        raise ValueError("enough")

    monkeypatch.setattr("sb3_progpolicy.analysis.simplify.simplify", simplified)
    assert run(["simplify", "PandaReach-v0", "--finetune", "500"]) == 2
    assert asked == [500]
