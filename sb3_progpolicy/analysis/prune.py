"""Fewer and rounder weights, as long as success and steps on the training variations hold."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs import get_domain
from sb3_progpolicy.analysis.finetune import finetune, matrix_of, why_not, with_controllers
from sb3_progpolicy.analysis.paths import MAX_TERMS, BoxPruner, DiscretePruner, Pruner, States, rounded
from sb3_progpolicy.analysis.terms import Floats
from sb3_progpolicy.analysis.thin import Thinner
from sb3_progpolicy.evaluation import Evaluation, evaluate_program, success_and_steps
from sb3_progpolicy.programs.syntax import ProgramData

#: States on which weights are fitted, at most.
MAX_STATES = 20_000
#: How many times the original's steps a smaller program is given.
PATIENCE = 4
#: How many times a variation is played at the same time.
_TIMES = 10
#: Significant digits that are tried; the most are what has to do first.
_DIGITS = (1, 2, 3)

Measure = Callable[[ProgramData], tuple[float, float]]
GoodEnough = Callable[[float, float], bool]


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


def spread(
    env_id: str, variations: Sequence[Mapping[str, Any]], episodes: int
) -> tuple[Sequence[Mapping[str, Any]], int]:
    """Return the same episodes as more variations of fewer episodes each, where a batch of steps costs little more.

    :param env_id: environment id
    :param variations: of it
    :param episodes: on each
    :return: the variations, each several times, and how many episodes on each at least
    """
    if get_domain(env_id).simulation:
        return variations, episodes
    times = min(_TIMES, episodes)
    return [variation for variation in variations for _ in range(times)], math.ceil(episodes / times)


def pareto(
    pruner: Pruner,
    measure: Measure,
    good_enough: GoodEnough,
    whole: bool = False,
) -> tuple[list[Point], Point | None]:
    """Return what programs of few terms reach, up to the first that is good enough and cannot lose a term.

    :param pruner: makes them
    :param measure: returns success rate and mean steps of a program on the training variations
    :param good_enough: whether these are within the tolerance
    :param whole: measure smaller programs even if the one of :data:`MAX_TERMS` terms is not good enough
    :return: the curve, and the point to take; ``None`` if none is good enough
    """
    curve: list[Point] = []

    def point_of(chosen: Sequence[int], weights: Floats) -> Point:
        return _rounded_point(pruner, chosen, weights, measure, good_enough)

    path = pruner.path()
    if path and not whole:
        largest = point_of(*path[-1])
        if not good_enough(largest.success_rate, largest.steps_mean):
            return [largest], None
    for chosen, weights in path:
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
    measure: Measure,
    good_enough: GoodEnough,
) -> Point:
    """Return the program with the roundest weights that is good enough, or else with three digits."""

    def point_of(digits: int) -> Point:
        program = pruner.make(chosen, rounded(weights, digits))
        return Point(len(chosen), program, *measure(program))

    exact = point_of(_DIGITS[-1])
    if not good_enough(exact.success_rate, exact.steps_mean):
        return exact
    rounder = (point_of(digits) for digits in _DIGITS[:-1])
    return next((point for point in rounder if good_enough(point.success_rate, point.steps_mean)), exact)


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

    :param program: acts in a Discrete space or a Box
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
    given, (variations, episodes) = variations, spread(env_id, variations, episodes)
    states, rows = visited(program, env_id, variations, episodes, seed)
    success, steps = success_and_steps(rows)
    cap = max(1, math.ceil(PATIENCE * max(row.steps_mean for row in rows)))  # bad programs are not waited for

    def measure(candidate: ProgramData) -> tuple[float, float]:
        return success_and_steps(evaluate_program(candidate, env_id, variations, episodes, seed=seed, max_steps=cap))

    def good_enough(success_rate: float, steps_mean: float) -> bool:
        return success_rate >= success - success_tolerance and steps_mean <= steps * (1 + steps_tolerance)

    found, notes = _by_path(program, states, symmetries, measure, good_enough, n_terms)
    if found is None:
        found, more = _by_thinning(Thinner(program, states, symmetries), measure, good_enough)
        notes += more
    if found is None:
        found, finetune_for = _Found(Point(0, program, success, steps), (), False), None
    pruned = Pruned(found.point, found.curve, len(states.inputs), episodes * len(variations), found.tied, tuple(notes))
    if finetune_for is None:
        return pruned
    if reason := why_not(pruned.point.program):
        return dataclasses.replace(pruned, notes=(*pruned.notes, f"it was not trained on: {reason}"))
    train = partial(finetune, env_id=env_id, variations=given, n_timesteps=finetune_for, seed=seed)
    tying = symmetries if pruned.tied else ()
    return _finetuned(pruned, partial(train, symmetries=tying), finetune_for, measure, good_enough)


class _Found(NamedTuple):
    point: Point
    curve: tuple[Point, ...]
    tied: bool


def _by_path(
    program: ProgramData,
    states: States,
    symmetries: Sequence[Any],
    measure: Measure,
    good_enough: GoodEnough,
    n_terms: int | None,
) -> tuple[_Found | None, list[str]]:
    """Return a program of a few terms, if there is one, and notes."""
    make_pruner = DiscretePruner if program.action.kind == "discrete" else BoxPruner
    notes: list[str] = []
    for tied in [True, False] if symmetries else [False]:
        curve, best = pareto(
            make_pruner(program, states, symmetries if tied else ()), measure, good_enough, n_terms is not None
        )
        if n_terms is not None:
            # Several may have so many terms: those that were added one by one, and others of which some were left out.
            best = max(
                (point for point in curve if point.terms == n_terms),
                key=lambda one: (good_enough(one.success_rate, one.steps_mean), one.success_rate, -one.steps_mean),
                default=None,
            )
            if best is None:
                known = ", ".join(str(point.terms) for point in curve)
                raise ValueError(f"n_terms={n_terms} is not accepted; there are programs of {known} terms")
        if best is not None:
            if len(set(states.branches.tolist())) > 1:
                notes.append("conditions stay as they are")
            return _Found(best, tuple(curve), tied), notes
        notes.append(f"no {'tied ' if tied else ''}program of up to {MAX_TERMS} terms is as good")
    return None, notes


def _by_thinning(thinner: Thinner, measure: Measure, good_enough: GoodEnough) -> tuple[_Found | None, list[str]]:
    """Return a program without the numbers that matter least, if there is one, and notes."""
    curve, n_pieces = thin(thinner, measure, good_enough)
    if n_pieces == len(thinner.pieces):
        return None, ["none of its numbers can be left out"]
    best = next(point for point in curve if point.terms == n_pieces)
    for digits in _DIGITS:
        program = thinner.make(n_pieces, digits)
        point = Point(n_pieces, program, *measure(program))
        if good_enough(point.success_rate, point.steps_mean):
            best = point
            break
    notes = ["the numbers that matter least were left out, those of conditions too; the others are as they were learnt"]
    return _Found(best, tuple(sorted(curve, key=lambda point: point.terms)), thinner.tied), notes


def thin(thinner: Thinner, measure: Measure, good_enough: GoodEnough) -> tuple[list[Point], int]:
    """Look for the program of the fewest of a program's own numbers.

    More numbers are taken to be no worse, so that halving the interval finds it.

    :param thinner: makes them
    :param measure: returns success rate and mean steps of a program on the training variations
    :param good_enough: whether these are within the tolerance
    :return: what was tried, and how many numbers to take: all, if fewer are never good enough
    """
    points = []
    low, high = 0, len(thinner.pieces)  # of which low is not good enough and high is
    while high - low > 1:
        middle = (low + high) // 2
        program = thinner.make(middle)
        points.append(Point(middle, program, *measure(program)))
        if good_enough(points[-1].success_rate, points[-1].steps_mean):
            high = middle
        else:
            low = middle
    return points, high


def _finetuned(
    pruned: Pruned,
    train: Callable[[ProgramData], tuple[ProgramData, str]],
    n_timesteps: int,
    measure: Measure,
    good_enough: GoodEnough,
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
        candidate = with_controllers(trained, [rounded(matrix, digits) for matrix in matrices])
        success, steps = measure(candidate)
        better = (success, -steps) > (before.success_rate, -before.steps_mean)
        kept = good_enough(success, steps) or not good_enough(before.success_rate, before.steps_mean)
        if better and kept:
            point = Point(before.terms, candidate, success, steps)
            return dataclasses.replace(pruned, point=point, finetuned=n_timesteps, learned_by=learned_by)
    note = f"{n_timesteps} steps of training made it no better ({success:.0%}, {steps:g} steps)"
    return dataclasses.replace(pruned, notes=(*pruned.notes, note))
