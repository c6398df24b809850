"""Shortest tours over the stars of a map: breadth-first distances and the dynamic program of Held and Karp (1962)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.layouts import NEIGHBOURS, Layout

_FAR = 10_000  # longer than any tour, and twice that still fits into 16 bits
_BATCH_BYTES = 2**26


def plan(layout: Layout, hiker: int, stars: Sequence[int]) -> list[int]:
    """Return the actions of a shortest tour that starts at the hiker and visits every star.

    :param layout: the map
    :param hiker: the hiker's cell
    :param stars: the cells of the stars that are left, at most 12
    :return: directions, 0 north, 1 east, 2 south, 3 west
    """
    actions: list[int] = []
    for star in _order(layout, hiker, stars):
        to_star = layout.distances[:, star]
        while hiker != star:
            closer = to_star[NEIGHBOURS[hiker]] == to_star[hiker] - 1
            actions.append(int(np.flatnonzero(closer)[0]))
            hiker = int(NEIGHBOURS[hiker, actions[-1]])
    return actions


def optimal_steps(layout: Layout, hiker: int, stars: Sequence[int]) -> int:
    """Return the length of a shortest tour.

    :param layout: as in :func:`plan`
    :param hiker: as in :func:`plan`
    :param stars: as in :func:`plan`
    """
    return int(tour_lengths(tour_distances(layout, hiker, stars)[None])[0])


def tour_distances(layout: Layout, hiker: int, stars: Sequence[int]) -> NDArray[np.int16]:
    """Return the distances between the places of a tour, ``(1 + n_stars, 1 + n_stars)``, the hiker first."""
    places = np.array([hiker, *stars], dtype=np.intp)
    return layout.distances[np.ix_(places, places)].astype(np.int16)


def tour_lengths(distances: NDArray[np.int16]) -> NDArray[np.int64]:
    """Return the lengths of many shortest tours over equally many places.

    :param distances: ``(n_tours, 1 + n_stars, 1 + n_stars)``, as :func:`tour_distances` gives
    :return: ``(n_tours,)``
    """
    n_tours, n_stars = distances.shape[0], distances.shape[1] - 1
    if not n_stars:
        return np.zeros(n_tours, dtype=np.int64)
    at_once = max(1, _BATCH_BYTES // (n_stars * n_stars * 2 ** (n_stars + 1)))
    parts = [distances[first : first + at_once] for first in range(0, n_tours, at_once)]
    return np.concatenate([_shortest(part)[:, -1].min(axis=1) for part in parts]).astype(np.int64)


def _order(layout: Layout, hiker: int, stars: Sequence[int]) -> list[int]:
    """Return the stars in the order of a shortest tour, read backwards out of the table of shortest tours."""
    if not len(stars):
        return []
    distances = tour_distances(layout, hiker, stars)
    shortest = _shortest(distances[None])[0]
    visited = len(shortest) - 1
    order = [int(shortest[visited].argmin())]
    while (visited := visited & ~(1 << order[-1])) > 0:
        order.append(int((shortest[visited] + distances[1:, 1 + order[-1]]).argmin()))
    return [int(stars[star]) for star in reversed(order)]


def _shortest(distances: NDArray[np.int16]) -> NDArray[np.int16]:
    """Return the shortest tours over every set of stars that end at each of its members.

    :return: ``(n_tours, 2**n_stars, n_stars)``: the set as bits, then the last star; far where it is not in the set
    """
    n_tours, n_stars = distances.shape[0], distances.shape[1] - 1
    sets = np.arange(2**n_stars)
    members = (sets[:, None] >> np.arange(n_stars)) & 1
    sizes = members.sum(axis=1)
    shortest = np.full((n_tours, 2**n_stars, n_stars), _FAR, dtype=np.int16)
    star = np.arange(n_stars)
    shortest[:, 1 << star, star] = distances[:, 0, 1:]
    for size in range(1, n_stars):
        sources = sets[sizes == size]
        onwards = (shortest[:, sources, :, None] + distances[:, None, 1:, 1:]).min(axis=2)
        row, added = np.nonzero(members[sources] == 0)
        shortest[:, sources[row] | (1 << added), added] = onwards[:, row, added]
    return shortest
