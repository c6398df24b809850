"""Shortest solutions of Stacking-v0: the order is forced, so each plate is fetched by a shortest way."""

from __future__ import annotations

from collections.abc import Sequence

from progpolicy_envs.layouts import DIRECTIONS

Cell = tuple[int, int]
PICK = len(DIRECTIONS)
_NORTH, _EAST, _SOUTH, _WEST = range(len(DIRECTIONS))


def plan(gripper: Cell, plates: Sequence[Cell]) -> list[int]:
    """Return a shortest sequence of actions that picks up every plate.

    Only the largest plate on the table can be picked up, and picking leaves the gripper where it is. So the least
    number of steps is the sum of the distances from plate to plate, plus one pick for each.

    :param gripper: row and column of the gripper
    :param plates: rows and columns of the plates on the table, the largest first
    :return: actions, 0 north, 1 east, 2 south, 3 west, 4 pick
    """
    actions: list[int] = []
    for plate in plates:
        down, right = plate[0] - gripper[0], plate[1] - gripper[1]
        actions += [_SOUTH if down > 0 else _NORTH] * abs(down)
        actions += [_EAST if right > 0 else _WEST] * abs(right)
        actions.append(PICK)
        gripper = plate
    return actions


def optimal_steps(gripper: Cell, plates: Sequence[Cell]) -> int:
    """Return the length of a shortest solution.

    :param gripper: as in :func:`plan`
    :param plates: as in :func:`plan`
    """
    return len(plan(gripper, plates))
