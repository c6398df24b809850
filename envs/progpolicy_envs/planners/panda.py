"""Scripted controllers for the Panda tasks: from one observation to one action, without memory."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Observation = NDArray[np.float32]
Action = NDArray[np.float32]

_STEP = 0.05  # metres per unit of action
_OPEN, _CLOSE = 1.0, -1.0
_EMPTY = 0.03  # width between the fingers, metres, with which there is no block between them
_CLEAR = 0.1  # height at which the gripper passes over everything that lies on the table


class _View:
    """The numbers of an observation by name, as the controllers need them."""

    def __init__(self, observation: Observation) -> None:
        numbers = [float(number) for number in observation]
        self.gripper = numbers[0:3]
        self.width = numbers[6]
        self.to_object = numbers[7:10]
        self.to_target = numbers[10:13]
        self.distance = numbers[13]
        self.line = numbers[14:16]
        self.along, self.across = numbers[16:18]
        self.object_velocity = numbers[18:21]
        self.reach = numbers[24]
        self.object = numbers[26:29]
        self.target = numbers[29:32]


def _action(x: float, y: float, z: float, fingers: float) -> Action:
    """Return an action for a displacement in metres; too long a way keeps its direction."""
    longest = max(abs(x), abs(y), abs(z), _STEP)
    return np.array([x / longest, y / longest, z / longest, fingers], dtype=np.float32)


def reach(observation: Observation) -> Action:
    """Go straight to the target.

    :param observation: ``(32,)``
    :return: ``(4,)``
    """
    x, y, z = _View(observation).to_target
    return _action(x, y, z, _CLOSE)


def push(observation: Observation) -> Action:
    """Take the block between the fingers and push it over the table in a straight line.

    Between the fingers because a cube that is pushed across a corner turns and slips away.

    :param observation: ``(32,)``
    :return: ``(4,)``
    """
    view = _View(observation)
    if _holds(view):
        speed = min(0.04, 0.01 + 0.3 * view.distance)
        return _action(speed * view.line[0], speed * view.line[1], 0.02 - view.gripper[2], _CLOSE)
    if view.reach > 0.03 and view.gripper[2] < 0.07:
        return _leave(view)
    return _approach(view, _CLEAR)


def slide(observation: Observation) -> Action:
    """Take the puck between the half-open fingers from behind, make it faster and faster along the line, and stop.

    The two fingers keep the puck in their middle, so that it leaves in the direction in which the gripper goes. A hard
    push would make it jump out of the fingers before it has taken that direction.

    :param observation: ``(32,)``
    :return: ``(4,)``
    """
    view = _View(observation)
    dx, dy, _ = view.to_object
    height = view.gripper[2]
    down = 0.012 - height
    fingers = (0.04 - view.width) / 0.2
    outside = math.hypot(view.gripper[0] + 0.6, view.gripper[1]) > 0.69
    speed = math.hypot(*view.object_velocity[:2])
    moving = speed > 0.05
    if height < 0.03 and 0.0 < dx < 0.08 and abs(dy) < 0.03 and not outside:
        if not moving:
            return _action(0.015, dy, down, fingers)
        forward = min(_STEP, 0.02 + 0.0375 * speed)
        return _action(forward * view.line[0], forward * view.line[1] + 0.4 * dy, down, fingers)
    if moving or (outside and height < 0.07):
        return _action(0.0, 0.0, _CLEAR - height, fingers)
    if abs(dx - 0.06) < 0.012 and abs(dy) < 0.008:
        return _action(dx - 0.06, dy, down, fingers)
    if height < 0.07:
        return _action(0.0, 0.0, _STEP, fingers)
    return _action(dx - 0.06, dy, _CLEAR - height, fingers)


def stack(observation: Observation) -> Action:
    """Pick the block up, carry it over the tower, set it down and rise.

    :param observation: ``(32,)``
    :return: ``(4,)``
    """
    view = _View(observation)
    height, top = view.gripper[2], view.target[2]
    way_x, way_y = view.target[0] - view.object[0], view.target[1] - view.object[1]
    # The hand is 20 cm wide along y and must not meet the tower either.
    near_tower = abs(view.to_target[0]) < 0.1 and abs(view.to_target[1]) < 0.18
    placed = view.distance < 0.012 and abs(view.object[2] - top) < 0.004
    if placed and view.reach < 0.04:
        return _leave(view)
    if _holds(view):
        if view.distance < 0.01:
            return _action(way_x, way_y, min(0.0, max(-0.025, top - view.object[2])), _CLOSE)
        free = max(top + 0.04, _CLEAR)
        if height < (free - 0.01 if near_tower else 0.09):
            return _action(0.0, 0.0, free + 0.02 - height, _CLOSE)
        return _action(way_x, way_y, free + 0.01 - height, _CLOSE)
    clear = max(top + 0.04, _CLEAR) if near_tower else _CLEAR
    if view.reach > 0.03 and height < (top + 0.01 if near_tower else 0.07):
        return _leave(view)
    return _approach(view, clear)


def _holds(view: _View) -> bool:
    """Return whether the block is between the closed fingers."""
    return view.reach < 0.018 and abs(view.to_object[2]) < 0.018 and view.width < 0.058


def _leave(view: _View) -> Action:
    """Open the fingers, then rise, slowly as long as the object is between them: a jerk would drag it along.

    Fingers with nothing between them stay closed: opening, they would hit what lies beside the hand.
    """
    if view.width < _EMPTY:
        return _action(0.0, 0.0, _STEP, _CLOSE)
    around = view.reach < 0.03 and abs(view.to_object[2]) < 0.03
    return _action(0.0, 0.0, (0.02 if around else _STEP) if view.width > 0.06 else 0.0, _OPEN)


def _approach(view: _View, clear: float) -> Action:
    """Go over the object at height ``clear``, then down with open fingers, then close them."""
    dx, dy, dz = view.to_object
    if view.reach < 0.012 and abs(dz) < 0.012:
        return _action(dx, dy, dz, _CLOSE)
    if view.reach < 0.012 or (view.reach < 0.02 and abs(dz) < 0.05):
        return _action(dx, dy, dz, _OPEN)
    return _action(dx, dy, clear - view.gripper[2], _OPEN)
