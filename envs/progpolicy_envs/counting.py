"""Choices by number: which arrangement or subset comes at a place of the list of all of them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]


def arrangements(numbers: Integers, n_things: int, length: int) -> Integers:
    """Return arrangements of ``length`` different things out of ``n_things``, by number.

    :param numbers: ``(n,)``, each from 0 to ``math.perm(n_things, length) - 1``
    :return: ``(n, length)``, things from 0
    """
    left = np.broadcast_to(np.arange(n_things), (len(numbers), n_things)).copy()
    chosen = np.empty((len(numbers), length), dtype=np.int64)
    rest, rows = numbers.copy(), np.arange(len(numbers))
    for place in range(length):
        rest, index = np.divmod(rest, n_things - place)
        chosen[:, place] = left[rows, index]
        left[rows, index] = left[:, n_things - place - 1]  # the last one takes its place
    return chosen


def subsets(numbers: Integers, n_things: int, size: int) -> Integers:
    """Return subsets of a size, by number (the combinatorial number system).

    :param numbers: ``(n,)``, each from 0 to ``math.comb(n_things, size) - 1``
    :return: ``(n, size)``, things from 0, the largest first
    """
    chosen = np.empty((len(numbers), size), dtype=np.int64)
    rest = numbers.copy()
    for place, k in enumerate(range(size, 0, -1)):
        counts = np.array([math.comb(thing, k) for thing in range(n_things)])
        chosen[:, place] = np.searchsorted(counts, rest, side="right") - 1
        rest -= counts[chosen[:, place]]
    return chosen
