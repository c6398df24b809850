"""Programs of few terms that act nearly as another one does: one for each number of terms, found term by term."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.analysis.finetune import matrix_of, with_branches
from sb3_progpolicy.analysis.terms import Floats, Term, terms_of
from sb3_progpolicy.programs.syntax import ProgramData

#: Terms of the largest program that is made.
MAX_TERMS = 40
_REFITS = 8
#: Weights of preferences are drawn to 0 by this much for each state: where states can be told apart, they would grow
#: without end.
_RIDGE = 1e-4
_NEWTON_STEPS = 20


@dataclass(frozen=True)
class States:
    """What a program did on its own way.

    :param inputs: X and the constant, ``(n, n_inputs + 1)``
    :param branches: index of the controller that acted, ``(n,)``
    """

    inputs: Floats
    branches: NDArray[np.int64]


def rounded(numbers: Floats, digits: int) -> Floats:
    """Return numbers with so many significant digits.

    :param numbers: of any shape
    :param digits: at least 1
    """
    return np.array([float(f"{number:.{digits - 1}e}") for number in numbers.ravel().tolist()]).reshape(numbers.shape)


class Pruner(ABC):
    """Programs of few terms that do nearly what the original does, one for each number of terms.

    Terms are added one by one, the one first that promises to bring the actions nearest to the original's; all weights
    are fitted anew each time.

    :param program: the original
    :param states: on which actions are compared
    :param symmetries: that tie the weights; none for free ones
    """

    def __init__(self, program: ProgramData, states: States, symmetries: Sequence[Any]) -> None:
        self.program = program
        #: The branches that act at all; the others are dropped.
        self.reached = sorted(set(states.branches.tolist()))
        each = terms_of(program, program.action.n_outputs, symmetries)
        self.terms: list[tuple[int, Term]] = [(branch, term) for branch in self.reached for term in each]
        #: What the original's controllers say, ``(n_states, n_outputs)``.
        self.outputs = np.zeros((len(states.inputs), program.action.n_outputs))
        for branch in self.reached:
            here = states.branches == branch
            self.outputs[here] = states.inputs[here] @ matrix_of(program.controllers[branch]).T
        self._rows = {branch: np.flatnonzero(states.branches == branch) for branch in self.reached}
        inputs = {branch: states.inputs[rows] for branch, rows in self._rows.items()}
        #: What each term says in the states of its branch; elsewhere it says nothing.
        self._said = [inputs[branch] @ term.weights.T for branch, term in self.terms]

    def _feature(self, index: int) -> Floats:
        """Return what a term says, ``(n_states, n_outputs)``."""
        values = np.zeros_like(self.outputs)
        values[self._rows[self.terms[index][0]]] = self._said[index]
        return values

    def path(self) -> list[tuple[list[int], Floats]]:
        """Return for each number of terms, from 1 to :data:`MAX_TERMS`, which they are and their weights."""
        chosen: list[int] = []
        path = []
        weights = np.zeros(0)
        for _ in range(min(MAX_TERMS, len(self.terms))):
            gains = self._gains(chosen, weights)
            gains[chosen] = -1.0
            best = int(np.argmax(gains))
            if gains[best] <= 1e-12:
                break
            chosen = [*chosen, best]
            weights = self.fit(chosen)
            path.append((chosen, weights))
        return path

    @abstractmethod
    def fit(self, chosen: Sequence[int]) -> Floats:
        """Return the weights of some terms that bring the actions nearest to the original's.

        :param chosen: indices of terms
        """

    @abstractmethod
    def _gains(self, chosen: Sequence[int], weights: Floats) -> Floats:
        """Return for each term what it would bring beside those that are chosen."""

    def _sum(self, chosen: Sequence[int], weights: Floats) -> Floats:
        total = np.zeros_like(self.outputs)
        for index, weight in zip(chosen, weights, strict=True):
            total[self._rows[self.terms[index][0]]] += weight * self._said[index]
        return total

    def make(self, chosen: Sequence[int], weights: Floats) -> ProgramData:
        """Return the program of some terms.

        :param chosen: indices of terms
        :param weights: of these
        """
        shape = (self.program.action.n_outputs, self.program.n_inputs + 1)
        matrices = {branch: np.zeros(shape) for branch in self.reached}
        for index, weight in zip(chosen, weights.tolist(), strict=True):
            branch, term = self.terms[index]
            matrices[branch] += weight * term.weights
        return with_branches(self.program, matrices)


class BoxPruner(Pruner):
    """With Box actions: nearest by least squares, where neither action is at its bounds on the same side."""

    def __init__(self, program: ProgramData, states: States, symmetries: Sequence[Any]) -> None:
        super().__init__(program, states, symmetries)
        self.low, self.high = np.array(program.action.low), np.array(program.action.high)
        self._sizes = np.array([(said**2).sum() for said in self._said])

    def fit(self, chosen: Sequence[int]) -> Floats:
        """Return least squares weights.

        :param chosen: indices of terms
        """
        matrix = np.stack([self._feature(index).ravel() for index in chosen], axis=1)
        target = self.outputs.ravel()
        weights = np.zeros(len(chosen))
        low, high = (np.broadcast_to(bound, self.outputs.shape).ravel() for bound in (self.low, self.high))
        for attempt in range(_REFITS):
            outputs = matrix @ weights
            same_bound = ((outputs >= high) & (target >= high)) | ((outputs <= low) & (target <= low))
            counted = ~same_bound if attempt else np.ones(len(target), dtype=bool)
            if not counted.any():
                break
            # Beyond a bound any number does: the bound itself is asked for.
            weights = np.linalg.lstsq(matrix[counted], np.clip(target, low, high)[counted], rcond=None)[0]
        return np.asarray(weights)

    def _gains(self, chosen: Sequence[int], weights: Floats) -> Floats:
        outputs = self._sum(chosen, weights)
        residual = np.clip(self.outputs, self.low, self.high) - np.clip(outputs, self.low, self.high)
        products = np.array(
            [
                (said * residual[self._rows[branch]]).sum()
                for (branch, _), said in zip(self.terms, self._said, strict=True)
            ]
        )
        return np.where(self._sizes > 0, products**2 / np.where(self._sizes > 0, self._sizes, 1), 0.0)


class DiscretePruner(Pruner):
    """With Discrete actions: nearest by the likelihood of the original's choices, scores being log-odds.

    A multinomial logit with weights that are drawn to 0 a little; the next term is the one with the largest score
    statistic. Each distinct state counts once, so that a state in which the original goes round is not all there is.
    """

    def __init__(self, program: ProgramData, states: States, symmetries: Sequence[Any]) -> None:
        rows = np.column_stack([states.branches, states.inputs])
        first = np.unique(rows, axis=0, return_index=True)[1]
        super().__init__(program, States(states.inputs[first], states.branches[first]), symmetries)
        self._taken = np.eye(program.action.n_outputs)[self.outputs.argmax(axis=1)]

    def fit(self, chosen: Sequence[int]) -> Floats:
        """Return weights of largest likelihood, by Newton's method.

        :param chosen: indices of terms
        """
        features = np.stack([self._feature(index) for index in chosen])  # (n_terms, n_states, n_actions)
        weights, ridge = np.zeros(len(chosen)), _RIDGE * len(self._taken)

        def loss_of(weights: Floats) -> float:
            scores = np.tensordot(weights, features, 1)
            top = scores.max(axis=1)
            logs = top + np.log(np.exp(scores - top[:, None]).sum(axis=1))
            return float((logs - (scores * self._taken).sum(axis=1)).sum() + ridge / 2 * weights @ weights)

        loss = loss_of(weights)
        for _ in range(_NEWTON_STEPS):
            shares = _softmax(np.tensordot(weights, features, 1))
            gradient = np.tensordot(features, shares - self._taken, 2) + ridge * weights
            means = (features * shares).sum(axis=2)
            curvature = np.tensordot(features * shares, features, ([1, 2], [1, 2])) - means @ means.T
            step = np.linalg.solve(curvature + ridge * np.eye(len(chosen)), gradient)
            length = 1.0
            while (new := loss_of(weights - length * step)) > loss and length > 1e-4:
                length /= 2
            weights = weights - length * step
            if loss - new < 1e-6 * max(loss, 1.0):
                break
            loss = new
        return np.asarray(weights)

    def _gains(self, chosen: Sequence[int], weights: Floats) -> Floats:
        all_shares = _softmax(self._sum(chosen, weights))
        of_branch = {branch: (all_shares[rows], self._taken[rows]) for branch, rows in self._rows.items()}
        gains = np.zeros(len(self.terms))
        for index, ((branch, _), said) in enumerate(zip(self.terms, self._said, strict=True)):
            shares, taken = of_branch[branch]
            means = (said * shares).sum(axis=1)
            variance = float((said**2 * shares).sum() - (means**2).sum())
            gradient = float((said * (taken - shares)).sum())
            gains[index] = gradient**2 / (variance + _RIDGE * len(self._taken))
        return gains


def _softmax(scores: Floats) -> Floats:
    weights = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
