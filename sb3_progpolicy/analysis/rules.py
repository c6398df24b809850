"""The conditions and controllers of a program, each with the fewest whole numbers that make the same decisions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs import Domain
from progpolicy_envs.symmetry import Symmetry
from sb3_progpolicy.analysis.integer import Solution, fewest_terms
from sb3_progpolicy.analysis.situations import Situations
from sb3_progpolicy.analysis.switches import Switched
from sb3_progpolicy.analysis.terms import Floats, Term, terms_of
from sb3_progpolicy.programs.syntax import Condition, Controller, Expression, IfThenElse, ProgramData


def count_numbers(program: ProgramData) -> int:
    """Return how many numbers of a program are not zero."""
    return sum(map(count_of, program.conditions)) + sum(map(count_of, program.controllers))


def count_of(node: Condition | Controller) -> int:
    """Return how many numbers of a part are not zero."""
    numbers = [value for value in vars(node).values() if not isinstance(value, str)]
    return sum(int(np.count_nonzero(np.array(value))) for value in numbers)


class Rules:
    """The conditions and controllers of a program, each made small.

    :param program: the original
    :param situations: that constrain them
    :param domain: whose symmetries and grids they may use
    :param tie: whether to tie weights
    :param time_limit: seconds for each
    :param max_weight: largest size of a weight
    :param switched: what is known of the switches among its conditions
    """

    def __init__(
        self,
        program: ProgramData,
        situations: Situations,
        domain: Domain,
        tie: bool,
        time_limit: float,
        max_weight: int,
        switched: Switched,
    ) -> None:
        self.original, self.situations, self.domain = program, situations, domain
        self.time_limit, self.max_weight = time_limit, max_weight
        self.switched = switched
        self.notes: list[str] = []
        self.n_terms, self.lower_bound = 0, 0
        self.symmetry: str | None = None
        self.ties: list[bool] = []
        self.tie = tie and bool(domain.symmetries)

    def program(self) -> ProgramData:
        """Return the program of the small rules."""
        original = self.original
        reached = sorted(set(self.situations.branches.tolist()))
        controllers = {index: self._controller(index) for index in reached}
        body: Expression = controllers[reached[-1]]
        for index in reversed(reached[:-1]):
            body = IfThenElse(self._condition(index), controllers[index], body)
        self.symmetry = self.domain.symmetries[0].name if self.ties and all(self.ties) else None
        return dataclasses.replace(original, body=body)

    def _controller(self, index: int) -> Controller:
        original = self.original.controllers[index]
        here = self.situations.branches == index
        inputs, allowed = self.situations.inputs[here], self.situations.allowed[here]
        undecided = ~allowed.any(axis=1)
        if undecided.any():
            self.notes.append(f"{int(undecided.sum())} inputs belong to states in which no one action is good")

        def rows(terms: Sequence[Term]) -> Floats:
            return _preferences(terms, inputs[~undecided], allowed[~undecided])

        solution, terms, tied = self._solve(rows, self.original.action.n_outputs, f"controller {index + 1}")
        self.ties.append(tied)
        if solution is None:
            self.n_terms += count_of(original)
            return original
        matrix = _summed(solution, terms)
        return Controller(tuple(map(tuple, matrix[:, :-1].tolist())), tuple(matrix[:, -1].tolist()))

    def _condition(self, index: int) -> Condition:
        original = self.original.conditions[index]
        if original.cell != "affine":
            self.n_terms += self.switched.terms.get(index, count_of(original))
            self.lower_bound += self.switched.bounds.get(index, 0)
            if index not in self.switched.terms:
                what = "has a memory" if original.remembers else "is the least of several sums"
                self.notes.append(f"condition {index + 1} {what} and stays as it is")
                self.ties.append(False)
            return original
        reaching = self.situations.branches >= index
        inputs, true = self.situations.inputs[reaching], self.situations.branches[reaching] == index

        def rows(terms: Sequence[Term]) -> Floats:
            values = _with_constant(inputs) @ np.concatenate([term.weights for term in terms]).T
            return np.where(true, 1, -1)[:, None] * values

        solution, terms, tied = self._solve(rows, 1, f"condition {index + 1}")
        self.ties.append(tied)
        if solution is None:
            self.n_terms += count_of(original)
            return original
        (weights,) = _summed(solution, terms)
        return dataclasses.replace(original, readout=tuple(weights[:-1].tolist()), readout_bias=float(weights[-1]))

    def _solve(self, rows: Any, n_outputs: int, name: str) -> tuple[Solution | None, list[Term], bool]:
        attempts: list[tuple[bool, Sequence[Symmetry]]] = [(True, self.domain.symmetries)] if self.tie else []
        for tied, symmetries in [*attempts, (False, ())]:
            for grids in [self.domain.grids, ()] if self.domain.grids else [()]:
                terms = terms_of(self.original, n_outputs, symmetries, grids)
                solution = fewest_terms(rows(terms), self.time_limit, max_weight=self.max_weight)
                if solution is not None:
                    self.n_terms += solution.n_terms
                    self.lower_bound += solution.lower_bound
                    return solution, terms, tied
            self.notes.append(
                f"{name}: no {'tied ' if tied else ''}rule of whole numbers up to {self.max_weight} was found that "
                "makes the same decisions"
            )
        return None, [], False


def _with_constant(inputs: Floats) -> Floats:
    return np.column_stack([inputs, np.ones(len(inputs))])


def _preferences(terms: Sequence[Term], inputs: Floats, allowed: NDArray[np.bool_]) -> Floats:
    """Return the rows of what has to be positive: an allowed action's score less another one's."""
    scores = np.einsum("koi,ni->nok", np.stack([term.weights for term in terms]), _with_constant(inputs))
    rows, good, bad = np.nonzero(allowed[:, :, None] & ~allowed[:, None, :])
    return np.asarray(scores[rows, good] - scores[rows, bad])


def _summed(solution: Solution, terms: Sequence[Term]) -> Floats:
    matrix = np.einsum("k,koi->oi", solution.weights, np.stack([term.weights for term in terms]))
    return np.asarray(matrix + 0.0)  # no negative zeros
