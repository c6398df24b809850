"""The reward as a difference of potentials: how far a state is from the end, so that no way back and forth pays.

Potential-based shaping, with which the best behaviour stays the best, is due to Ng, Harada and Russell (Policy
invariance under reward transformations, ICML 1999). Here the discount of their equation is 1, so that what an episode
pays in all depends on its first state, its last state and its length alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from progpolicy_envs.panda.physics import Point

#: What the way to an object that is not yet in focus counts as, at most that of one in focus, metres.
FULL_WAY = 0.6
#: Height above the object at which the gripper flies to it, metres, and by how much less it flies per metre nearer.
FLIGHT, CONE = 0.08, 0.8
#: Height above an object at which the gripper is clear of it, metres.
CLEAR = 0.05
#: What a metre of height counts that the gripper is too high, and that it is too low.
DESCENT, RISE = 0.5, 1.5
#: The gripper has left a finished object at this height above it, or at this horizontal distance, metres; it has not at
#: all at the heights and distances that come second.
LEFT_HEIGHT, LEFT_DISTANCE = (0.06, 0.02), (0.12, 0.06)
#: With so short a way left to the next object the gripper need not leave the finished one; with the second, it has to.
NEXT_WAY = (0.05, 0.15)


def share(value: float, none: float, all_: float) -> float:
    """Return where a value is between two others, 0 at the first and before, 1 at the second and beyond."""
    return min(1.0, max(0.0, (value - none) / (all_ - none)))


def way_behind(gripper: Point, position: Point, target: Point, far: float, near: float) -> float:
    """Return the length of the gripper's way to where it pushes an object from: behind it, seen from its target.

    It is there between ``far`` and ``near`` behind the object's centre, in contact or not, at the centre's height. The
    way leads through the air, down along a cone, and never through the object: above it the gripper is too low unless
    it is clear of it. Everywhere else some step down, back or up makes it shorter, so that no place but the end is one
    to rest at.

    :param gripper: metres, as all here
    :param position: of the object
    :param target: of the object
    :param far: largest distance behind its centre
    :param near: smallest distance behind its centre, in contact
    """
    line_x, line_y = target[0] - position[0], target[1] - position[1]
    length = max(math.hypot(line_x, line_y), 1e-9)
    x, y = gripper[0] - position[0], gripper[1] - position[1]
    along, across = (x * line_x + y * line_y) / length, abs(x * line_y - y * line_x) / length
    distance = math.hypot(max(0.0, along + near, -far - along), across)
    # Over the object as seen along the line and across it; it begins where the object itself would be in the way.
    over = share(along, -near, -near + 0.01) * share(along, near + 0.01, near) * share(across, near + 0.01, near)
    return _way(distance, gripper[2] - position[2], max(min(FLIGHT, CONE * distance), CLEAR * over))


def way_onto(gripper: Point, width: float, position: Point, full_width: float) -> float:
    """Return the length of the gripper's way to where it grasps an object: around it, down through the air, open.

    :param gripper: metres, as all here
    :param width: between the fingers; while the gripper is above the object it counts how far they are from open
    :param position: of the object
    :param full_width: of open fingers
    """
    distance = math.hypot(gripper[0] - position[0], gripper[1] - position[1])
    height = gripper[2] - position[2]
    closed = (full_width - width) * share(height, 0.01, 0.03)
    return _way(distance, height, min(FLIGHT, 2 * distance)) + closed


def _way(distance: float, height: float, wanted: float) -> float:
    return distance + DESCENT * max(0.0, height) + RISE * max(0.0, wanted - height)


def way_after(way: float, gripper: Point, finished: Sequence[Point]) -> float:
    """Return the length of the gripper's way to an object, with leaving the finished ones before it.

    :param way: to the object alone, metres
    :param gripper: metres
    :param finished: positions of finished objects
    """
    way = min(FULL_WAY, way)
    return way + (FULL_WAY - way) * not_left(gripper, finished) * share(way, *NEXT_WAY)


def not_left(gripper: Point, finished: Sequence[Point]) -> float:
    """Return how little the gripper has left finished objects, 0 where it is clear of all to 1 where it touches one.

    :param gripper: metres
    :param finished: their positions
    """
    most = 0.0
    for x, y, z in finished:
        height = gripper[2] - z
        if height < LEFT_HEIGHT[0]:
            near = share(math.hypot(gripper[0] - x, gripper[1] - y), *LEFT_DISTANCE)
            most = max(most, near * share(height, *LEFT_HEIGHT))
    return most
