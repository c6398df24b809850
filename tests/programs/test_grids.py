"""Weights on a grid that are a function of row and column are printed as that function."""

import dataclasses

import numpy as np
import pytest

from sb3_progpolicy.programs import ActionSpec, Controller, Program, export_text

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


def test_other_weights_are_printed_one_by_one():
    assert "table*(" not in export_text(program([[1, 2, 3], [1, 2, 4]]))
    assert "4*table[1,2]" in line(program([[1, 2, 3], [1, 2, 4]]))
    assert "table*(" not in export_text(program([[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]))


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
