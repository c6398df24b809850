"""A program without the numbers that matter least: the others stay as they were learnt."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_progpolicy.analysis.finetune import matrix_of, with_branches
from sb3_progpolicy.analysis.paths import States, rounded
from sb3_progpolicy.analysis.terms import Floats, symmetric_part, terms_of
from sb3_progpolicy.programs.syntax import Condition, ProgramData


@dataclass(frozen=True)
class Piece:
    """One number of a rule, with those that a symmetry ties to it.

    :param share: how much it moves the rule's outputs in the states that the rule decides, as a share of what makes a
        difference
    :param of_condition: whether the rule is a condition; else it is a controller
    :param index: of the rule
    :param weights: what the number adds, ``(n_outputs, n_inputs + 1)``
    :param mean: what it says on average, which the constant takes over when it goes, ``(n_outputs,)``
    """

    share: float
    of_condition: bool
    index: int
    weights: Floats
    mean: Floats


class Thinner:
    """Programs of the most important numbers of another one.

    Importance is how much a number moves the outputs of its rule in the states that the rule decides. What a number
    that goes has said on average is added to the constant. Branches that never act are dropped; constants stay, and so
    do conditions with a memory or of several sums.

    :param program: the original
    :param states: that it meets on its way
    :param symmetries: that tie its numbers, if they do
    """

    def __init__(self, program: ProgramData, states: States, symmetries: Sequence[Any]) -> None:
        self.program = program
        self.controllers = {int(branch): matrix_of(program.controllers[branch]) for branch in set(states.branches)}
        *others, _ = sorted(self.controllers)
        kept = {index: program.conditions[index] for index in others}
        self.conditions = {
            index: np.array([[*condition.readout, condition.readout_bias]])
            for index, condition in kept.items()
            if condition.cell == "affine"
        }
        rows = [row for condition in kept.values() for row in _rows(condition)]
        tied = all(
            np.allclose(matrix, symmetric_part(program, matrix, symmetries), atol=1e-6 * max(1.0, np.abs(matrix).max()))
            for matrix in (*self.controllers.values(), *rows)
        )
        #: Whether a number stands for all that a symmetry ties to it.
        self.tied = tied and bool(symmetries)
        symmetries = symmetries if tied else ()
        pieces: list[Piece] = []
        for index, matrix in self.conditions.items():
            pieces += self._pieces(True, index, matrix, states.inputs[states.branches >= index], symmetries)
        for index, matrix in self.controllers.items():
            pieces += self._pieces(False, index, matrix, states.inputs[states.branches == index], symmetries)
        #: Those that are not zero, the most important first.
        self.pieces = sorted(pieces, key=lambda piece: -piece.share)

    def _pieces(
        self, of_condition: bool, index: int, matrix: Floats, inputs: Floats, symmetries: Sequence[Any]
    ) -> list[Piece]:
        size = self._size(of_condition, inputs @ matrix.T)
        found = []
        for term in terms_of(self.program, len(matrix), symmetries):
            weights = np.where(term.weights != 0, matrix, 0.0)
            weights[:, -1] = 0.0  # constants stay
            if not weights.any():
                continue
            values = inputs @ weights.T
            mean = values.mean(axis=0)
            share = _root_mean_square(values - mean) / max(size, 1e-12)
            if symmetries:
                constants = np.column_stack([np.zeros_like(weights[:, :-1]), mean])
                mean = symmetric_part(self.program, constants, symmetries)[:, -1]
            found.append(Piece(share, of_condition, index, weights, mean))
        return found

    def _size(self, of_condition: bool, outputs: Floats) -> float:
        """Return by how much a rule's outputs have to be moved to make a difference."""
        if of_condition:
            return _root_mean_square(outputs)  # from the threshold
        if self.program.action.kind == "discrete":
            return _root_mean_square(outputs - outputs.mean(axis=1, keepdims=True))  # from each other
        half = (np.array(self.program.action.high) - np.array(self.program.action.low)) / 2
        return float(half.mean()) if np.isfinite(half).all() else _root_mean_square(outputs - outputs.mean(axis=0))

    def make(self, n_pieces: int, digits: int | None = None) -> ProgramData:
        """Return the program of the most important numbers.

        :param n_pieces: how many are kept
        :param digits: significant digits of what is left, constants too; ``None`` for all
        """
        conditions = {index: matrix.copy() for index, matrix in self.conditions.items()}
        controllers = {index: matrix.copy() for index, matrix in self.controllers.items()}
        for piece in self.pieces[n_pieces:]:
            matrix = (conditions if piece.of_condition else controllers)[piece.index]
            matrix[piece.weights != 0] = 0.0
            matrix[:, -1] += piece.mean
        if digits is not None:
            controllers = {index: rounded(matrix, digits) for index, matrix in controllers.items()}
            conditions = {index: rounded(matrix, digits) for index, matrix in conditions.items()}
        changed = {index: _with(self.program.conditions[index], matrix) for index, matrix in conditions.items()}
        return with_branches(self.program, controllers, changed)


def _rows(condition: Condition) -> list[Floats]:
    """Return each sum over X of a condition, ``(1, n_inputs + 1)``; no symmetry moves the constant, here 0."""
    return [np.array([[*weights, 0.0]]) for weights in condition.rows]


def _with(condition: Condition, matrix: Floats) -> Condition:
    (weights,) = matrix.tolist()
    return dataclasses.replace(condition, readout=tuple(weights[:-1]), readout_bias=weights[-1])


def _root_mean_square(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))
