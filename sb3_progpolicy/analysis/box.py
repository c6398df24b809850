"""Programs with Box actions: fewer and rounder weights, as long as success and steps on training variations hold."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.analysis.finetune import finetune, matrix_of, why_not, with_controllers
from sb3_progpolicy.analysis.terms import Floats, Term, terms_of
from sb3_progpolicy.evaluation import Evaluation, evaluate_program, success_and_steps
from sb3_progpolicy.programs.syntax import Controller, Expression, IfThenElse, ProgramData

MAX_TERMS = 40
#: States on which weights are fitted, at most.
MAX_STATES = 20_000
#: How many times the original's steps a smaller program is given.
PATIENCE = 4
_REFITS = 8
#: Significant digits that are tried, the fewest first.
_DIGITS = (1, 2, 3)


@dataclass(frozen=True)
class Point:
    """What a program of so many terms reaches on the training variations.

    :param terms: how many
    :param program: with weights rounded as far as that costs nothing
    :param success_rate: share of episodes, 0 to 1
    :param steps_mean: of an episode, which is ended at :data:`PATIENCE` times the original's
    """

    terms: int
    program: ProgramData
    success_rate: float
    steps_mean: float


@dataclass(frozen=True)
class States:
    """What a program did on its own way.

    :param inputs: X and the constant, ``(n, n_inputs + 1)``
    :param branches: index of the controller that acted, ``(n,)``
    """

    inputs: Floats
    branches: NDArray[np.int64]


def visited(
    program: ProgramData, env_id: str, variations: Sequence[Mapping[str, Any]], episodes: int, seed: int
) -> tuple[States, list[Evaluation]]:
    """Run a program on variations and return the states that it met, and how it did.

    :param program: crisp
    :param env_id: environment id
    :param variations: of it
    :param episodes: on each variation
    :param seed: of the environments
    """
    inputs: list[Floats] = []
    branches: list[NDArray[np.int64]] = []

    def watch(x: Floats, branch: NDArray[np.int64]) -> None:
        inputs.append(x)
        branches.append(branch)

    rows = evaluate_program(program, env_id, variations, episodes, seed=seed, watch=watch)
    joined, branch = np.concatenate(inputs), np.concatenate(branches)
    if len(joined) > MAX_STATES:
        kept = np.sort(np.random.default_rng(seed).choice(len(joined), MAX_STATES, replace=False))
        joined, branch = joined[kept], branch[kept]
    return States(np.column_stack([joined, np.ones(len(joined))]), branch), rows


class Pruner:
    """Programs of few terms that do nearly what the original does, one for each number of terms.

    Terms are added one by one, the one first that brings the actions nearest to the original's; all weights are fitted
    anew each time, by least squares where neither action is at its bounds on the same side.

    :param program: the original
    :param states: on which actions are compared
    :param symmetries: that tie the weights; none for free ones
    """

    def __init__(self, program: ProgramData, states: States, symmetries: Sequence[Any]) -> None:
        self.program, self.states = program, states
        self.low, self.high = np.array(program.action.low), np.array(program.action.high)
        #: The branches that act at all; the others are dropped.
        self.reached = sorted(set(states.branches.tolist()))
        self.terms: list[tuple[int, Term]] = [
            (branch, term)
            for branch in self.reached
            for term in terms_of(program, program.action.n_outputs, symmetries)
        ]
        self.target = np.zeros((len(states.inputs), program.action.n_outputs))
        for branch in self.reached:
            here = states.branches == branch
            controller = program.controllers[branch]
            self.target[here] = states.inputs[here] @ matrix_of(controller).T
        self._features = [self._feature(branch, term) for branch, term in self.terms]

    def _feature(self, branch: int, term: Term) -> Floats:
        values = self.states.inputs @ term.weights.T
        values[self.states.branches != branch] = 0
        return np.asarray(values)

    def path(self, max_terms: int = MAX_TERMS) -> list[tuple[list[int], Floats]]:
        """Return for each number of terms, from 1, which they are and their weights."""
        chosen: list[int] = []
        path = []
        weights = np.zeros(0)
        for _ in range(min(max_terms, len(self.terms))):
            residual = self._residual(chosen, weights)
            gains = [self._gain(feature, residual) for feature in self._features]
            gains = [-1.0 if index in chosen else gain for index, gain in enumerate(gains)]
            best = int(np.argmax(gains))
            if gains[best] <= 1e-12:
                break
            chosen = [*chosen, best]
            weights = self.fit(chosen)
            path.append((chosen, weights))
        return path

    def fit(self, chosen: Sequence[int]) -> Floats:
        """Return the weights of some terms that bring the actions nearest to the original's.

        :param chosen: indices of terms
        """
        matrix = np.stack([self._features[index].ravel() for index in chosen], axis=1)
        target = self.target.ravel()
        weights = np.zeros(len(chosen))
        low, high = (np.broadcast_to(bound, self.target.shape).ravel() for bound in (self.low, self.high))
        for attempt in range(_REFITS):
            outputs = matrix @ weights
            same_bound = ((outputs >= high) & (target >= high)) | ((outputs <= low) & (target <= low))
            counted = ~same_bound if attempt else np.ones(len(target), dtype=bool)
            if not counted.any():
                break
            # Beyond a bound any number does: the bound itself is asked for.
            weights = np.linalg.lstsq(matrix[counted], np.clip(target, low, high)[counted], rcond=None)[0]
        return np.asarray(weights)

    def _residual(self, chosen: Sequence[int], weights: Floats) -> Floats:
        outputs = np.zeros_like(self.target)
        for index, weight in zip(chosen, weights, strict=True):
            outputs += weight * self._features[index]
        return np.asarray(np.clip(self.target, self.low, self.high) - np.clip(outputs, self.low, self.high))

    @staticmethod
    def _gain(feature: Floats, residual: Floats) -> float:
        size = float((feature**2).sum())
        return 0.0 if size == 0 else float((feature * residual).sum()) ** 2 / size

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
        controllers = {
            branch: Controller(tuple(map(tuple, matrix[:, :-1].tolist())), tuple(matrix[:, -1].tolist()))
            for branch, matrix in matrices.items()
        }
        body: Expression = controllers[self.reached[-1]]
        for branch in reversed(self.reached[:-1]):
            body = IfThenElse(self.program.conditions[branch], controllers[branch], body)
        return dataclasses.replace(self.program, body=body)


def rounded(weights: Floats, digits: int) -> Floats:
    """Return numbers with so many significant digits.

    :param weights: numbers
    :param digits: at least 1
    """
    return np.array([float(f"{weight:.{digits - 1}e}") for weight in weights.tolist()])


def pareto(
    pruner: Pruner,
    measure: Callable[[ProgramData], tuple[float, float]],
    good_enough: Callable[[float, float], bool],
    max_terms: int = MAX_TERMS,
) -> tuple[list[Point], Point | None]:
    """Return what programs of few terms reach, up to the first that is good enough and cannot lose a term.

    :param pruner: makes them
    :param measure: returns success rate and mean steps of a program on the training variations
    :param good_enough: whether these are within the tolerance
    :param max_terms: how many terms to try
    :return: the curve, and the point to take; ``None`` if none is good enough
    """
    curve: list[Point] = []

    def point_of(chosen: Sequence[int], weights: Floats) -> Point:
        return _rounded_point(pruner, chosen, weights, measure, good_enough)

    for chosen, weights in pruner.path(max_terms):
        best = point_of(chosen, weights)
        curve.append(best)
        if not good_enough(best.success_rate, best.steps_mean):
            continue
        kept, lost = list(chosen), True
        while lost and len(kept) > 1:
            lost = False
            for index in kept:
                rest = [other for other in kept if other != index]
                fewer = point_of(rest, pruner.fit(rest))
                if good_enough(fewer.success_rate, fewer.steps_mean):
                    best, kept, lost = fewer, rest, True
                    curve.append(best)
                    break
        return sorted(curve, key=lambda one: one.terms), best
    return curve, None


def _rounded_point(
    pruner: Pruner,
    chosen: Sequence[int],
    weights: Floats,
    measure: Callable[[ProgramData], tuple[float, float]],
    good_enough: Callable[[float, float], bool],
) -> Point:
    """Return the program with the roundest weights that is good enough, or else with three digits."""
    point: Point | None = None
    for digits in _DIGITS:
        program = pruner.make(chosen, rounded(weights, digits))
        success, steps = measure(program)
        point = Point(len(chosen), program, success, steps)
        if good_enough(success, steps):
            return point
        if not math.isfinite(steps):
            break
    assert point is not None
    return point


@dataclass(frozen=True)
class Pruned:
    """What pruning has come to.

    :param point: the program to take
    :param curve: what others reach, by number of terms
    :param states: how many states were looked at
    :param episodes: from how many episodes they come
    :param tied: whether symmetries tie the weights
    :param notes: what was tried and did not succeed
    :param finetuned: for how many environment steps the program was trained on; 0 if it was not, or nothing came of it
    :param learned_by: how a program that was trained on was learned
    """

    point: Point
    curve: tuple[Point, ...]
    states: int
    episodes: int
    tied: bool
    notes: tuple[str, ...]
    finetuned: int = 0
    learned_by: str = ""


def prune(
    program: ProgramData,
    env_id: str,
    variations: Sequence[Mapping[str, Any]],
    symmetries: Sequence[Any],
    *,
    episodes: int,
    success_tolerance: float,
    steps_tolerance: float,
    n_terms: int | None,
    finetune_for: int | None,
    seed: int,
) -> Pruned:
    """Return a program of few, round weights that is as good on the training variations.

    :param program: acts in a Box
    :param env_id: environment id
    :param variations: of it
    :param symmetries: that are to tie the weights
    :param episodes: on each variation
    :param success_tolerance: by how much the share of successes may fall
    :param steps_tolerance: by what share the steps may rise
    :param n_terms: take the program of so many terms, good enough or not; ``None`` for the first that is
    :param finetune_for: environment steps for which it is then trained on; ``None`` for none
    :param seed: of the environments
    :raises ValueError: if no program of so many terms was found
    """
    states, rows = visited(program, env_id, variations, episodes, seed)
    success, steps = success_and_steps(rows)
    cap = max(1, math.ceil(PATIENCE * max(row.steps_mean for row in rows)))  # bad programs are not waited for

    def measure(candidate: ProgramData) -> tuple[float, float]:
        return success_and_steps(evaluate_program(candidate, env_id, variations, episodes, seed=seed, max_steps=cap))

    def good_enough(success_rate: float, steps_mean: float) -> bool:
        return success_rate >= success - success_tolerance and steps_mean <= steps * (1 + steps_tolerance)

    notes: list[str] = []
    if len(set(states.branches.tolist())) > 1:
        notes.append("conditions stay as they are")
    for tied in [True, False] if symmetries else [False]:
        curve, best = pareto(Pruner(program, states, symmetries if tied else ()), measure, good_enough)
        if n_terms is not None:
            best = next((point for point in curve if point.terms == n_terms), None)
            if best is None:
                known = ", ".join(str(point.terms) for point in curve)
                raise ValueError(f"n_terms={n_terms} is not accepted; there are programs of {known} terms")
        if best is not None:
            found = Pruned(best, tuple(curve), len(states.inputs), episodes * len(variations), tied, tuple(notes))
            if finetune_for is None:
                return found
            if reason := why_not(best.program):
                return dataclasses.replace(found, notes=(*found.notes, f"it was not trained on: {reason}"))
            train = partial(finetune, env_id=env_id, variations=variations, n_timesteps=finetune_for, seed=seed)
            return _finetuned(
                found, partial(train, symmetries=symmetries if tied else ()), finetune_for, measure, good_enough
            )
        notes.append(f"no {'tied ' if tied else ''}program of up to {MAX_TERMS} terms is as good")
    original = Point(0, program, success, steps)
    return Pruned(original, tuple(curve), len(states.inputs), episodes * len(variations), False, tuple(notes))


def _finetuned(
    pruned: Pruned,
    train: Callable[[ProgramData], tuple[ProgramData, str]],
    n_timesteps: int,
    measure: Callable[[ProgramData], tuple[float, float]],
    good_enough: Callable[[float, float], bool],
) -> Pruned:
    """Return what training makes of a pruned program, with the roundest numbers that make it better, or the pruned one.

    :param pruned: the program
    :param train: returns a program's trained form, and how it was learned
    :param n_timesteps: of the training
    :param measure: returns success rate and mean steps of a program on the training variations
    :param good_enough: whether these are within the tolerance, which one that is within it must not leave
    """
    before = pruned.point
    trained, learned_by = train(before.program)
    for digits in _DIGITS:
        matrices = [matrix_of(controller) for controller in trained.controllers]
        candidate = with_controllers(
            trained, [rounded(matrix.ravel(), digits).reshape(matrix.shape) for matrix in matrices]
        )
        success, steps = measure(candidate)
        better = (success, -steps) > (before.success_rate, -before.steps_mean)
        kept = good_enough(success, steps) or not good_enough(before.success_rate, before.steps_mean)
        if better and kept:
            point = Point(before.terms, candidate, success, steps)
            return dataclasses.replace(pruned, point=point, finetuned=n_timesteps, learned_by=learned_by)
    note = f"{n_timesteps} steps of training made it no better ({success:.0%}, {steps:g} steps)"
    return dataclasses.replace(pruned, notes=(*pruned.notes, note))
