"""Conditions with a memory of one bit become switches, if whole episodes agree."""

import dataclasses

import numpy as np
import pytest

from sb3_progpolicy import evaluate_program, load_pretrained, simplify
from sb3_progpolicy.analysis.switches import disagreements, replace_switches
from sb3_progpolicy.programs import Condition, IfThenElse, export_text
from tests.analysis import maze, point

VARIATIONS = [{"length": 2}, {"length": 3}]


@pytest.fixture(autouse=True, scope="module")
def domain():
    with maze.registered(), point.registered():
        yield


def success(program):
    lengths = [{"length": length} for length in (2, 3, 6)]
    return [row.success_rate for row in evaluate_program(program, maze.ID, lengths, 20)]


def test_hand_made_programs_are_what_they_are_called():
    assert success(maze.program(maze.LATCH)) == success(maze.program(maze.SWITCH)) == [1, 1, 1]
    assert max(success(maze.program(maze.TURNS))) < 1


def test_memory_that_acts_as_a_switch_becomes_one_of_few_whole_numbers():
    program = maze.program(maze.LATCH)
    found = replace_switches(program, maze.ID, VARIATIONS)
    (switch,) = found.program.conditions
    assert switch.cell == "switch"
    assert found.terms == {0: 4}, "a weight and a constant for each rule"
    assert found.bounds == {0: 3}
    assert np.count_nonzero(switch.weight_ih) + np.count_nonzero(switch.bias_ih) == found.terms[0]
    assert success(found.program) == [1, 1, 1]
    assert disagreements(program, found.program, found.traces) == 0
    assert found.program.controllers == program.controllers


def test_it_is_printed_as_what_turns_it_on_and_off():
    text = export_text(replace_switches(maze.program(maze.LATCH), maze.ID, VARIATIONS).program)
    assert "B1 = 0.50 while on, -0.50 while off\n    on when  -1 + 2*cue_right >= 0\n" in text
    assert "    off when -1 + 2*cue_left >= 0\n" in text


def test_a_switch_stays_a_switch():
    found = replace_switches(maze.program(maze.SWITCH), maze.ID, VARIATIONS)
    assert found.terms == {0: 4}
    assert disagreements(maze.program(maze.SWITCH), found.program, found.traces) == 0


def test_memory_that_is_no_switch_stays_as_it_is():
    program = maze.program(maze.TURNS)
    found = replace_switches(program, maze.ID, VARIATIONS)
    assert found.program == program
    assert found.terms == {}


def test_memory_of_more_than_one_unit_stays_as_it_is():
    one = maze.LATCH
    two = dataclasses.replace(
        one, weight_ih=one.weight_ih * 2, weight_hh=((3.4, 0.0), (0.0, 3.4)), bias_ih=one.bias_ih * 2,
        bias_hh=(0.0, 0.0), readout=(0.85, 0.85),
    )  # fmt: skip
    program = maze.program(two)
    assert success(program) == [1, 1, 1]
    assert replace_switches(program, maze.ID, VARIATIONS).program == program


def test_steps_in_which_two_programs_differ_are_counted():
    found = replace_switches(maze.program(maze.LATCH), maze.ID, VARIATIONS)
    never = maze.program(dataclasses.replace(maze.SWITCH, bias_ih=(-9.0, -9.0)))
    ends = sum(int(trace[..., 2].sum()) for trace in found.traces)
    assert 0 < disagreements(maze.program(maze.LATCH), never, found.traces) < ends


def test_simplified_program_with_continuous_actions_has_the_switch():
    # At the start it reads where it is; from then on it only remembers which controller to use.
    plain = point.slow()
    far = Condition("rnn", ((9.0, 9.0, 0.0),), ((9.0,),), (0.0,), (0.0,), (2.0,), 0.1)
    program = dataclasses.replace(plain, body=IfThenElse(far, plain.controllers[0], plain.controllers[0]))
    found = replace_switches(program, point.ID, [{"distance": 0.5}], max_weight=100)
    assert [condition.cell for condition in found.program.conditions] in (["switch"], ["rnn"])
    assert disagreements(program, found.program, found.traces) == 0


def hanoi_with_a_memory():
    """The shipped program twice, of which one acts while the last move but one was from the first peg."""
    program = load_pretrained("Hanoi-v0")
    (controller,) = program.controllers
    weights = [0.0] * program.n_inputs
    for k, name in enumerate(program.input_names):
        if name.startswith("previous move"):
            weights[k] = 8.0 if name.startswith("previous move 0") else -8.0 if "->0" in name else 0.0
    latch = Condition("rnn", (tuple(weights),), ((4.0,),), (0.0,), (0.0,), (1.5,), -0.2)
    return dataclasses.replace(program, body=IfThenElse(latch, controller, controller))


def test_discrete_program_is_simplified_with_its_switch():
    program = hanoi_with_a_memory()
    found = simplify(program, time_limit=2)
    (switch,) = found.program.conditions
    assert switch.cell == "switch"
    assert found.notes == ()
    for row in evaluate_program(found.program, variations=[{"n_discs": n} for n in (1, 2, 3, 4)]):
        assert row.ratio == 1
