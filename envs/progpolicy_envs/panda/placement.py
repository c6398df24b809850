"""Seeded starting positions that can be solved: apart from each other, in reach, with a free way to the target."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.panda.robot import BASE_POSITION

Points = NDArray[np.float64]
#: Two or three coordinates, metres.
Place = Sequence[float]
#: Tells of a start and a target whether they fit those of the objects before, which are given after them.
Fits = Callable[[Place, Place, Sequence[Place], Sequence[Place]], bool]

_BATCH = 64
_BATCHES = 8


def sample_in_order(
    n_objects: int, propose: Callable[[int], tuple[Points, Points]], fits: Fits
) -> tuple[Points, Points]:
    """Draw starts and targets one object after the other, each so that it fits those before it.

    Candidates are drawn by the batch, but tried one by one up to the first that fits: most fail a cheap test at once,
    which takes less time with plain numbers than with small arrays. Where an object finds no place, all begin anew.

    :param n_objects: number of objects
    :param propose: given a number, returns as many candidate starts and targets, ``(number, d)`` each
    :param fits: whether a candidate fits
    :return: starts and targets ``(n_objects, d)``
    """
    while True:
        propose(1)  # not used; without it the positions that belong to a seed would be others than they have been
        starts: list[Place] = []
        targets: list[Place] = []
        while len(starts) < n_objects:
            for _ in range(_BATCHES):
                candidates = zip(*(points.tolist() for points in propose(_BATCH)), strict=True)
                found = next(((one, other) for one, other in candidates if fits(one, other, starts, targets)), None)
                if found:
                    starts.append(found[0])
                    targets.append(found[1])
                    break
            else:
                break
        else:
            return np.array(starts), np.array(targets)


def apart(place: Place, others: Sequence[Place], distance: float) -> bool:
    """Return whether a place is farther than a distance from all others."""
    for other in others:  # noqa: SIM110 - a generator costs more, and this is most of the work
        if math.dist(place, other) <= distance:
            return False
    return True


def corridor_distance(start: Place, end: Place, other: Place) -> float:
    """Return the distance of a straight way on the table from a point on it.

    :param start: x and y
    :param end: x and y
    :param other: x and y
    """
    x, y = end[0] - start[0], end[1] - start[1]
    to_x, to_y = other[0] - start[0], other[1] - start[1]
    share = min(1.0, max(0.0, (to_x * x + to_y * y) / max(x * x + y * y, 1e-12)))
    return math.hypot(to_x - share * x, to_y - share * y)


def extended(start: Place, target: Place, back: float) -> Place:
    """Return the point of the table that lies ``back`` metres behind the start, seen from the target."""
    x, y = target[0] - start[0], target[1] - start[1]
    share = back / max(math.hypot(x, y), 1e-9)
    return start[0] - share * x, start[1] - share * y


def reachable(place: Place, least: float = 0.26, most: float = 0.74) -> bool:
    """Return whether the gripper, pointing down, can work at this point of the table."""
    return least <= math.hypot(place[0] - BASE_POSITION[0], place[1] - BASE_POSITION[1]) <= most
