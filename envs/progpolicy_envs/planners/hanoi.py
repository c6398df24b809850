"""Shortest solutions of the Tower of Hanoi from any legal state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

Move = tuple[int, int]


def plan(discs: Sequence[int], target: int) -> Iterator[Move]:
    """Yield the moves of the one shortest solution.

    Towards a state with all discs on one peg the largest misplaced disc moves exactly once, straight to the target,
    after all smaller ones have been gathered on the third peg (Hinz, Klavžar and Petr, *The Tower of Hanoi: Myths
    and Maths*, theorem 2.7).

    :param discs: for each disc, the smallest first, the peg (0 to 2) on which it lies; any such list is a legal state
    :param target: the peg (0 to 2) to which all discs go
    :return: pairs (peg from, peg to), as many as :func:`optimal_steps` says
    """
    misplaced = len(discs)
    while misplaced and discs[misplaced - 1] == target:
        misplaced -= 1
    if not misplaced:
        return
    disc = misplaced - 1
    spare = 3 - discs[disc] - target
    yield from plan(discs[:disc], spare)
    yield discs[disc], target
    yield from plan([spare] * disc, target)


def optimal_steps(discs: Sequence[int], target: int) -> int:
    """Return the length of the shortest solution; ``2**n - 1`` for a whole tower of ``n`` discs.

    :param discs: as in :func:`plan`
    :param target: as in :func:`plan`
    """
    steps = 0
    for disc in reversed(range(len(discs))):
        if discs[disc] != target:
            steps += 2**disc
            target = 3 - discs[disc] - target
    return steps
