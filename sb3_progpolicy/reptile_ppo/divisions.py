"""Where to divide a branch: where the policy gradient of its controller points another way on either side.

At a controller that has been trained the gradients of the single states sum to about 0, because one affine function has
to serve all of them. A condition is worth trying where the sum over the states on one side of it is far from 0: there
two controllers would part. That is the fluctuation test of model-based recursive partitioning (Zeileis, Hothorn and
Hornik, 2008, *Model-Based Recursive Partitioning*, section 3), with policy gradients in the place of scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_progpolicy.differentiable.growth import Division
from sb3_progpolicy.differentiable.tied import TiedLinear
from sb3_progpolicy.reptile_ppo.update import normalized

Array = NDArray[np.float64]

#: At most so many states are looked at.
MAX_STATES = 8192
#: A branch with fewer states is not divided.
MIN_STATES = 200
#: A state belongs to a branch if the program leads there at least this often.
MIN_MASS = 0.1
#: Shares of a branch's states at which thresholds are tried.
QUANTILES = np.linspace(0.1, 0.9, 9)
#: Rounds of fitting a slanted division.
N_ROUNDS = 5


@dataclass(frozen=True)
class Candidate:
    """A division, and how much speaks for it.

    :param division: of a branch
    :param statistic: mean over the controller's parameters of how far the sum of the gradients on one side is from 0,
        in variances of such a sum; about 1 where a division means nothing
    :param input: which input a division along an axis reads; -1 for a slanted one
    """

    division: Division
    statistic: float
    input: int


@dataclass(frozen=True)
class Experience:
    """States of rollouts, and what was done there.

    :param observations: ``(n, n_inputs)``
    :param condition_values: ``(n, depth - 1)``
    :param actions: as the distributions take them, ``(n, ...)``
    :param advantages: ``(n,)``
    """

    observations: th.Tensor
    condition_values: th.Tensor
    actions: th.Tensor
    advantages: th.Tensor


def rank_divisions(policy: Any, experience: Experience) -> list[Candidate]:
    """Return what could be divided, the most promising first.

    :param policy: a program whose search is over
    :param experience: drawn from it
    """
    module = policy.module
    n_conditions = module.search.most_likely()
    inputs, gradients, masses = (
        tensor.cpu().numpy().astype(np.float64)
        for tensor in policy.output_gradients(
            experience.observations,
            experience.condition_values,
            experience.actions,
            normalized(experience.advantages),
        )
    )
    read = inputs if module.conditions.projection is None else inputs @ module.conditions.projection.cpu().numpy()
    candidates = []
    for then in (False, True)[: 1 + bool(n_conditions)]:
        row = n_conditions - 1 if then else n_conditions  # among the controllers in use
        there = masses[:, row] >= MIN_MASS
        if there.sum() < MIN_STATES:
            continue
        scores = _scores(module.controllers, inputs[there], gradients[row][there])
        if scores.shape[1]:
            candidates += [
                Candidate(Division(then, weight, bias), statistic, number)
                for (weight, bias), statistic, number in _cuts(read[there], scores)
            ]
    return sorted(candidates, key=lambda candidate: -candidate.statistic)


def _scores(controllers: Any, inputs: Array, gradients: Array) -> Array:
    """Return each state's gradient by the controller's parameters, ``(n, n_parameters)``, each of mean 0, variance 1.

    :param controllers: of the module; those that are tied have fewer parameters
    :param inputs: X, ``(n, n_inputs)``
    :param gradients: by the controller's outputs, ``(n, n_outputs)``
    """
    extended = np.column_stack((inputs, np.ones(len(inputs))))
    scores = (gradients[:, :, None] * extended[:, None, :]).reshape(len(inputs), -1)
    if isinstance(controllers, TiedLinear):
        index, sign = controllers.ties_of_weights()
        scores = scores @ (np.eye(controllers.free.shape[1])[index.ravel()] * sign.ravel()[:, None])
    scores = scores - scores.mean(0)
    deviation = scores.std(0)
    return scores[:, deviation > 1e-8] / deviation[deviation > 1e-8]


def _cuts(inputs: Array, scores: Array) -> list[tuple[tuple[tuple[float, ...], float], float, int]]:
    """Return weight and bias of the best threshold of every input, and of a slanted division, with their statistics."""
    mean, deviation = inputs.mean(0), inputs.std(0)
    cuts: list[Any] = []
    best: tuple[float, NDArray[np.bool_]] | None = None
    # Under a symmetry the inputs of an orbit have the same mean; the first stands for all.
    different = np.sort(np.unique(inputs.round(9), axis=1, return_index=True)[1])
    for number in different[deviation[different] > 1e-6]:
        threshold, statistic = _best_threshold(inputs[:, number], scores)
        if threshold is None:
            continue
        weight = np.zeros(inputs.shape[1])
        weight[number] = 1 / deviation[number]
        cuts.append(((tuple(weight.tolist()), float(-threshold / deviation[number])), statistic, int(number)))
        if best is None or statistic > best[0]:
            best = statistic, inputs[:, number] >= threshold
    if best is not None:
        cuts += _slanted((inputs - mean) / np.where(deviation > 1e-6, deviation, np.inf), mean, deviation, scores, best)
    return cuts


def _best_threshold(values: Array, scores: Array) -> tuple[float | None, float]:
    order = np.argsort(values, kind="stable")
    ordered, n = values[order], len(values)
    sums = np.cumsum(scores[order], axis=0)
    best: tuple[float | None, float] = (None, 0.0)
    # Equal values are on one side: each cut is moved to where the value changes.
    for cut in np.unique(np.searchsorted(ordered, ordered[(QUANTILES * n).astype(int)], side="left")):
        if not QUANTILES[0] * n * 0.5 <= cut <= n - QUANTILES[0] * n * 0.5:
            continue
        statistic = _statistic(sums[cut - 1], cut, n)
        if statistic > best[1]:
            best = float(ordered[cut - 1] + ordered[cut]) / 2, statistic
    return best


def _statistic(sums: Array, n_side: int, n: int) -> float:
    """Return the mean of the squared sums of one side's scores, over their variance ``n f (1 - f)``."""
    return float(np.mean(sums**2) * n / (n_side * (n - n_side)))


def _slanted(
    standard: Array, mean: Array, deviation: Array, scores: Array, best: tuple[float, NDArray[np.bool_]]
) -> list[Any]:
    """Return a division across several inputs, fitted in turns with the direction in which the two sides part."""
    design = np.column_stack((standard, np.ones(len(standard))))
    side, found = best[1], None
    for _ in range(N_ROUNDS):
        direction = scores[side].sum(0)
        wish = scores @ direction / max(float(np.linalg.norm(direction)), 1e-12)
        solution = np.linalg.lstsq(design, wish, rcond=1e-6)[0]
        sums = design @ solution
        side = sums >= 0
        if not 0.1 <= side.mean() <= 0.9 or sums.std() < 1e-12:
            break
        statistic = _statistic(scores[side].sum(0), int(side.sum()), len(side))
        if found is None or statistic > found[1]:
            weight = np.where(deviation > 1e-6, solution[:-1] / np.where(deviation > 1e-6, deviation, 1.0), 0.0)
            bias = float(solution[-1] - weight @ mean)
            size = float(sums.std())
            found = ((tuple((weight / size).tolist()), bias / size), statistic, -1)
    return [found] if found is not None and found[1] > best[0] else []


def tries(candidates: Sequence[Candidate], number: int) -> Candidate | None:
    """Return what to try after ``number`` refusals in a row: one candidate after the other, then from the first again.

    :param candidates: from :func:`rank_divisions`
    """
    return candidates[number % len(candidates)] if candidates else None
