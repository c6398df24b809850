"""Starting positions: seeded ones that can be solved, apart, in reach and with a free way, and those of a user."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.panda.physics import ObjectKind, Table
from progpolicy_envs.panda.robot import BASE_POSITION, FARTHEST, NEAREST

Points = NDArray[np.float64]
#: Two or three coordinates, metres.
Place = Sequence[float]
#: Whether a start and a target, the first two arguments, fit those of the objects before, the last two.
Fits = Callable[[Place, Place, Sequence[Place], Sequence[Place]], bool]

#: Tells the same of many candidates: arrays ``(n, d)`` in, ``(n,)`` out.
Screen = Callable[[Points, Points, Sequence[Place], Sequence[Place]], NDArray[np.bool_]]

_BATCH = 64
_BATCHES = 8
#: With so many objects placed, most candidates do not fit and are screened from the first batch on.
_CROWDED = 4
#: Objects nearer than this to the middle of the robot's base would touch it, metres.
_BASE_RADIUS = 0.15


def sample_in_order(
    n_objects: int, propose: Callable[[int], tuple[Points, Points]], fits: Fits, screen: Screen | None = None
) -> tuple[Points, Points]:
    """Draw starts and targets one object after the other, each so that it fits those before it.

    Candidates are drawn in batches, but tried one by one until one fits: most fail a cheap test, for which numbers are
    faster than small arrays. If none of an object's first batch fits, all its other batches are screened together.
    If an object finds no place, everything is drawn again.

    :param n_objects: number of objects
    :param propose: given a number, returns as many candidate starts and targets, ``(number, d)`` each
    :param fits: whether a candidate fits
    :param screen: keeps few of many candidates, but all that fit; with it, more may be drawn than are used
    :return: starts and targets ``(n_objects, d)``
    """
    while True:
        propose(1)  # not used, but drawn so that every seed gives the positions that it has always given
        starts: list[Place] = []
        targets: list[Place] = []
        drawn: list[tuple[Points, Points]] = []
        for _ in range(n_objects):
            tried, found = 0, None
            while found is None and tried < _BATCHES:
                drawn = drawn or [propose(_BATCH)]
                if screen and tried:
                    drawn += [propose(_BATCH) for _ in range(_BATCHES - tried - len(drawn))]
                    ones, others = (np.concatenate(points) for points in zip(*drawn, strict=True))
                else:
                    ones, others = drawn[0]
                numbers: Iterable[int] = range(len(ones))
                if screen and (tried or len(starts) >= _CROWDED):
                    kept = screen(ones, others, starts, targets)
                    numbers, ones, others = kept.nonzero()[0].tolist(), ones[kept], others[kept]
                candidates = zip(numbers, ones.tolist(), others.tolist(), strict=True)
                found = next((some for some in candidates if fits(*some[1:], starts, targets)), None)
                used = (len(drawn) if screen and tried else 1) if found is None else 1 + found[0] // _BATCH
                # The next object goes on with the batch after the one that had the place.
                drawn, tried = drawn[used:], tried + used
            if found is None:
                break
            starts.append(found[1])
            targets.append(found[2])
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


def corridor_distances(starts: Points, ends: Points, others: Points) -> NDArray[np.float64]:
    """Return :func:`corridor_distance` of many; all are ``(..., 2)`` and broadcast."""
    ways, to_others = ends - starts, others - starts
    lengths = np.maximum((ways * ways).sum(axis=-1), 1e-12)
    shares = np.clip((to_others * ways).sum(axis=-1) / lengths, 0.0, 1.0)
    offsets = to_others - shares[..., None] * ways
    return np.hypot(offsets[..., 0], offsets[..., 1])


def extended(start: Place, target: Place, back: float) -> Place:
    """Return the point of the table that lies ``back`` metres behind the start, seen from the target."""
    x, y = target[0] - start[0], target[1] - start[1]
    share = back / max(math.hypot(x, y), 1e-9)
    return start[0] - share * x, start[1] - share * y


def reachable(place: Place, least: float = 0.26, most: float = 0.74) -> bool:
    """Return whether the gripper, pointing down, can work at this point of the table."""
    return least <= math.hypot(place[0] - BASE_POSITION[0], place[1] - BASE_POSITION[1]) <= most


def in_reach(place: Place) -> bool:
    """Return whether the gripper, pointing down, can come to this point of the table at all."""
    return NEAREST <= math.hypot(place[0] - BASE_POSITION[0], place[1] - BASE_POSITION[1]) <= FARTHEST


def all_apart(places: Points, others: Points, distance: float) -> NDArray[np.bool_]:
    """Return which of many places ``(n, 2)`` are farther than a distance from all others ``(m, 2)``, ``(n,)``."""
    ways = places[:, None] - others
    return np.asarray((np.hypot(ways[..., 0], ways[..., 1]) > distance).all(axis=1))


def all_extended(starts: Points, targets: Points, back: float) -> Points:
    """Return :func:`extended` of many, ``(..., 2)``."""
    ways = targets - starts
    lengths = np.maximum(np.hypot(ways[..., 0], ways[..., 1]), 1e-9)
    return np.asarray(starts - (back / lengths)[..., None] * ways)


def all_within(starts: Points, ends: Points, least: float, most: float) -> NDArray[np.bool_]:
    """Return which of many pairs are so far apart, ``(n,)``; places are ``(n, 2)`` or ``(2,)``."""
    ways = ends - starts
    distances = np.hypot(ways[:, 0], ways[:, 1])
    return (least < distances) & (distances < most)


def read_points(name: str, value: Any, heights: Points) -> Points:
    """Return places that a user gives, ``(n, 3)``.

    :param name: of what is given, for the error
    :param value: x and y of each, or x, y and z, metres
    :param heights: z of each, ``(n,)``; NaN where z has to be given and can be any
    :raises ValueError: if they are not of that form
    """
    free = np.isnan(heights)
    try:
        points = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.shape == (len(heights), 2) and not free.any():
        points = np.column_stack((points, heights))
    fits = points.shape == (len(heights), 3) and np.isfinite(points).all()
    if not fits or not (free | np.isclose(points[:, 2], heights, rtol=0, atol=1e-6)).all():
        form = "x, y and z" if free.any() else f"x and y, and z, if it is given, is {heights.tolist()}"
        raise ValueError(f"{name}={value!r} is not accepted; {name} are {len(heights)} places in metres, each {form}")
    return points


def check_on_table(name: str, points: Points, table: Table) -> None:
    """Raise ``ValueError`` if a place is not on the table, or where the robot stands."""
    for x, y, _ in points.tolist():
        if not (table.low_x <= x <= table.high_x and abs(y) <= table.width / 2):
            raise ValueError(
                f"{name}: ({x}, {y}) is not accepted; on the table x is from {table.low_x} to {table.high_x} and y "
                f"from {-table.width / 2} to {table.width / 2}"
            )
        if math.hypot(x - BASE_POSITION[0], y - BASE_POSITION[1]) < _BASE_RADIUS:
            raise ValueError(f"{name}: ({x}, {y}) is not accepted; the robot stands there")


def check_apart(name: str, points: Points, kind: ObjectKind) -> None:
    """Raise ``ValueError`` if objects at these places would overlap."""
    width, depth, _ = (2 * half for half in kind.half_extents)
    for index, (x, y, _) in enumerate(points.tolist()):
        for other, (other_x, other_y, _) in enumerate(points[:index].tolist()):
            way_x, way_y = abs(x - other_x), abs(y - other_y)
            if math.hypot(way_x, way_y) < width if kind.shape == "cylinder" else way_x < width and way_y < depth:
                raise ValueError(f"{name}: objects {other} and {index} overlap; they are {width} m wide")
