"""Conditions: the half-space in which another controller gains most."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_progpolicy.imitation.decision_list import Floats
from sb3_progpolicy.imitation.losses import eliminate

_SHARPNESS = 4.0  # of a condition whose values have a deviation of 1, taken for a logistic regression
_SUPPORTS = (1, 2, 3, 4, 5, 6, 8, 10)
_SAMPLE = 2_000  # states for a regression


def fit_condition(
    inputs: Floats,
    gains: Floats,
    start: Floats | None = None,
    ridges: Sequence[float] = (1e-2, 1e-4),
    cautions: Sequence[float] = (1.0, 4.0),
) -> tuple[Floats | None, float]:
    """Return a condition that holds where much is gained, and the sum of the gains where it holds.

    Logistic regression on the sign of the gain, weighted by its size, gives directions; the constant of each is the
    best there is for the sum itself.

    :param inputs: ``(n, width)``, the last column 1
    :param gains: what is gained where the condition holds, ``(n,)``
    :param start: a condition that is known
    :param ridges: penalties to try
    :param cautions: weights of losses beside gains to try
    :return: the condition ``(width,)``, ``None`` if there is hardly anything to gain
    """
    wanted = gains > 0
    if wanted.sum() < 3:
        return None, 0.0
    best: Floats | None = None
    value = -np.inf
    rows, sizes = _sample(gains)
    some, better = inputs[rows], wanted[rows]
    if start is not None:
        best, value = start, float(gains[inputs @ start >= 0].sum())
        shifted, shifted_value = _best_constant(inputs, start, gains)
        if shifted_value > value + 1e-9:
            best, value = shifted, shifted_value
    for caution in cautions:
        costs = sizes * np.where(better, 1.0, caution)
        direction = start if caution == 1.0 else None
        for ridge in ridges:
            direction = logistic(some, better, costs, direction, ridge)
            shifted, shifted_value = _best_constant(inputs, direction, gains)
            if shifted_value > value:
                best, value = shifted, shifted_value
    assert best is not None
    return best / max(float(np.std(inputs @ best)), 1e-9), value


def fit_sparse_condition(
    inputs: Floats, gains: Floats, start: Floats, tolerance: float, always_few: bool = False
) -> Floats:
    """Return the condition of fewest inputs whose sum of gains is at most ``tolerance`` below the best known.

    :param inputs: ``(n, width)``
    :param gains: ``(n,)``
    :param start: a condition that is known
    :param tolerance: in the unit of the gains
    :param always_few: whether to return the best one of at most ten inputs if none is within the tolerance
    """
    full, value = fit_condition(inputs, gains, start, ridges=(1e-3,))
    if full is None:
        return start
    paths = _paths(inputs, gains, full)
    best, most = full, -np.inf
    for size in _SUPPORTS:
        found = []
        for path in paths:
            kept, adjusted = next(step for step in path if step[0].sum() <= size + 1)
            fewer, gained = fit_condition(inputs[:, kept], gains, adjusted[kept], ridges=(1e-4,), cautions=(1.0, 2.0))
            if fewer is not None:
                found.append((gained, kept, fewer))
        if not found:
            continue
        _, kept, fewer = max(found, key=lambda one: one[0])
        fewer, reached = improve(inputs[:, kept], gains, fewer)
        if reached > most:
            best, most = np.zeros(len(kept)), reached
            best[kept] = fewer
        if reached >= value - tolerance:
            return best
    return best if always_few else full


def _paths(inputs: Floats, gains: Floats, full: Floats) -> list[list[tuple[np.ndarray, Floats]]]:
    """Return which inputs are left when they go one by one: of a fit without a start, and of a known condition."""
    rows, costs = _sample(gains)
    some, costs = inputs[rows], costs / costs.mean()
    directions = (logistic(some, gains[rows] > 0, costs, None, 1e-4), _SHARPNESS * full)
    return [_elimination(some, costs, direction) for direction in directions]


def fit_priced_condition(
    inputs: Floats, gains: Floats, start: Floats, price: float, most: int = 4
) -> tuple[Floats | None, float]:
    """Return the condition of a few inputs whose sum of gains, less the price of its inputs, is the largest.

    :param inputs: ``(n, width)``
    :param gains: ``(n,)``
    :param start: a condition that is known
    :param price: of an input, in the unit of the gains
    :param most: number of inputs at most
    :return: the condition ``(width,)``, ``None`` if there is hardly anything to gain; and its gains less the price
    """
    full, _ = fit_condition(inputs, gains, start, ridges=(1e-3,))
    if full is None:
        return None, 0.0
    paths = _paths(inputs, gains, full)
    supports = [
        next(step for step in path if step[0].sum() <= size + 1) for size in range(1, most + 1) for path in paths
    ]
    known = start != 0
    known[-1] = True
    if known.sum() <= most + 1:
        supports.append((known, start))
    best, largest = None, -np.inf
    for kept, adjusted in supports:
        fewer, _ = fit_condition(inputs[:, kept], gains, adjusted[kept], ridges=(1e-4,), cautions=(1.0, 2.0))
        if fewer is None:
            continue
        fewer, gained = improve(inputs[:, kept], gains, fewer)
        if gained - price * (kept.sum() - 1) > largest:
            best, largest = np.zeros(len(kept)), gained - price * float(kept.sum() - 1)
            best[kept] = fewer
    return best, largest


def refit_condition(inputs: Floats, gains: Floats, start: Floats) -> tuple[Floats, float]:
    """Return the condition of the same inputs as a known one whose sum of gains is the largest, and this sum.

    :param inputs: ``(n, width)``
    :param gains: ``(n,)``
    :param start: the known condition
    """
    kept = start != 0
    kept[-1] = True
    fitted, _ = fit_condition(inputs[:, kept], gains, start[kept], ridges=(1e-4,), cautions=(1.0, 2.0))
    fitted, gained = improve(inputs[:, kept], gains, start[kept] if fitted is None else fitted)
    condition = np.zeros(len(start))
    condition[kept] = fitted
    return condition, gained


def _sample(gains: Floats) -> tuple[np.ndarray, Floats]:
    """Return which states a regression looks at, and what each of them counts.

    Of many states some are drawn at equal distances of the summed size of gains, so that all of them count the same.
    """
    sizes = np.abs(gains)
    if len(gains) <= _SAMPLE:
        return np.arange(len(gains)), sizes
    sums = np.cumsum(sizes)
    rows = np.searchsorted(sums, (np.arange(_SAMPLE) + 0.5) / _SAMPLE * sums[-1])
    return np.minimum(rows, len(gains) - 1), np.ones(_SAMPLE)


def _elimination(inputs: Floats, costs: Floats, direction: Floats) -> list[tuple[np.ndarray, Floats]]:
    """Return the masks and weights of :func:`eliminate` for a logistic regression."""
    chances = _sigmoid(inputs @ direction)
    curvature = costs * np.maximum(chances * (1 - chances), 1e-3)
    hessian = (inputs * curvature[:, None]).T @ inputs + 1e-5 * len(inputs) * np.eye(len(direction))
    return eliminate(hessian, direction)


def improve(inputs: Floats, gains: Floats, condition: Floats, cycles: int = 2) -> tuple[Floats, float]:
    """Return a condition of no smaller sum of gains, one weight after another at its best (OC1, Murthy et al. 1994).

    :param inputs: ``(n, width)``
    :param gains: ``(n,)``
    :param condition: to begin with
    :param cycles: over the weights
    :return: the condition, and the sum of gains where it holds
    """
    condition = condition / max(float(np.std(inputs @ condition)), 1e-9)
    values = inputs @ condition
    best = float(gains[values >= 0].sum())
    for _ in range(cycles):
        before = best
        for index in range(len(condition)):
            column = inputs[:, index]
            moves = np.abs(column) > 1e-9
            # The weight at which each state begins to hold, where its input is positive, or ceases to.
            turns = condition[index] - values[moves] / column[moves]
            order = np.argsort(turns)
            turns, signs = turns[order], np.sign(column[moves][order])
            moved = gains[moves][order]
            sums = moved[signs < 0].sum() + np.cumsum(signs * moved) + gains[~moves & (values >= 0)].sum()
            last = int(sums[:-1].argmax()) if len(sums) > 1 else 0
            if len(sums) > 1 and sums[last] > best + 1e-9:
                weight = 0.5 * (turns[last] + turns[last + 1])
                shifted = values + (weight - condition[index]) * column
                reached = float(gains[shifted >= 0].sum())
                if reached > best:
                    condition = condition.copy()
                    condition[index], values, best = weight, shifted, reached
        if best <= before:
            break
    return condition, best


def logistic(
    inputs: Floats, wanted: np.ndarray, costs: Floats, start: Floats | None, ridge: float, iterations: int = 12
) -> Floats:
    """Return the weights of a logistic regression, by Newton's method with halved steps.

    :param inputs: ``(n, width)``, the last column 1
    :param wanted: classes, ``(n,)``
    :param costs: of errors, ``(n,)``
    :param start: weights to begin with
    :param ridge: penalty on squared weights
    :param iterations: Newton steps at most
    """
    n, width = inputs.shape
    costs = costs / max(float(costs.mean()), 1e-12)
    weights = np.zeros(width) if start is None else start.copy()
    penalty = np.full(width, ridge * n)
    penalty[-1] *= 1e-2

    def objective(candidate: Floats, values: Floats) -> float:
        return float((costs * (np.logaddexp(0, values) - wanted * values)).sum() + 0.5 * penalty @ candidate**2)

    values = inputs @ weights
    value = objective(weights, values)
    for _ in range(iterations):
        chances = _sigmoid(values)
        gradient = inputs.T @ (costs * (chances - wanted)) + penalty * weights
        curvature = costs * np.maximum(chances * (1 - chances), 1e-4)
        step = np.linalg.solve((inputs * curvature[:, None]).T @ inputs + np.diag(penalty), gradient)
        length, before = 1.0, value
        while length > 1e-3:
            moved = weights - length * step
            values = inputs @ moved
            if (value := objective(moved, values)) < before:
                break
            length *= 0.5
        else:
            break
        weights = moved
        if before - value < 1e-4 * abs(before):
            break
    return weights


def _best_constant(inputs: Floats, weights: Floats, gains: Floats) -> tuple[Floats, float]:
    """Return the condition with the constant for which the sum of gains is largest, and that sum."""
    values = inputs @ weights
    order = np.argsort(-values)
    ordered, sums = values[order], np.cumsum(gains[order])
    sums[:-1][ordered[1:] == ordered[:-1]] = -np.inf  # no constant parts equal values
    last = int(sums.argmax())
    if sums[last] <= 0:
        threshold, best = ordered[0] + 1.0, 0.0
    else:
        following = ordered[last + 1] if last + 1 < len(ordered) else ordered[last] - 2.0
        threshold, best = 0.5 * (ordered[last] + following), float(sums[last])
    shifted = weights.copy()
    shifted[-1] -= threshold
    return shifted, best


def _sigmoid(values: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(values, -30, 30))))
