"""What a domain declares of its numbers: symmetries of its rules, and blocks that lie on a grid."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Permutation:
    """A signed permutation of numbers: number ``i`` of the result is ``signs[i] * numbers[source[i]]``.

    :param source: for each number of the result, where it comes from
    :param signs: 1 or -1 for each number of the result
    :raises ValueError: if it is none
    """

    source: tuple[int, ...]
    signs: tuple[int, ...]

    def __post_init__(self) -> None:
        if sorted(self.source) != list(range(len(self.source))):
            raise ValueError(f"source={self.source} is not accepted; each of its indices comes once")
        if len(self.signs) != len(self.source) or not set(self.signs) <= {1, -1}:
            raise ValueError(f"signs={self.signs} are not accepted; they are {len(self.source)} times 1 or -1")

    @classmethod
    def of(cls, source: Iterable[int], signs: Iterable[int] | None = None) -> Permutation:
        """Return a permutation, by default without changes of sign."""
        source = tuple(int(index) for index in source)
        return cls(source, (1,) * len(source) if signs is None else tuple(int(sign) for sign in signs))

    @classmethod
    def flips(cls, names: Sequence[str], flipped: Iterable[str]) -> Permutation:
        """Return the change of sign of the numbers with certain names."""
        flipped = set(flipped)
        return cls.of(range(len(names)), (-1 if name in flipped else 1 for name in names))

    def __call__(self, numbers: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the permuted numbers, ``(..., n)`` as given."""
        return numbers[..., list(self.source)] * np.array(self.signs, dtype=numbers.dtype)

    def after(self, first: Permutation) -> Permutation:
        """Return the permutation that makes ``first`` and then this one."""
        source = tuple(first.source[index] for index in self.source)
        signs = tuple(sign * first.signs[index] for sign, index in zip(self.signs, self.source, strict=True))
        return Permutation(source, signs)


@dataclass(frozen=True)
class Symmetry:
    """A change of view under which a domain's rules stay the same.

    Where action ``a`` leads from a state that is seen as ``x`` to one seen as ``y``, the twin of ``a`` leads from the
    state seen as ``observation(x)`` to the one seen as ``observation(y)``, for the same reward. The twin of a Discrete
    action is the ``j`` with ``action.source[j] == a``; that of a Box action is ``action(a)``.

    Compare MDP homomorphic networks (van der Pol et al., 2020).

    :param name: in a word or two, such as ``pegs``
    :param observation: of the numbers of an observation
    :param action: of the actions (Discrete) or the numbers of an action (Box)
    """

    name: str
    observation: Permutation
    action: Permutation

    def after(self, first: Symmetry) -> Symmetry:
        """Return the symmetry that makes ``first`` and then this one."""
        return Symmetry(self.name, self.observation.after(first.observation), self.action.after(first.action))


def group_of(generators: Sequence[Symmetry]) -> tuple[Symmetry, ...]:
    """Return all symmetries that follow from some by applying one after the other, the identity first.

    :param generators: symmetries of one domain
    """
    if not generators:
        return ()
    first = generators[0]
    identity = Symmetry(
        first.name,
        Permutation.of(range(len(first.observation.source))),
        Permutation.of(range(len(first.action.source))),
    )
    found = {(identity.observation, identity.action): identity}
    new = [identity]
    while new:
        made = [generator.after(known) for known in new for generator in generators]
        new = [one for one in made if (one.observation, one.action) not in found]
        found |= {(one.observation, one.action): one for one in new}
    return tuple(found.values())


@dataclass(frozen=True)
class Grid:
    """A block of an observation that lies on a grid.

    :param name: such as ``table``
    :param start: index of its first number; the others follow
    :param rows: for each number its row, counted from the middle of the grid
    :param columns: for each number its column, counted from the middle of the grid
    :raises ValueError: if there are not as many rows as columns
    """

    name: str
    start: int
    rows: tuple[float, ...]
    columns: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.rows) != len(self.columns):
            raise ValueError(f"{len(self.rows)} rows and {len(self.columns)} columns are not accepted; as many of both")

    @classmethod
    def whole(cls, name: str, start: int, n_rows: int, n_columns: int) -> Grid:
        """Return a grid without gaps, row after row."""
        places = [divmod(cell, n_columns) for cell in range(n_rows * n_columns)]
        rows = tuple(row - (n_rows - 1) / 2 for row, _ in places)
        columns = tuple(column - (n_columns - 1) / 2 for _, column in places)
        return cls(name, start, rows, columns)
