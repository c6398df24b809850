"""The fewest terms that choose the right actions: a mixed-integer linear program, solved by HiGHS through SciPy."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Whole weights are at most this large.
MAX_WEIGHT = 8
#: By how much the right action is to win, where weights are whole numbers.
MARGIN = 0.25
_FIRST_ROWS, _ADDED_ROWS = 400, 200


@dataclass(frozen=True)
class Solution:
    """A rule with few terms.

    :param weights: ``(n_terms,)``, whole numbers
    :param lower_bound: on the number of terms of any rule of this form that does the same
    """

    weights: Floats
    lower_bound: int

    @property
    def n_terms(self) -> int:
        """How many weights are not zero."""
        return int(np.count_nonzero(self.weights))


def fewest_terms(
    rows: Floats, time_limit: float, margin: float = MARGIN, max_weight: int = MAX_WEIGHT
) -> Solution | None:
    """Return whole numbers ``w`` with ``rows @ w >= margin`` of which the fewest are not zero, the smallest of these.

    The rows that matter are few: those violated are added until none is.

    :param rows: ``(n, n_terms)``
    :param time_limit: seconds
    :param margin: above 0
    :param max_weight: largest size of a weight
    :return: ``None`` if there are none, or none were found in time
    """
    rows = np.unique(np.round(rows, 12), axis=0)
    end = time.monotonic() + time_limit
    order = np.random.default_rng(0).permutation(len(rows))
    taken = np.zeros(len(rows), dtype=bool)
    taken[order[:_FIRST_ROWS]] = True
    while True:
        solution = _solve(rows[taken], max(1.0, end - time.monotonic()), margin, max_weight)
        if solution is None:
            return None
        short = np.flatnonzero(rows @ solution.weights < margin - 1e-9)
        if not len(short):
            return solution
        if time.monotonic() > end:
            return None
        worst = short[np.argsort(rows[short] @ solution.weights, kind="stable")]
        taken[worst[: _ADDED_ROWS // 2]] = True
        taken[np.random.default_rng(len(short)).permutation(short)[: _ADDED_ROWS // 2]] = True


def _solve(rows: Floats, time_limit: float, margin: float, max_weight: int) -> Solution | None:
    from scipy.optimize import Bounds, LinearConstraint, milp

    n = rows.shape[1]
    # Variables: the weights, their sizes, and whether they are not zero. A term costs more than all sizes together.
    small = 1 / (n * max_weight + 1)
    cost = np.concatenate([np.zeros(n), np.full(n, small), np.ones(n)])
    eye, zero = np.eye(n), np.zeros((n, n))
    constraints = [
        LinearConstraint(np.hstack([rows, np.zeros((len(rows), 2 * n))]), margin, np.inf),
        LinearConstraint(np.hstack([-eye, eye, zero]), 0, np.inf),
        LinearConstraint(np.hstack([eye, eye, zero]), 0, np.inf),
        LinearConstraint(np.hstack([zero, -eye, max_weight * eye]), 0, np.inf),
    ]
    bounds = Bounds(
        np.concatenate([np.full(n, -max_weight), np.zeros(2 * n)]),
        np.concatenate([np.full(n, max_weight), np.full(n, max_weight), np.ones(n)]),
    )
    integrality = np.concatenate([np.ones(n), np.zeros(n), np.ones(n)])
    found = milp(
        cost,
        constraints=constraints,
        bounds=bounds,
        integrality=integrality,
        options={"time_limit": time_limit, "mip_rel_gap": 0.0},
    )
    if found.x is None:
        return None
    weights = np.round(found.x[:n])
    bound = found.mip_dual_bound if found.mip_dual_bound is not None else 0.0
    # All sizes together count less than one term, so what is left above a whole number is theirs.
    return Solution(weights, max(0, math.ceil(bound - 1 + small / 2)))
