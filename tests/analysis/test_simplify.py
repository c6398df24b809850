"""The same decisions with fewer numbers, and how few there have to be."""

import dataclasses
import json

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS
from progpolicy_envs.symmetry import group_of
from sb3_progpolicy import load_pretrained
from sb3_progpolicy.analysis.integer import fewest_terms
from sb3_progpolicy.analysis.paths import States
from sb3_progpolicy.analysis.prune import visited
from sb3_progpolicy.analysis.rules import count_numbers
from sb3_progpolicy.analysis.simplify import simplify
from sb3_progpolicy.analysis.situations import good_actions, meet
from sb3_progpolicy.analysis.terms import symmetric_part, terms_of
from sb3_progpolicy.analysis.thin import Thinner
from sb3_progpolicy.analysis.verify import verify
from sb3_progpolicy.cli import run
from sb3_progpolicy.evaluation import evaluate_program
from sb3_progpolicy.programs import Condition, Controller, IfThenElse, ProgramRunner, load_program
from sb3_progpolicy.programs.io import program_digest
from tests.analysis.idle import idle


@pytest.fixture(scope="module")
def hanoi():
    return simplify(load_pretrained("Hanoi-v0"))


def test_hanoi_needs_four_terms_in_one_rule_and_no_program_of_its_form_has_fewer(hanoi):
    assert (hanoi.terms_after, hanoi.terms_lower_bound) == (4, 4)
    assert hanoi.terms_before == count_numbers(load_pretrained("Hanoi-v0")) == 108
    assert (hanoi.tied, hanoi.symmetry, hanoi.exhaustive) == (True, "pegs", True)
    assert (hanoi.situations, hanoi.starts, hanoi.notes) == (54, 24, ())
    assert count_numbers(hanoi.program) == 4 * 6, "each of the four stands in all six rows"


def test_small_program_decides_as_the_original_does_where_it_was_looked_at(hanoi):
    original = load_pretrained("Hanoi-v0")
    inputs = meet(original, "Hanoi-v0", DOMAINS["Hanoi-v0"].trained, 100).inputs
    actions = [ProgramRunner(program, len(inputs)).act(inputs) for program in (original, hanoi.program)]
    np.testing.assert_array_equal(*actions)


def test_margin_is_far_above_what_single_precision_could_change(hanoi):
    original = load_pretrained("Hanoi-v0")
    inputs = meet(original, "Hanoi-v0", DOMAINS["Hanoi-v0"].trained, 100).inputs
    controller = hanoi.program.controllers[0]
    scores = np.sort(inputs @ np.array(controller.weights).T + np.array(controller.bias))
    assert (scores[:, -1] - scores[:, -2]).min() >= 0.25


def test_without_ties_there_are_more_numbers(hanoi):
    free = simplify(load_pretrained("Hanoi-v0"), tie=False, time_limit=5)
    assert free.symmetry is None
    assert hanoi.terms_after < free.terms_after < 108
    assert free.terms_lower_bound <= free.terms_after


def test_where_it_comes_from_is_in_the_file(hanoi, tmp_path):
    hanoi.program.save(tmp_path / "small.json")
    kept = load_program(tmp_path / "small.json").metadata
    assert kept["env"] == "Hanoi-v0"
    assert kept["simplified"] == {
        "from": program_digest(load_pretrained("Hanoi-v0")),
        "terms": 4,
        "terms_lower_bound": 4,
        "symmetry": "pegs",
        "equally_good": "program",
    }


def test_stacking_is_one_rule_of_row_and_column_in_the_planners_steps():
    found = simplify(load_pretrained("Stacking-v0"), equally_good="planner", n_starts=60)
    assert (found.terms_after, found.terms_lower_bound, found.symmetry) == (3, 3, "table")
    assert found.program.metadata["grids"] == [{"name": "table", "start": 0, "rows": 5, "columns": 5}]
    (controller,) = found.program.controllers
    for row in np.array(controller.weights)[:, :25].reshape(5, 5, 5):
        steps = [np.diff(row, axis=axis) for axis in (0, 1)]
        assert all((step == step[0, 0]).all() for step in steps), "an affine function of row and column"
    for result in evaluate_program(found.program, variations=DOMAINS["Stacking-v0"].trained, n_episodes=30):
        assert result.ratio == 1


def test_planner_names_all_actions_that_begin_a_shortest_solution():
    env = gym.make_vec("Stacking-v0", num_envs=1, vectorization_mode="vector_entry_point").unwrapped
    states = [
        {"n_plates": 1, "plates": [[1, 3]], "gripper": [2, 2]},
        {"n_plates": 1, "plates": [[2, 2]], "gripper": [2, 2]},
        {"n_plates": 2, "plates": [[4, 2], [0, 0]], "gripper": [2, 2]},
    ]
    assert good_actions(states, env).tolist() == [
        [True, True, False, False, False], [False, False, False, False, True], [False, False, True, False, False],
    ]  # fmt: skip


@pytest.mark.parametrize("env_id", ["Hanoi-v0", "Stacking-v0", "HikingEgo-v0", "PandaReach-v0"])
def test_what_terms_add_is_the_same_from_all_sides(env_id):
    domain, program = DOMAINS[env_id], idle(env_id, interaction=True)
    n_outputs = program.action.n_outputs
    terms = terms_of(program, n_outputs, domain.symmetries, domain.grids)
    rng = np.random.default_rng(0)
    observation, history = rng.normal(size=program.n_observations), rng.normal(size=n_outputs)
    for symmetry in group_of(domain.symmetries):
        x = np.concatenate([observation, history, [0.3, 0, 1]])
        twin = np.concatenate([symmetry.observation(observation), symmetry.action(history), [0.3, 0, 1]])
        for term in terms:
            np.testing.assert_allclose(term.weights @ twin, symmetry.action(term.weights @ x), atol=1e-9)


def with_a_condition(program, threshold):
    """Two copies of a program's controller, of which one is reached while the first peg is empty."""
    (controller,) = program.controllers
    readout = [0.0] * program.n_inputs
    readout[program.input_names.index("empty[0]")] = 3.7
    condition = Condition("affine", (), (), (), (), tuple(readout), threshold)
    return dataclasses.replace(program, body=IfThenElse(condition, controller, controller))


def test_conditions_become_small_too_and_each_branch_is_looked_at_for_itself():
    found = simplify(with_a_condition(load_pretrained("Hanoi-v0"), -1.3), tie=False, time_limit=3)
    (condition,) = found.program.conditions
    assert np.count_nonzero(condition.readout) + (condition.readout_bias != 0) == 2
    assert set(condition.readout) <= set(range(-8, 9))
    for row in evaluate_program(found.program, variations=DOMAINS["Hanoi-v0"].trained):
        assert row.ratio == 1


def test_branches_that_never_act_are_dropped():
    found = simplify(with_a_condition(load_pretrained("Hanoi-v0"), -100.0))
    assert found.program.conditions == ()
    assert found.terms_after == 4


def test_branches_keep_their_numbers_where_an_earlier_one_is_dropped():
    # The first of three branches never acts; what only the small program meets belongs to the others all the same.
    program = load_pretrained("Hanoi-v0")
    inner = with_a_condition(program, -1.3).body
    never = dataclasses.replace(inner.condition, readout_bias=-100.0)
    nested = dataclasses.replace(program, body=IfThenElse(never, program.controllers[0], inner))
    for equally_good in ("program", "planner"):
        found = simplify(nested, equally_good=equally_good, tie=False, time_limit=3)
        assert len(found.program.conditions) == 1
        assert found.notes == ()
        for row in evaluate_program(found.program, variations=DOMAINS["Hanoi-v0"].trained):
            assert row.ratio == 1


def test_recurrent_conditions_stay_and_it_is_said(hanoi):
    program = hanoi.program
    # A memory of two units, which turns on and off in turns.
    turns = ((-3.0, 0.0), (0.0, 0.0))
    cell = Condition("rnn", ((0.0,) * 17,) * 2, turns, (1.0, 0.0), (0.0, 0.0), (1.0, 0.0), 0.0)
    recurrent = dataclasses.replace(program, body=IfThenElse(cell, program.controllers[0], program.controllers[0]))
    found = simplify(recurrent)
    assert found.program.conditions == (cell,)
    assert "condition 1 has a memory and stays as it is" in found.notes


def test_where_no_tied_rule_is_found_an_untied_one_is_and_it_is_said():
    program = load_pretrained("Hanoi-v0")
    rng = np.random.default_rng(0)
    controller = Controller(tuple(map(tuple, rng.normal(size=(6, 17)).tolist())), tuple(rng.normal(size=6).tolist()))
    found = simplify(dataclasses.replace(program, body=controller), max_weight=1, time_limit=1)
    assert found.notes[0].startswith("controller 1: no tied rule of whole numbers up to 1 was found")
    assert found.symmetry is None
    assert found.terms_lower_bound <= found.terms_after < 6 * 18


def test_where_no_rule_is_found_the_original_stays_and_it_is_said(monkeypatch):
    monkeypatch.setattr("sb3_progpolicy.analysis.rules.fewest_terms", lambda *arguments, **options: None)
    program = load_pretrained("Hanoi-v0")
    found = simplify(program)
    assert found.program == program, "nothing says that it was simplified"
    assert (found.terms_after, found.terms_lower_bound, found.symmetry) == (108, 0, None)
    assert len(found.notes) == 2


def test_box_actions_keep_success_and_steps_within_the_tolerance():
    program = load_pretrained("PandaReach-v0")
    found = simplify(program, variations=[{"n_targets": 1}, {"n_targets": 3}], episodes=6)
    assert found.terms_after <= 8
    assert found.symmetry == "mirror"
    assert [point.terms for point in found.curve] == sorted(point.terms for point in found.curve)
    both = [evaluate_program(one, variations=[{"n_targets": 2}], n_episodes=5)[0] for one in (program, found.program)]
    assert both[1].success_rate == 1
    assert both[1].steps_mean <= 1.3 * both[0].steps_mean


def test_fewest_terms_are_found_with_their_bound():
    # x > 0 and y > 0 have to be told from a third number that says both, and noise.
    rng = np.random.default_rng(0)
    both = rng.normal(size=(200, 1))
    rows = np.hstack([both + 1 + np.abs(both), rng.normal(size=(200, 3))])
    solution = fewest_terms(rows, 10)
    assert (solution.n_terms, solution.lower_bound) == (1, 1)
    assert solution.weights[0] == 1
    assert fewest_terms(np.array([[1.0, 0.0], [-1.0, 0.0]]), 5) is None


def right_hand(noise, seed=0):
    """The right-hand rule of HikingEgo, tied over the compass, with some noise in every weight."""
    program, rng = load_pretrained("HikingEgo-v0"), np.random.default_rng(seed)
    terms = terms_of(program, 4, DOMAINS["HikingEgo-v0"].symmetries)
    matrix = noise * np.einsum("k,koi->oi", rng.normal(size=len(terms)), np.stack([term.weights for term in terms]))
    names = program.input_names
    ahead = [names.index(f"window[{cell}]") for cell in ("-1,+0", "+0,+1", "+1,+0", "+0,-1")]
    previous = [names.index(f"previous {name}") for name in ("north", "east", "south", "west")]
    for direction in range(4):
        matrix[direction, ahead[direction]] += 8
        for turn, weight in ((-1, 4), (0, 2), (1, 1), (2, -2)):  # right turn, straight on, left turn, back
            matrix[direction, previous[(direction + turn) % 4]] += weight
    controller = Controller(tuple(map(tuple, matrix[:, :-1].tolist())), tuple(matrix[:, -1].tolist()))
    return dataclasses.replace(program, body=controller)


def test_outcome_finds_the_rule_in_what_was_learnt_with_noise():
    variations = [{"n_stars": n_stars, "layout": "practice"} for n_stars in (1, 2)]
    noisy = right_hand(0.2)
    found = simplify(noisy, "HikingEgo-v0", variations, equally_good="outcome", episodes=8)
    assert found.symmetry == "compass"
    assert found.equally_good == "outcome"
    assert 3 <= found.terms_after <= 8 < count_numbers(noisy) / 20
    assert found.program.metadata["simplified"]["equally_good"] == "outcome"
    others = [{"n_stars": 3, "layout": layout} for layout in ("valley", "comb", "fork")]
    before, after = (
        np.mean(
            [row.success_rate for row in evaluate_program(program, "HikingEgo-v0", [*others, *others], n_episodes=4)]
        )
        for program in (noisy, found.program)
    )
    assert after == 1 >= before


def test_number_of_terms_can_be_asked_for_where_success_and_steps_are_kept():
    found = simplify(load_pretrained("Hanoi-v0"), equally_good="outcome", episodes=5)
    assert found.terms_after == 4
    assert found.symmetry == "pegs"
    assert [point.terms for point in found.curve] == sorted(point.terms for point in found.curve)
    three = simplify(load_pretrained("Hanoi-v0"), equally_good="outcome", episodes=5, n_terms=3)
    assert three.terms_after == 3
    assert min(point.success_rate for point in three.curve if point.terms == 3) < 1


def test_where_few_terms_do_not_do_the_numbers_that_matter_least_are_left_out(monkeypatch):
    import sb3_progpolicy.analysis.prune as module

    monkeypatch.setattr(module, "_by_path", lambda *arguments: (None, []))
    original = load_pretrained("Hanoi-v0")
    found = simplify(original, equally_good="outcome", episodes=5)
    assert (found.symmetry, found.notes[0][:30]) == ("pegs", "the numbers that matter least ")
    assert count_numbers(found.program) < 108 / 2
    for row in evaluate_program(found.program, "Hanoi-v0", [{"n_discs": n_discs} for n_discs in (1, 2, 3, 4)]):
        assert row.ratio == 1
    matrix = np.array(found.program.controllers[0].weights)
    assert ((matrix == 0) | (np.sign(matrix) == np.sign(original.controllers[0].weights))).all()


def test_all_numbers_make_the_original_and_ties_are_kept():
    noisy, rng = right_hand(0.2), np.random.default_rng(0)
    inputs = np.column_stack([rng.normal(size=(200, noisy.n_inputs)), np.ones(200)])
    states, symmetries = States(inputs, np.zeros(200, dtype=int)), DOMAINS["HikingEgo-v0"].symmetries
    thinner = Thinner(noisy, states, symmetries)
    assert thinner.tied
    assert thinner.make(len(thinner.pieces)) == noisy
    assert [piece.share for piece in thinner.pieces] == sorted((p.share for p in thinner.pieces), reverse=True)
    few = np.column_stack([(c := thinner.make(5).controllers[0]).weights, c.bias])
    np.testing.assert_allclose(symmetric_part(noisy, few, symmetries), few, atol=1e-12)
    assert np.count_nonzero(few[:, :-1]) == 5 * 4
    untied = dataclasses.replace(noisy, body=Controller(noisy.body.weights, (1.0, 0.0, 0.0, 0.0)))
    assert not Thinner(untied, states, symmetries).tied


@pytest.mark.parametrize("cell", ["affine", "min", "gru"])
def test_a_condition_that_no_symmetry_ties_unties_the_program(cell):
    original, symmetries = right_hand(0.2), DOMAINS["HikingEgo-v0"].symmetries
    n_inputs = original.n_inputs
    states = States(np.ones((2, n_inputs + 1)), np.array([0, 1]))

    def thinner(weights):
        condition = {
            "affine": Condition("affine", (), (), (), (), weights, 0.1),
            "min": Condition("min", (weights,), (), (0.1,), (), (), 0.0),
            "gru": Condition("gru", (weights,) * 3, ((0.0,),) * 3, (0.0,) * 3, (0.0,) * 3, (1.0,), 0.1),
        }[cell]
        body = IfThenElse(condition, original.body, original.body)
        return Thinner(dataclasses.replace(original, body=body), states, symmetries)

    assert thinner((0.0,) * n_inputs).tied
    assert not thinner((1.0,) + (0.0,) * (n_inputs - 1)).tied


def test_conditions_are_thinned_and_branches_that_never_act_go():
    original = load_pretrained("Hiking-v0")
    states, _ = visited(original, "Hiking-v0", [{"n_stars": 1}] * 4, 5, seed=0)
    thinner = Thinner(original, states, ())
    some = thinner.make(100)
    assert len(some.controllers) == len(set(states.branches.tolist())) <= len(original.controllers)
    assert count_numbers(some) <= 100 + len(some.conditions) + 4 * len(some.controllers)
    kept = sum(piece.of_condition for piece in thinner.pieces[:100])
    assert sum(np.count_nonzero(condition.readout) for condition in some.conditions) == kept


def test_continuous_actions_have_no_equally_good_ones():
    with pytest.raises(ValueError, match="equally_good='planner' is not accepted for Box actions"):
        simplify(load_pretrained("PandaReach-v0"), equally_good="planner")


@pytest.mark.parametrize("analyse", [simplify, verify])
def test_program_of_a_wrapped_environment_is_refused(analyse):
    program = load_pretrained("Hanoi-v0")
    wrapped = dataclasses.replace(program, metadata={**program.metadata, "wrappers": ["VecFrameStack"]})
    with pytest.raises(ValueError, match="VecFrameStack"):
        analyse(wrapped)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"equally_good": "teacher"}, "equally_good.*'teacher'.*program, planner, outcome"),
    ({"equally_good": "outcome", "finetune": 100}, "finetune=100 is not accepted for Discrete actions"),
    ({"equally_good": "outcome", "n_terms": 39, "episodes": 2}, "n_terms=39 is not accepted; there are programs of"),
    ({"n_terms": 3}, "n_terms=3 is not accepted for Discrete"),
    ({"env_id": "Hanoi-v9"}, "Hanoi-v9"),
    ({"env_id": "Stacking-v0"}, "reads 9 numbers.*has 35"),
])  # fmt: skip
def test_arguments_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        simplify(load_pretrained("Hanoi-v0"), **arguments)


def test_command_writes_the_program_and_says_what_it_costs(tmp_path, capsys):
    small = tmp_path / "small.json"
    assert run(["simplify", "Hanoi-v0", "-o", str(small), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["terms_before"], found["terms_after"], found["terms_lower_bound"]) == (108, 4, 4)
    assert found["evaluation"][-1]["steps_mean_after"] == 255
    assert run(["simplify", str(small)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "24 numbers before, 4 terms now, one rule for all pegs; no program of this form has fewer" in out
    assert run(["simplify", "Hanoi-v0", "-o", str(tmp_path / "small.txt")]) == 2
    assert ".json" in capsys.readouterr().err


def test_curve_is_drawn_and_another_point_of_it_can_be_taken(tmp_path, monkeypatch, capsys):
    import sb3_progpolicy.analysis.simplify as module
    from sb3_progpolicy.analysis.prune import Point, Pruned

    program = load_pretrained("PandaReach-v0")
    curve = tuple(Point(terms, program, terms / 3, 30.0 - terms) for terms in (1, 2, 3))
    asked = []

    def prune(*arguments, n_terms, **options):
        asked.append(n_terms)
        return Pruned(curve[(n_terms or 3) - 1], curve, 100, 9, True, ())

    monkeypatch.setattr(module, "prune", prune)
    monkeypatch.setattr("sb3_progpolicy.cli.simplify._compared", lambda *arguments: [])
    for name in ("curve.csv", "curve.png"):
        arguments = ["simplify", "PandaReach-v0", "--curve", str(tmp_path / name), "--terms", "2", "--json"]
        assert run(arguments) == 0
    assert json.loads(capsys.readouterr().out.partition("}\n{")[0] + "}")["terms_after"] == 2
    assert asked == [2, 2]
    lines = (tmp_path / "curve.csv").read_text().splitlines()
    assert lines[0] == "terms,success_rate,steps_mean"
    assert lines[3] == "3,1.0,27.0"
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert run(["simplify", "Hanoi-v0", "--curve", str(tmp_path / "x.csv")]) == 2
    assert "is for continuous actions" in capsys.readouterr().err
    assert run(["simplify", "Hanoi-v0", "--curve", str(tmp_path / "x.pdf")]) == 2
