"""The numbers that a simple program may use: one for each orbit of a symmetry, one for a function of row and column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.symmetry import Grid, Symmetry, group_of
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.symmetries import matrix_of, on_inputs

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Term:
    """What one number of a rule adds to a controller's or a condition's weights.

    :param weights: ``(n_outputs, n_inputs + 1)``, whole numbers; the last column is of the constant
    """

    weights: Floats


def terms_of(
    program: ProgramData, n_outputs: int, symmetries: Sequence[Symmetry] = (), grids: Sequence[Grid] = ()
) -> list[Term]:
    """Return the terms that a rule is made of.

    :param program: whose inputs it reads
    :param n_outputs: of the rule: those of a controller, or 1 for a condition, which no symmetry may change
    :param symmetries: generators of those under which the rule is to stay the same
    :param grids: blocks of inputs that count as functions of row and column
    """
    width = program.n_inputs + 1
    if not symmetries and not grids:
        return [Term(pattern.reshape(n_outputs, width)) for pattern in np.eye(n_outputs * width)]
    group = [(_on_inputs(program, one), _on_outputs(one, n_outputs)) for one in group_of(symmetries)]
    found: list[Term] = []
    span = np.zeros((0, n_outputs * width))
    on_grid = {grid.start + index for grid in grids for index in range(len(grid.rows))}
    for output in range(n_outputs):
        for single in [index for index in range(width) if index not in on_grid]:
            pattern = np.zeros((n_outputs, width))
            pattern[output, single] = 1
            span = _add(found, span, pattern, group)
        for grid in grids:
            for values in (np.ones(len(grid.rows)), np.array(grid.rows), np.array(grid.columns)):
                pattern = np.zeros((n_outputs, width))
                pattern[output, grid.start : grid.start + len(values)] = values
                span = _add(found, span, pattern, group)
    return found


def symmetric_part(program: ProgramData, matrix: Floats, symmetries: Sequence[Symmetry]) -> Floats:
    """Return the part of a controller's numbers that is the same from all sides: their mean over the group.

    :param program: whose inputs the controller reads
    :param matrix: weights and constant, ``(n_outputs, n_inputs + 1)``
    :param symmetries: generators of the group; none for the matrix as it is
    """
    if not symmetries:
        return matrix
    group = [(_on_inputs(program, one), _on_outputs(one, len(matrix))) for one in group_of(symmetries)]
    return np.asarray(np.mean([outputs @ matrix @ inputs.T for inputs, outputs in group], axis=0))


def _add(found: list[Term], span: Floats, pattern: Floats, group: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Add the symmetric part of a pattern, unless there is none or it follows from those found."""
    tied = pattern if not group else np.sum([outputs @ pattern @ inputs.T for inputs, outputs in group], axis=0)
    sizes = np.abs(tied[np.abs(tied) > 1e-9])
    if not len(sizes):
        return span
    tied = tied / sizes.min()  # of ones and, on a grid, of rows and columns
    if np.abs(tied - np.round(tied)).max() > 1e-6:
        tied = 2 * tied  # the middle of a grid lies between two cells
    extended = np.vstack([span, tied.reshape(1, -1)])
    if np.linalg.matrix_rank(extended) <= len(span):
        return span
    found.append(Term(np.round(tied)))
    return extended


def _on_inputs(program: ProgramData, symmetry: Symmetry) -> Floats:
    """Return the matrix of a symmetry on X and the constant."""
    matrix = np.eye(program.n_inputs + 1)
    matrix[:-1, :-1] = matrix_of(on_inputs(symmetry, program.n_inputs, program.action))
    return matrix


def _on_outputs(symmetry: Symmetry, n_outputs: int) -> Floats:
    return matrix_of(symmetry.action) if n_outputs == len(symmetry.action.source) else np.eye(n_outputs)
