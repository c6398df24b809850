"""Whole weights on a grid are printed as the function of row and column that they are, or as a table."""

import dataclasses
from importlib.resources import files

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
    export_text,
    plot_program,
)
from tests.programs.node import run_node

matplotlib.use("Agg")

NAMES = (*(f"table[{row},{column}]" for row in range(2) for column in range(3)), "other")
GRID = {"name": "table", "start": 0, "rows": 2, "columns": 3}


def program(grid_weights, other=0.0, bias=0.0, grids=(GRID,)):
    weights = (*np.ravel(grid_weights).astype(float).tolist(), other)
    return Program(
        Controller((weights, (0.0,) * 7), (bias, 0.0)), 7, ActionSpec("discrete", (2,)), False, NAMES, ("go", "stay"),
        metadata={"grids": list(grids)},
    )  # fmt: skip


def line(one):
    return next(row.strip() for row in export_text(one).splitlines() if row.strip().startswith("go"))


@pytest.mark.parametrize(("weights", "other", "bias", "printed"), [
    ([[4, 4, 4], [2, 2, 2]], 0, 0, "go   = table*(4 - 2*row)"),
    ([[0, 1, 2], [1, 2, 3]], -3, 0, "go   = table*(row + column) - 3*other"),
    ([[-1, -1, -1], [-1, -1, -1]], 1, 0, "go   = table*(-1) + other"),
    ([[0, -1, -2], [0, -1, -2]], 0, 5, "go   = table*(-column) + 5"),
    ([[5, 5, 5], [5, 5, 5]], 2, -4, "go   = table*(5) - 4 + 2*other"),
    ([[0, 0, 0], [0, 0, 0]], 2, 0, "go   = 2*other"),
])  # fmt: skip
def test_affine_functions(weights, other, bias, printed):
    assert line(program(weights, float(other), float(bias))) == printed


def test_what_the_function_means_is_said_below_it_and_only_there():
    text = export_text(program([[1, 2, 3], [1, 2, 3]]))
    assert "table*(...) is summed over all cells table[row,column]; rows and columns count from 0." in text
    assert "summed" not in export_text(program(np.zeros((2, 3)), 1.0))


OTHER = [[1, 2, 3], [1, 2, -40]]


def test_other_whole_numbers_are_printed_as_a_table():
    text = export_text(program(OTHER, -3.0, 1.5))
    assert line(program(OTHER, -3.0, 1.5)) == "go   = table*(T1) + 1.50 - 3*other"
    assert text.endswith(
        "table*(...) is summed over all cells table[row,column]; rows and columns count from 0.\n"
        "\n"
        "T1 =   1    2    3\n"
        "       1    2  -40\n"
    )


def test_equal_tables_have_one_name_and_all_are_printed_once():
    rows = (OTHER, [[0, 1, 2], [0, 1, 2]], OTHER, [[9, 1, 2], [3, 4, 5]])
    weights = tuple((*np.ravel(row).astype(float).tolist(), 0.0) for row in rows)
    one = dataclasses.replace(
        program(OTHER),
        body=Controller(weights, (0.0,) * 4), action=ActionSpec("discrete", (4,)), output_names=tuple("abcd"),
    )  # fmt: skip
    text = export_text(one)
    for shown in ("a = table*(T1)\n", "b = table*(column)\n", "c = table*(T1)\n", "d = table*(T2)\n"):
        assert shown in text
    assert text.count("T1 = ") == text.count("T2 = ") == 1


@pytest.mark.parametrize("weights", [
    [[1, 2, 3], [1, 2, 4.5]], [[0, 0, 0], [7, 0, -1]], [[1, 2, 3], [1, 2, 12345]], [[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]],
])  # fmt: skip
def test_few_or_fractional_or_large_numbers_are_printed_one_by_one(weights):
    text = export_text(program(weights))
    assert "table*(" not in text
    assert "T1" not in text
    assert "*table[1,2]" in text or "-table[1,2]" in text or " - table[1,2]" in text


def test_tables_of_conditions():
    weights = (*np.ravel(OTHER).astype(float).tolist(), 0.0)
    affine = Condition("affine", (), (), (), (), weights, 1.0)
    switch = Condition("switch", (weights, (0.0,) * 7), ((0.0,), (0.0,)), (0.0, 1.0), (0.0, 0.0), (1.0,), -0.5)
    least = Condition("min", (weights, (0.0,) * 7), (), (1.0, 2.0), (), (), 0.0)
    for condition, shown, name in (
        (affine, "B1 = table*(T1) + 1 >= 0:\n", "B_{1}"),
        (switch, "on when  table*(T1) >= 0\n", "B_{1,1}"),
        (least, "B1 = min(table*(T1) + 1, 2) >= 0:\n", "B_{1,1}"),
    ):
        one = program(np.zeros((2, 3)), 1.0)
        one = dataclasses.replace(one, body=IfThenElse(condition, one.body, one.body))
        assert shown in export_text(one)
        assert "T1 = " in export_text(one)
        assert "table*(T1)" in export_graphviz(one)
        assert rf"{name}, \text{{table}} = \left(" in export_latex(one)


def test_pictures_show_the_table_beside_its_sum():
    one = program(OTHER, -3.0)
    dot = export_graphviz(one, max_terms=1)
    space = "\N{NO-BREAK SPACE}"
    assert "go = 0  +table*(T1)  -3 other\\l" in dot
    assert f"T1{space}={space}{space}{space}1" in dot
    axes = plot_program(one, max_terms=1)
    texts = [text.get_text() for text in axes.texts]
    matplotlib.pyplot.close(axes.figure)
    assert "+table*(T1)" in texts
    assert f"       1    2  {chr(0x2212)}40" in texts


def test_latex_gives_the_table_in_its_shape():
    latex = export_latex(program(OTHER))
    assert "T_{1}, \\text{go}, \\text{table} = \\left(\\begin{array}{rrr} 1 & 2 & 3 \\\\\n  1 & 2 & -40" in latex
    assert "\\text{table} =" not in export_latex(program([[1, 2, 3], [1, 2, 3]])), "that is a function"


@pytest.mark.parametrize(("weights", "words", "table"), [
    ([[4, 4, 4], [2, 2, 2]], "4 \u2212 2\u00a0row", None),
    ([[0, -1, -2], [0, -1, -2]], "\u2212column", None),
    (OTHER, None, OTHER),
    ([[0, 0, 0], [7, 0, -1]], None, None),
    ([[0.5, 2, 3], [1, 2, 4]], None, None),
])  # fmt: skip
def test_page_finds_the_same(weights, words, table):
    sources = [files("sb3_progpolicy.pages") / "js" / f"{name}.js" for name in ("dom", "program")]
    script = "".join(source.read_text(encoding="utf-8") for source in sources)
    found = run_node(f"{script}; return onGrid(data.grid, data.weights);", {
        "grid": {**GRID, "stop": 6}, "weights": [*np.ravel(weights).tolist(), 3],
    })  # fmt: skip
    if words is None and table is None:
        assert found is None
    else:
        assert found == {"name": "table", **({"words": words} if words else {"table": table})}


@pytest.mark.parametrize("grids", [
    "table", [3], [{}], [{**GRID, "name": "a b"}], [{**GRID, "rows": 3}], [{**GRID, "start": -1}],
    [{**GRID, "rows": True}], [{**GRID, "more": 1}], [GRID, GRID], [{**GRID, "rows": 10**9}],
])  # fmt: skip
def test_metadata_of_strangers_cannot_break_the_print(grids):
    one = program([[1, 2, 3], [1, 2, 3]])
    one = dataclasses.replace(one, metadata={"grids": grids})
    assert export_text(one).startswith("Program")
    if grids != [GRID, GRID]:
        assert "table*(" not in export_text(one)
