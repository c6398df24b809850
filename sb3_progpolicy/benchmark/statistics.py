"""What a benchmark reports: means over seeds, interquartile means with bootstrap intervals, performance profiles.

The last two follow Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice",
arXiv:2108.13264, on ``scipy.stats``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

#: Of a bootstrap; intervals hold 95 % of them.
N_RESAMPLES, CONFIDENCE = 2000, 0.95

#: Scores of a method, ``(n_seeds,)`` for each task.
Scores = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Interval:
    """An estimate and its bootstrap interval.

    :param value: the estimate
    :param low: lower end; the value itself where there is one seed only
    :param high: upper end
    """

    value: float
    low: float
    high: float


def score_of(row: Mapping[str, Any]) -> float:
    """Return how good a result is, from 0, where no episode succeeds, to 1.

    The planner's steps over the steps taken, where a failed episode counts as the cap; or, where there is no planner,
    the share of the cap that was not needed; or, where there is no cap either, the share of successful episodes.

    :param row: of a store
    """
    if not row["success_rate"]:
        return 0.0
    if row["optimal_steps_mean"]:
        return min(1.0, float(row["optimal_steps_mean"] / row["steps_mean"]))
    if row["cap"] is None:
        return float(row["success_rate"])
    return max(0.0, 1 - row["steps_mean"] / row["cap"])


def interquartile_mean(scores: Scores, seed: int = 0) -> Interval:
    """Return the mean of the middle half of all scores, tasks and seeds together.

    The interval is of a stratified bootstrap: seeds are drawn anew within each task.

    :param scores: of one method
    :param seed: of the bootstrap
    :raises ValueError: if there are no scores
    """
    tasks = [values for values in scores.values() if len(values)]
    if not tasks:
        raise ValueError("there are no scores to take the mean of")

    def middle(*drawn: NDArray[np.float64], axis: int = -1) -> Any:
        return stats.trim_mean(np.concatenate(drawn, axis=axis), 0.25, axis=axis)

    return _bootstrapped(middle, tasks, seed)


def mean_over_seeds(values: NDArray[np.float64], seed: int = 0) -> Interval:
    """Return the mean of values and its bootstrap interval.

    :param values: one for each seed
    :param seed: of the bootstrap
    """
    return _bootstrapped(lambda drawn, axis=-1: np.mean(drawn, axis=axis), [values], seed)


def _bootstrapped(statistic: Any, tasks: Sequence[NDArray[np.float64]], seed: int) -> Interval:
    value = float(statistic(*tasks))
    if any(len(values) < 2 for values in tasks) or all(np.ptp(values) == 0 for values in tasks):
        return Interval(value, value, value)
    interval = stats.bootstrap(
        tuple(tasks),
        statistic,
        n_resamples=N_RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        random_state=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(value, float(interval.low), float(interval.high))


def performance_profile(scores: Scores, thresholds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for each threshold the share of runs that score at least as much, every task counting alike.

    :param scores: of one method
    :param thresholds: ``(n,)``
    :return: ``(n,)``, 0 to 1
    """
    shares = [(values[:, None] >= thresholds).mean(axis=0) for values in scores.values() if len(values)]
    return np.mean(shares, axis=0)
