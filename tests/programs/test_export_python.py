"""Programs as plain Python."""

import ast
import re
import subprocess
import sys
import textwrap
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_progpolicy.programs import (
    Condition,
    Controller,
    IfThenElse,
    Program,
    ProgramRunner,
    export_python,
    join_inputs,
)
from sb3_progpolicy.spaces import ActionSpec
from tests.programs.samples import program_by_hand, with_hostile_names
from tests.programs.strategies import CELLS, build_program, hanoi_program, programs, random_actions, seeds, sparse


def load_policy(source):
    namespace = {"__name__": "exported"}
    exec(compile(source, "exported.py", "exec"), namespace)
    return namespace["ProgramPolicy"]()


@given(program=programs, seed=seeds, few_terms=st.booleans())
@settings(max_examples=120, deadline=None)
def test_exported_python_takes_the_same_actions_as_the_runner(program, seed, few_terms):
    program = sparse(program, seed) if few_terms else program
    rng = np.random.default_rng(seed)
    policy, runner = load_policy(export_python(program)), ProgramRunner(program)
    given_action, reward, done = None, 0.0, False
    for step in range(150):
        if step == 100:
            policy.reset()
            runner.reset()
            given_action, reward, done = None, 0.0, False
        observation = rng.normal(size=program.n_observations)
        expected = runner.act(join_inputs(program, observation, given_action, reward, done))[0]
        action = policy.act(observation, None if given_action is None else given_action[0], reward, done)
        if program.action.kind == "box":
            assert all(type(number) is float for number in action)
            action = np.float32(action)
        np.testing.assert_array_equal(action, expected)
        given_action = random_actions(rng, program.action, 1)
        reward, done = float(rng.normal()), bool(rng.integers(2))


@pytest.mark.parametrize("cell", CELLS)
def test_exported_python_follows_a_long_game_fed_with_its_own_actions(cell):
    program = hanoi_program(seed=3, cell=cell)
    rng = np.random.default_rng(0)
    policy, runner = load_policy(export_python(program)), ProgramRunner(program)
    action, taken = None, set()
    for step in range(3_000):
        observation = rng.choice(np.float32([-1, 0, 0.5, 1]), size=9)
        expected = runner.act(join_inputs(program, observation, action, -0.01, step % 50 == 0))[0]
        action = policy.act(observation, action, -0.01, step % 50 == 0)
        assert action == expected
        taken.add(int(runner.branch[0]))
    assert len(taken) > 1


def test_exported_python_remembers_without_any_interaction_input():
    program = build_program(5, ["lstm"], "box", False)
    policy, observation = load_policy(export_python(program)), [1.0] * 5
    policy.act(observation)
    state = policy._h1
    policy.act(observation)
    assert policy._h1 != state
    policy.reset()
    assert policy._h1 == (0.0, 0.0)


@given(program=programs)
@settings(max_examples=40, deadline=None)
def test_exported_python_imports_the_standard_library_only(program):
    tree = ast.parse(export_python(with_hostile_names(program)), feature_version=(3, 8))
    imports = [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert all(isinstance(node, ast.ImportFrom) and node.module == "math" for node in imports)


def test_exported_python_runs_in_an_interpreter_that_has_no_packages(tmp_path):
    path = tmp_path / "policy.py"
    program = hanoi_program()
    assert export_python(program, path) is None
    code = f"import runpy; P = runpy.run_path({str(path)!r})['ProgramPolicy']; print(P().act([0.5] * 9))"
    result = subprocess.run([sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, check=True)
    assert int(result.stdout) == ProgramRunner(program).act(join_inputs(program, [0.5] * 9))[0]


@pytest.mark.parametrize("kind", ["discrete", "box", "multi_discrete", "multi_binary"])
def test_names_cannot_break_or_enter_the_source(kind):
    program = build_program(2, ["gru", "affine", "lstm", "rnn"], kind, True)
    plain, hostile = load_policy(export_python(program)), load_policy(export_python(with_hostile_names(program)))
    for step in range(20):
        observation = np.random.default_rng(step).normal(size=5)
        assert plain.act(observation) == hostile.act(observation)
    assert hostile.input_names == with_hostile_names(program).input_names


def test_exported_source_has_the_branches_and_names_of_the_program():
    source = export_python(hanoi_program())
    branches = re.findall(r"^ +(if b1 >= 0\.0:|elif b2 >= 0\.0:|else:)$", source, flags=re.MULTILINE)
    assert branches == ["if b1 >= 0.0:", "elif b2 >= 0.0:", "else:"]
    assert "# colour_0: colour[0]" in source
    assert "# previous move 0->1" in source


def test_python_of_a_program_with_few_terms_is_what_a_person_would_have_written():
    source = export_python(program_by_hand())
    body = source.partition("are accepted")[2].partition("\n")[2]
    assert textwrap.dedent(body) == (
        "position = float(observation[0])\n"
        "angle_0 = float(observation[1])  # angle[0]\n"
        "action = -1 if previous_action is None else int(previous_action)\n"
        "if action >= 3 or action < 0 and previous_action is not None:\n"
        '    raise ValueError("previous_action=%r is not accepted; 0 to 2 is" % (previous_action,))\n'
        "previous_left = action == 0  # previous left\n"
        "\n"
        "if 1 - 2 * position >= 0:\n"
        "    return 2  # right\n"
        "else:\n"
        "    # Controller 2\n"
        "    left = -angle_0 - 5 * previous_left\n"
        "    stay = 2\n"
        "    right = -1 + 3 * angle_0\n"
        "    scores = (left, stay, right)\n"
        "    return scores.index(max(scores))\n"
    )


def test_minus_in_the_name_of_an_input_is_part_of_its_variable():
    program = replace(program_by_hand(), input_names=("view[-1]", "view[1]", "0->1", *"abcdef"))
    source = export_python(program)
    assert "view_minus_1 = float(observation[0])" in source
    assert "view_1 = float(observation[1])" in source


def test_exported_sum_of_thousands_of_terms_still_compiles():
    n = 5000
    program = build_program(0, ["affine", "gru"], "box", False, n_observations=n, hidden_size=1)
    policy, observation = load_policy(export_python(program)), np.random.default_rng(0).normal(size=n)
    np.testing.assert_array_equal(np.float32(policy.act(observation)), ProgramRunner(program).act(observation[None])[0])


def test_exported_python_refuses_inputs_that_do_not_fit():
    policy = load_policy(export_python(hanoi_program()))
    with pytest.raises(ValueError, match="8 numbers; 9"):
        policy.act([0.0] * 8)
    for action in (6, -1):
        with pytest.raises(ValueError, match="previous_action"):
            policy.act([0.0] * 9, action, 0.0, False)


def test_rewards_and_actions_are_read_as_in_training():
    """0.7 and -0.01 are other numbers in ``float32``; a threshold at them tells the two apart."""
    spec = ActionSpec("box", (1,), low=(-1.0,), high=(1.0,))
    names = ("x", "[previous a]", "[reward]", "[done]"), ("a",)
    for weights, bias in (((0.0, 10.0, 0.0, 0.0), -7.0), ((0.0, 0.0, -1.0, 0.0), -0.01)):
        condition = Condition("affine", (), (), (), (), weights, bias)
        low, high = (Controller(((0.0,) * 4,), (value,)) for value in (-0.5, 0.7))
        program = Program(IfThenElse(condition, low, high), 1, spec, True, *names)
        policy, runner, action, taken = load_policy(export_python(program)), ProgramRunner(program), None, None
        for _ in range(4):
            action = policy.act([0.0], action, -0.01, False)
            taken = runner.act(join_inputs(program, [0.0], taken, -0.01, False))
            np.testing.assert_allclose([action, taken[0]], [[0.7], [0.7]], rtol=1e-6)
