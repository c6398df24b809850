import ast
import io
import re
import subprocess
import sys
import textwrap
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_progpolicy import load_pretrained
from sb3_progpolicy.programs import (
    ActionSpec,
    Condition,
    Controller,
    IfThenElse,
    Program,
    ProgramRunner,
    export_c,
    export_graphviz,
    export_latex,
    export_python,
    export_text,
    join_inputs,
    plot_program,
)
from tests.programs.strategies import CELLS, build_program, hanoi_program, programs, random_actions, seeds, sparse

matplotlib.use("Agg")

HOSTILE_NAMES = (
    'a"b', "a'b", "back\\slash", '"""', "#", "$x$", "{", "}%", "~^_&", "é→", "import os", "class", "h1_1", "b1", "self",
    "scores", "p_0", "B1 [label=x]; }",
)  # fmt: skip


def with_hostile_names(program):
    inputs = (HOSTILE_NAMES * 3)[: program.n_inputs]
    outputs = (HOSTILE_NAMES[::-1] * 3)[: program.action.n_outputs]
    return replace(program, input_names=inputs, output_names=outputs)


def load_policy(source):
    namespace = {"__name__": "exported"}
    exec(compile(source, "exported.py", "exec"), namespace)
    return namespace["ProgramPolicy"]()


# Python


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


def program_by_hand(weight=-1.0):
    """Three moves of a cart: away from the left wall, else by the angle, never right after moving left."""
    nothing = (0.0,) * 9
    near = Condition("affine", (), (), (), (), (-2.0, *(0.0,) * 8), 1.0)
    lean = (0.0, weight, 0.0, 0.0, -5.0, 0.0, 0.0, 0.0, 0.0)
    body = IfThenElse(
        near,
        Controller((nothing,) * 3, (0.0, 0.0, 1.0)),
        Controller((lean, nothing, (0.0, 3.0, *(0.0,) * 7)), (0.0, 2.0, -1.0)),
    )
    moves = ("left", "stay", "right")
    names = ("position", "angle[0]", "wind", "light", *(f"previous {move}" for move in moves))
    names = (*names, "previous reward", "previous done")
    return Program(body, 4, ActionSpec("discrete", (3,)), True, names, moves, metadata={"env": "Cart-v0"})


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


# text


def test_text_of_a_small_program_reads_like_this():
    program = build_program(0, [], "discrete", False, n_observations=3)
    controller = Controller(((0.001, -2.5, 1.0), (0.0, 0.0, 0.0)), (0.5, -1.0))
    program = replace(
        program,
        body=controller,
        action=replace(program.action, sizes=(2,)),
        input_names=("angle", "speed", "cart position"),
        output_names=("left", "stay"),
        metadata={"env": "Cart-v0"},
    )
    assert export_text(program) == (
        "Program for Cart-v0: 0 conditions, 1 controller.\n"
        "Every step it reads 3 numbers: 3 observed.\n"
        "Each line gives the score of one action; the action with the highest score is taken.\n"
        "\n"
        "always:\n"
        "    left = 0.50 - 2.50*speed + [cart position] + (1 smaller term)\n"
        "    stay = -1\n"
    )
    assert str(program) == export_text(program)


def test_whole_numbers_are_printed_without_a_point():
    assert export_text(program_by_hand()).partition("\n\n")[2] == (
        "if B1 = 1 - 2*position >= 0:\n"
        "    left  = 0\n"
        "    stay  = 0\n"
        "    right = 1\n"
        "else:\n"
        "    left  = -5*[previous left] - angle[0]\n"
        "    stay  = 2\n"
        "    right = -1 + 3*angle[0]\n"
    )
    assert "left = 0  -5 previous left  -angle[0]\\l" in export_graphviz(program_by_hand())
    assert "0 & -1 & 0 & 0 & -5 & 0" in export_latex(program_by_hand())


def test_every_print_counts_what_it_leaves_out_or_shows_that_it_is_there():
    program = program_by_hand(-0.001)
    assert "left  = -5*[previous left] + (1 smaller term)" in export_text(program)
    assert "left = 0  -5 previous left  (1 smaller term)" in export_graphviz(program)
    assert "0 & 0.00 & 0 & 0 & -5" in export_latex(program)
    axes = plot_program(program)
    assert "… 1" in [text.get_text() for text in axes.texts]
    matplotlib.pyplot.close(axes.figure)
    assert "smaller" not in export_text(program, decimals=3)


def test_numbers_of_a_box_action_share_lines_where_they_fit():
    program = load_pretrained("PandaPush-v0")
    text = export_text(program, max_terms=None)
    lines = text.splitlines()
    assert max(map(len, lines)) <= 100
    assert sum(map(bool, lines)) < 40
    outputs = [part for line in lines if line.startswith("    ") for part in line.strip().split(";  ")]
    assert len([part for part in outputs if " = " in part]) == 4 * len(program.controllers)


def test_condition_that_does_not_fit_into_its_line_stands_below():
    program = replace(program_by_hand(), input_names=("an angle with a long name" * 5, *"abcdefgh"))
    program = replace(
        program,
        body=replace(program.body, condition=replace(program.body.condition, readout=(1.0,) + (0.0,) * 8)),
    )
    assert "if B1 >= 0:" in export_text(program)
    assert "\n\nB1 = 1" in export_text(program)


def test_name_that_is_a_number_is_not_read_as_one():
    program = replace(program_by_hand(), input_names=("1", "7", *"abcdefg"))
    assert "B1 = 1 - 2*[1]" in export_text(program)
    assert " - [7]\n" in export_text(program)


def test_text_shows_structure_and_memory():
    text = export_text(hanoi_program())
    headings = re.findall(r"^(\S.*:)$", text, flags=re.MULTILINE)
    assert headings == ["if B1 >= 0:", "else if B2 >= 0:", "else:"]
    assert len(re.findall(r"^ {4}move \d->\d = ", text, flags=re.MULTILINE)) == 18
    assert text.count("its memory: 3 GRU units") == 2
    assert max(map(len, text.splitlines())) <= 110


def test_text_options_show_more_or_fewer_terms_and_digits():
    program = hanoi_program()
    assert "smaller term" in export_text(program)
    assert "smaller term" not in export_text(program, decimals=17, max_terms=None)
    assert len(export_text(program, max_terms=1)) < len(export_text(program)) / 2
    assert repr(round(program.controllers[0].bias[0], 4)) in export_text(program, decimals=4)


@pytest.mark.parametrize("cell", CELLS)
def test_text_gives_every_number_of_a_condition_when_asked(cell):
    program = build_program(1, [cell], "discrete", False)
    test = program.conditions[0]
    text = export_text(program, decimals=3, max_terms=None).replace(" ", "").replace("\n", "")
    weights = [weight for row in (*test.weight_ih, *test.weight_hh, test.readout) for weight in row]
    for weight in weights:
        if weight == int(weight):
            assert abs(weight) <= 1 or f"{abs(int(weight))}*" in text
        elif round(weight, 3):
            assert f"{abs(weight):.3f}*" in text


# every format


@given(program=programs)
@settings(max_examples=60, deadline=None)
def test_every_program_prints_in_every_text_format(program):
    program = with_hostile_names(program)
    assert export_text(program).endswith("\n")
    check_dot_grammar(export_graphviz(program), len(program.conditions))
    check_latex_pairs(export_latex(program))


def check_dot_grammar(source, n_conditions):
    """Tokens by the DOT grammar: a graph of node and edge statements, nothing left over."""
    token = re.compile(r'\s*("(?:[^"\\]|\\.)*"|->|[\w.]+|[\[\]{}=;,])')
    position, tokens = 0, []
    while match := token.match(source, position):
        tokens.append(match[1])
        position = match.end()
    assert source[position:].strip() == ""
    plain = [text if text[0] != '"' else '""' for text in tokens]
    assert plain[:3] == ["digraph", "Program", "{"]
    assert plain[-1] == "}"
    assert plain.count("{") == plain.count("}") == 1
    assert plain.count("->") == 2 * n_conditions
    body = " ".join(plain[3:-1])
    attributes = r'\w+ = (""|\w+)'
    statement = rf"{attributes} ;|\w+( -> \w+)? \[ {attributes}( , {attributes})* \] ;"
    assert re.fullmatch(rf"(({statement}) ?)*", body)
    assert len(re.findall(r"[BC]\d+ \[", body)) - 2 * n_conditions == 2 * n_conditions + 1


def check_latex_pairs(source):
    plain = re.sub(r"\\\\", " ", source)
    plain = re.sub(r"\\[{}#$%&_]", "", plain)
    assert plain.count("{") == plain.count("}")
    assert not re.search(r"[#$%~]", plain)
    assert source.count(r"\left(") == source.count(r"\right)")
    assert source.count(r"\[") == source.count(r"\]")
    open_environments = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", source):
        if kind == "begin":
            open_environments.append(name)
        else:
            assert open_environments.pop() == name
    assert open_environments == []


def test_graphviz_names_conditions_and_controllers():
    source = export_graphviz(hanoi_program())
    assert [line.split()[:3] for line in source.splitlines() if "->" in line.split("[")[0]] == [
        ["B1", "->", "C1"],
        ["B1", "->", "B2"],
        ["B2", "->", "C2"],
        ["B2", "->", "C3"],
    ]
    assert "listens most to" in source


def test_latex_gives_every_matrix():
    program = hanoi_program()
    source = export_latex(program, decimals=3)
    for controller in program.controllers:
        assert " & ".join(str(int(w)) if w == int(w) else f"{w:.3f}" for w in controller.weights[0]) in source
    assert source.count(r"\otimes") == 0
    assert r"\text{move 0-\textgreater{}1}" in source


@pytest.mark.parametrize("export", [export_c, export_graphviz, export_latex, export_python])
def test_out_file_may_be_a_path_or_an_open_file(export, tmp_path):
    program, buffer, path = hanoi_program(), io.StringIO(), tmp_path / "out"
    assert export(program, buffer) is None
    assert export(program, out_file=path) is None
    assert buffer.getvalue() == path.read_text(encoding="utf-8") == export(program)


@pytest.mark.parametrize("export", [export_c, export_text, export_graphviz, export_latex, export_python, plot_program])
def test_malformed_program_is_refused(export):
    broken = replace(hanoi_program(), output_names=("a\nimport os",) * 6)
    with pytest.raises(ValueError, match="output_names"):
        export(broken)


@pytest.mark.parametrize("kind", ["discrete", "box", "multi_discrete", "multi_binary"])
@pytest.mark.parametrize("n_conditions", [0, 1, 4])
def test_plot_keeps_every_text_inside_the_picture_and_apart(kind, n_conditions):
    program = with_hostile_names(build_program(1, list(CELLS)[:n_conditions], kind, True))
    axes = plot_program(program)
    figure = axes.figure
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in axes.texts if text.get_text()]
    assert len(boxes) > n_conditions
    for box in boxes:
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1
    for index, box in enumerate(boxes):
        assert not any(overlap(box, other) for other in boxes[index + 1 :])
    matplotlib.pyplot.close(figure)


def overlap(one, other):
    # Line boxes include room for accents, so neighbours may touch by a few pixels.
    across = min(one.x1, other.x1) - max(one.x0, other.x0)
    down = min(one.y1, other.y1) - max(one.y0, other.y0)
    return across > 2 and down > 6


def test_plot_draws_into_given_axes():
    figure, axes = matplotlib.pyplot.subplots(figsize=(4, 3))
    assert plot_program(hanoi_program(), ax=axes) is axes
    figure.canvas.draw()
    texts = [text.get_text() for text in axes.texts]
    assert "Program for Hanoi-v0" in texts
    assert "if B1 ≥ 0" in texts
    assert all(text.get_window_extent().x1 <= figure.bbox.x1 for text in axes.texts)
    matplotlib.pyplot.close(figure)


def test_importance_of_an_input_is_what_reaches_the_condition():
    from sb3_progpolicy.programs.export.visitor import input_importance

    test = Condition("rnn", ((1.0, -2.0), (4.0, 0.0)), ((0.0, 0.0),) * 2, (0.0,) * 2, (0.0,) * 2, (3.0, 0.5), 0.0)
    assert input_importance(test) == (1.0 * 3 + 4.0 * 0.5, 2.0 * 3)
