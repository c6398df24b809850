import io
import re
from dataclasses import replace

import matplotlib
import pytest
from hypothesis import given, settings

from sb3_progpolicy import load_pretrained
from sb3_progpolicy.programs import (
    Condition,
    Controller,
    export_c,
    export_graphviz,
    export_latex,
    export_python,
    export_text,
    plot_program,
)
from tests.programs.samples import program_by_hand, with_hostile_names
from tests.programs.strategies import CELLS, build_program, hanoi_program, programs

matplotlib.use("Agg")


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
