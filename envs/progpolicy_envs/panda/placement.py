"""Seeded starting positions that can be solved: apart from each other, in reach, with a free way to the target."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.panda.robot import BASE_POSITION

Points = NDArray[np.float64]
Candidates = tuple[Points, Points]

_BATCH = 64
_BATCHES = 8


def sample_in_order(
    n_objects: int,
    propose: Callable[[int], Candidates],
    accept: Callable[[Points, Points, Points, Points], NDArray[np.bool_]],
) -> Candidates:
    """Draw starts and targets one object after the other, each so that it fits those before it.

    Where an object finds no place, all begin anew.

    :param n_objects: number of objects
    :param propose: given a number, returns as many candidate starts and targets, ``(number, d)`` each
    :param accept: given candidate starts and targets and the starts and targets of the objects before, which fit
    :return: starts and targets ``(n_objects, d)``
    """
    while True:
        starts, targets = (points[:0] for points in propose(1))
        for _ in range(n_objects):
            for _ in range(_BATCHES):
                candidates = propose(_BATCH)
                fitting = np.flatnonzero(accept(*candidates, starts, targets))
                if len(fitting):
                    starts, targets = (
                        np.concatenate((points, new[fitting[:1]]))
                        for points, new in zip((starts, targets), candidates, strict=True)
                    )
                    break
            else:
                break
        if len(starts) == n_objects:
            return starts, targets


def distances(candidates: Points, others: Points) -> NDArray[np.float64]:
    """Return the distance of each candidate from the nearest of the others, ``(n,)``; infinite without others."""
    if not len(others):
        return np.full(len(candidates), np.inf)
    offsets = candidates[:, None] - others[None]
    return np.sqrt((offsets * offsets).sum(axis=-1)).min(axis=1)


def corridor_distances(starts: Points, ends: Points, others: Points) -> NDArray[np.float64]:
    """Return the distance of every straight way from every other point.

    :param starts: ``(n, 2)``
    :param ends: ``(n, 2)``
    :param others: ``(m, 2)``
    :return: ``(n, m)``
    """
    ways = ends - starts
    offsets = others[None] - starts[:, None]
    lengths = np.maximum((ways**2).sum(axis=-1), 1e-12)
    share = np.clip((offsets * ways[:, None]).sum(axis=-1) / lengths[:, None], 0, 1)
    aside = offsets - share[..., None] * ways[:, None]
    return np.sqrt((aside * aside).sum(axis=-1))


def extended(starts: Points, targets: Points, back: float) -> Points:
    """Return the points ``back`` metres behind the starts, seen from the targets, ``(n, 2)``."""
    ways = targets - starts
    return starts - back * ways / np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-9)


def reachable(points: Points, least: float = 0.26, most: float = 0.74) -> NDArray[np.bool_]:
    """Return whether the gripper, pointing down, can work at these points of the table, ``(n,)``."""
    radius = np.hypot(points[:, 0] - BASE_POSITION[0], points[:, 1] - BASE_POSITION[1])
    return (radius >= least) & (radius <= most)
