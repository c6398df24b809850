"""Programs made to break out of an exported file, and programs as large as they may be."""

import importlib
import re
import shutil
import subprocess
import sys
import tokenize
from dataclasses import replace
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest

from sb3_progpolicy.programs import (
    ActionSpec,
    Condition,
    Controller,
    IfThenElse,
    Program,
    export_graphviz,
    export_latex,
    export_python,
    export_text,
    plot_program,
    save_program,
)
from sb3_progpolicy.programs.validation import (
    MAX_CONDITIONS,
    MAX_INPUTS,
    MAX_NAME_LENGTH,
    MAX_NUMBERS,
    MAX_OUTPUTS,
    check_program,
)
from tests.programs.formats import check_python, plain_tree
from tests.programs.hostile import PIECES, with_hostile_texts
from tests.programs.strategies import build_program, hanoi_program, small_program, sparse

matplotlib.use("Agg")


def with_all_pieces():
    """Four outputs over one input for each hostile piece that may be part of a name; every input is in one sum."""
    names = ["".join(filter(str.isprintable, piece)) for piece in PIECES]
    names = tuple(name for name in names if name.strip())
    program = build_program(0, ["gru", "affine"], "box", False, n_observations=len(names))
    weights = tuple(tuple(0.1 * (column % 4 == row) for column in range(len(names))) for row in range(4))
    controller = Controller(weights, (0.0,) * 4)
    body = controller
    for condition in program.conditions:
        body = IfThenElse(condition, controller, body)
    action = ActionSpec("box", (4,), (-1.0,) * 4, (1.0,) * 4)
    return replace(program, body=body, action=action, input_names=names, output_names=names[:4])


# Python


def test_no_text_of_a_program_adds_a_node_to_the_exported_python():
    rng = np.random.default_rng(0)
    for _ in range(200):
        program = small_program(rng)
        program = sparse(program, 0) if rng.random() < 0.5 else program
        expected = plain_tree(program)
        for _ in range(10):
            check_python(with_hostile_texts(program, rng), expected)


@pytest.mark.parametrize(
    ("title", "name"),
    [
        ("Hanoi-v0 coding:unicode_escape", r"prev\n        ran.append(1)\n#"),
        ("Hanoi-v0 coding:raw_unicode_escape", r"prev\u000a        ran.append(1)#"),
        ("Hanoi-v0 coding=utf-7", "prev+AAo-        ran.append(1)+AAo-#"),
        ("-*- coding: utf_16 -*-", "prev"),
    ],
)
def test_title_cannot_set_the_encoding_that_python_reads_the_file_in(title, name, tmp_path, monkeypatch):
    program = hanoi_program()
    program = replace(program, metadata={"env": title}, input_names=(name, *program.input_names[1:]))
    path = tmp_path / "exported_policy.py"
    export_python(program, path)
    with tokenize.open(path) as file:
        assert file.encoding == "utf-8"
        assert file.readline() == "# -*- coding: utf-8 -*-\n"
    monkeypatch.syspath_prepend(tmp_path)
    policy = importlib.import_module("exported_policy").ProgramPolicy()
    sys.modules.pop("exported_policy")
    policy.act.__globals__["ran"] = ran = []
    policy.act([0.0] * 9)
    assert ran == []
    assert policy.input_names == program.input_names


def test_sum_of_two_constants_that_overflows_stays_a_number():
    program = build_program(0, ["rnn"], "discrete", False, hidden_size=1)
    condition = replace(program.conditions[0], bias_ih=(1.7e308,), bias_hh=(1.7e308,))
    program = replace(program, body=replace(program.body, condition=condition), input_names=("inf", *"abcd"))
    check_python(program)
    assert "1e999" in export_python(program)


def test_names_of_numpy_are_written_as_plain_strings():
    program = hanoi_program()
    inputs, outputs = (tuple(np.array(names)) for names in (program.input_names, program.output_names))
    assert export_python(replace(program, input_names=inputs, output_names=outputs)) == export_python(program)


# Text, DOT, LaTeX, picture


def test_name_in_a_text_cannot_pass_for_another_term_or_another_output():
    program = build_program(0, [], "discrete", False, n_observations=2)
    controller, action = Controller(((1.0, 2.0),), (0.0,)), ActionSpec("discrete", (1,))
    names = {"input_names": ("a] - 5.00*[b", "rank [x]"), "output_names": ("left = 9.00",)}
    text = export_text(replace(program, body=controller, action=action, **names))
    assert text.splitlines()[-1] == "    [left = 9.00] = 2*[rank [x]] + 'a] - 5.00*[b'"


def test_hostile_latex_compiles_and_runs_nothing(tmp_path):
    if shutil.which("pdflatex") is None:
        pytest.skip("pdflatex is not installed")
    program = with_all_pieces()
    names = (r"\message{\number\numexpr40+2\relax is the answer}", *program.input_names[1:])
    body = export_latex(replace(program, input_names=names))
    head = "\\documentclass{article}\n\\usepackage{amsmath}\n\\begin{document}\n"
    (tmp_path / "program.tex").write_text(f"{head}{body}\\end{{document}}\n", encoding="utf-8")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-no-shell-escape", "program.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, errors="replace", timeout=300)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "42 is the answer" not in done.stdout
    assert (tmp_path / "program.pdf").stat().st_size > 0


def test_hostile_dot_is_rendered_with_every_name_as_it_is():
    if shutil.which("dot") is None:
        pytest.skip("Graphviz is not installed")
    program = with_all_pieces()
    source = export_graphviz(program, max_terms=None)
    done = subprocess.run(["dot", "-Tsvg"], input=source, capture_output=True, text=True, encoding="utf-8", timeout=300)
    assert done.returncode == 0, done.stderr
    texts = [node.text or "" for node in ElementTree.fromstring(done.stdout).iter("{http://www.w3.org/2000/svg}text")]
    shown = "\n".join(texts).replace("\N{NO-BREAK SPACE}", " ")
    for name in (*program.input_names, *program.output_names):
        assert name in shown
    assert len(re.findall(r"^B\d+ >= 0 \?$", shown, flags=re.MULTILINE)) == 2


def test_hostile_picture_is_drawn_by_matplotlib_alone_with_every_name_as_it_is(tmp_path):
    program = replace(hanoi_program(), metadata={"env": r"$\frac{$ \input{x}"})
    names = ("$x$", "$", r"\frac", r"a\$b$", r"$\undefined$", "^_{", *program.input_names[6:])
    program = replace(program, input_names=names, output_names=names[:6])
    with matplotlib.rc_context({"text.usetex": True}):
        axes = plot_program(program)
        axes.figure.savefig(tmp_path / "program.png", bbox_inches="tight")
        texts = [text for text in axes.texts if text.get_text()]
        matplotlib.pyplot.close(axes.figure)
    assert not any(text.get_usetex() or text.get_parse_math() for text in texts)
    shown = "\n".join(text.get_text() for text in texts)
    assert all(name in shown for name in names[:6])
    assert r"Program for $\frac{$ \input{x}" in shown


def test_picture_of_long_names_is_not_wider_than_one_of_forty_characters():
    program = hanoi_program()
    long, short = (
        plot_program(replace(program, output_names=(letter * n,) * 6)).figure for letter, n in (("a", 200), ("b", 40))
    )
    assert long.get_size_inches().tolist() == short.get_size_inches().tolist()
    matplotlib.pyplot.close(long)
    matplotlib.pyplot.close(short)


# Size


def largest(kind, sizes, n_observations, cells=(), hidden_size=0, interaction=False):
    """A program with equal names of the greatest length and shared rows, to be quick to make."""
    n_outputs = sum(sizes)
    n_inputs = n_observations + (n_outputs + 2) * interaction
    action = ActionSpec(kind, sizes, *((-1.0,) * n_outputs, (1.0,) * n_outputs) if kind == "box" else ())
    controller = Controller(((0.5,) * n_inputs,) * n_outputs, (0.5,) * n_outputs)
    n_rows, body = 3 * hidden_size, controller
    for cell in cells:
        recurrent = ((0.5,) * n_inputs,) * n_rows, ((0.5,) * hidden_size,) * n_rows, (0.5,) * n_rows, (0.5,) * n_rows
        condition = Condition(cell, *(recurrent if n_rows else ((),) * 4), (0.5,) * (hidden_size or n_inputs), 0.5)
        body = IfThenElse(condition, controller, body)
    name = "b" + "0" * (MAX_NAME_LENGTH - 2) + "x"
    return Program(body, n_observations, action, interaction, (name,) * n_inputs, (name,) * n_outputs)


LARGEST = {
    "inputs": largest("discrete", (7,), MAX_INPUTS - 9, interaction=True),
    "outputs": largest("box", (MAX_OUTPUTS,), MAX_NUMBERS // MAX_OUTPUTS - 1),
    "parts": largest("multi_discrete", (1,) * 490, 16, interaction=True),
    "conditions": largest("discrete", (6,), 380, ["gru"] * MAX_CONDITIONS, 1, interaction=True),
}
EXPORT_ALL = """
import sys, matplotlib
matplotlib.use("Agg")
from sb3_progpolicy.programs import *
from sb3_progpolicy.pages import export_html
program = load_program(sys.argv[1])
exports = (export_c, export_text, export_graphviz, export_latex, export_python, export_javascript, export_html)
for export in (*exports, plot_program):
    export(program)
"""


@pytest.mark.parametrize("shape", LARGEST)
def test_largest_programs_are_printed_in_every_format_in_seconds(shape, tmp_path):
    path = tmp_path / "program.json"
    save_program(LARGEST[shape], path)
    subprocess.run([sys.executable, "-c", EXPORT_ALL, path], check=True, timeout=300)


def test_sixteen_thousand_equal_names_become_as_many_variables():
    program = largest("box", (1,), 16_000)
    variables = re.findall(r"^ +# (\w+): b0", export_python(program), flags=re.MULTILINE)
    assert len(set(variables)) == 16_000
    assert variables[:2] == ["x_b" + "0" * 39, "x_b" + "0" * 39 + "_v2"]


@pytest.mark.parametrize(
    ("program", "fault"),
    [
        (largest("box", (1,), MAX_INPUTS + 1), "n_observations=32769"),
        (
            largest("box", (1,), MAX_INPUTS - 2, interaction=True),
            "32769 inputs given, 3 for the history",
        ),
        (largest("box", (MAX_OUTPUTS + 1,), 1), r"action.sizes=\(4097,\) is not accepted; they sum to at most 4096"),
        (largest("box", (MAX_OUTPUTS,), MAX_NUMBERS // MAX_OUTPUTS), "253952 weights and constants .* at most 250000"),
        (replace(hanoi_program(), input_names=("a" * 201,) * 17), "1 to 200 printable characters"),
        (replace(hanoi_program(), action=ActionSpec("discrete", (6,), start=2**53 + 1)), "action.start"),
    ],
)
def test_program_above_a_bound_is_refused(program, fault):
    with pytest.raises(ValueError, match=fault):
        check_program(program)
