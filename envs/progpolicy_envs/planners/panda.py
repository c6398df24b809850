"""Scripted controllers for the Panda tasks: from one observation to one action, without memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Observation = NDArray[np.float32]
Action = NDArray[np.float32]

_STEP = 0.05  # metres per unit of action
_OPEN, _CLOSE = 1.0, -1.0
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
    return _action(*_View(observation).to_target, _CLOSE)


def push(observation: Observation) -> Action:
    """Go behind the block, down, and along the line to its target.

    :param observation: ``(32,)``
    :return: ``(4,)``
    """
    view = _View(observation)
    dx, dy, _ = view.to_object
    line_x, line_y = view.line
    back = 0.065
    ahead_x, ahead_y = dx - back * line_x, dy - back * line_y
    height = view.gripper[2]
    down = 0.02 - height
    if height < 0.05 and -0.12 < view.along < -0.02 and abs(view.across) < 0.025:
        speed = min(0.03, 0.01 + 0.3 * view.distance)
        side_x, side_y = dx + view.along * line_x, dy + view.along * line_y
        return _action(speed * line_x + 0.8 * side_x, speed * line_y + 0.8 * side_y, down, _CLOSE)
    if math.hypot(ahead_x, ahead_y) < 0.015:
        return _action(ahead_x, ahead_y, down, _CLOSE)
    if height < 0.07:
        return _action(0.0, 0.0, _STEP, _CLOSE)
    return _action(ahead_x, ahead_y, _CLEAR - height, _CLOSE)


def slide(observation: Observation) -> Action:
    """Take the puck between the half-open fingers from behind, accelerate it towards its target and let go.

    :param observation: ``(32,)``
    :return: ``(4,)``
    """
    view = _View(observation)
    dx, dy, _ = view.to_object
    line_x, line_y = view.line
    back = 0.06
    ahead_x, ahead_y = dx - back * line_x, dy - back * line_y
    height = view.gripper[2]
    down = 0.012 - height
    fingers = (0.04 - view.width) / 0.2
    moving = math.hypot(*view.object_velocity[:2]) > 0.05
    if height < 0.03 and -0.12 < view.along < 0.0 and abs(view.across) < 0.03:
        if view.gripper[0] > 0.1:
            return _action(0.0, 0.0, _STEP, fingers)
        side_x, side_y = dx + view.along * line_x, dy + view.along * line_y
        return _action(0.035 * line_x + 0.5 * side_x, 0.035 * line_y + 0.5 * side_y, down, fingers)
    if moving:
        return _action(0.0, 0.0, _CLEAR - height, fingers)
    if math.hypot(ahead_x, ahead_y) < 0.012:
        return _action(ahead_x, ahead_y, down, fingers)
    if height < 0.07:
        return _action(0.0, 0.0, _STEP, fingers)
    return _action(ahead_x, ahead_y, _CLEAR - height, fingers)


def stack(observation: Observation) -> Action:
    """Pick the block up, carry it over the tower, set it down and rise.

    :param observation: ``(32,)``
    :return: ``(4,)``
    """
    view = _View(observation)
    dx, dy, dz = view.to_object
    tx, ty, _ = view.to_target
    height, top = view.gripper[2], view.target[2]
    way_x, way_y = view.target[0] - view.object[0], view.target[1] - view.object[1]
    near_tower = math.hypot(tx, ty) < 0.13
    around = view.reach < 0.015 and abs(dz) < 0.015
    placed = view.distance < 0.012 and abs(view.object[2] - top) < 0.008
    if placed and math.hypot(dx, dy) < 0.04:
        rise = _STEP if view.width > 0.055 else 0.0
        return _action(0.0, 0.0, rise, _OPEN)
    if around and view.width < 0.045:
        if view.distance < 0.01:
            return _action(way_x, way_y, min(0.0, max(-0.02, top - view.object[2])), _CLOSE)
        free = top + 0.04
        if height < (free - 0.01 if near_tower else min(free, 0.08)):
            return _action(0.0, 0.0, free - height, _CLOSE)
        return _action(way_x, way_y, free - height, _CLOSE)
    if around:
        return _action(dx, dy, dz, _CLOSE)
    if view.reach < 0.012:
        return _action(dx, dy, dz, _OPEN)
    if near_tower and height < top + 0.02:
        return _action(0.0, 0.0, _STEP, _OPEN)
    if height < 0.07:
        return _action(0.0, 0.0, _STEP, _OPEN)
    return _action(dx, dy, _CLEAR - height, _OPEN)


#: The controller of each environment id.
CONTROLLERS: Mapping[str, Callable[[Observation], Action]] = MappingProxyType(
    {"PandaReach-v0": reach, "PandaPush-v0": push, "PandaSlide-v0": slide, "PandaStack-v0": stack}
)
