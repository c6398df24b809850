"""The focus observation: the robot and one object with its target in 32 numbers, at any number of objects."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.panda.physics import MAX_OBJECTS, ObjectState, Point
from progpolicy_envs.panda.robot import PandaRobot

FEATURE_NAMES = (
    *("gripper_x", "gripper_y", "gripper_z"),
    *("gripper_vx", "gripper_vy", "gripper_vz"),
    "fingers",
    *("object_dx", "object_dy", "object_dz"),
    *("target_dx", "target_dy", "target_dz"),
    "distance",
    *("line_x", "line_y"),
    *("along", "across"),
    *("object_vx", "object_vy", "object_vz"),
    *("turn_cos", "turn_sin"),
    "spin",
    "reach",
    "left",
)
ACHIEVED_NAMES = ("object_x", "object_y", "object_z")
DESIRED_NAMES = ("target_x", "target_y", "target_z")
OBSERVATION_NAMES = (*FEATURE_NAMES, *ACHIEVED_NAMES, *DESIRED_NAMES)
ACTION_NAMES = ("move_x", "move_y", "move_z", "open")
#: No number of an observation is beyond this; metres, metres per second or radians per second.
BOUND = 10.0


def focus_observation(robot: PandaRobot, state: ObjectState, target: Point, n_left: int) -> NDArray[np.float32]:
    """Return the 32 numbers of the observation, in the order of :data:`OBSERVATION_NAMES`.

    :param robot: the robot
    :param state: the object in focus
    :param target: its target, metres
    :param n_left: how many objects are unfinished
    """
    gx, gy, gz = robot.position
    x, y, z = state.position
    tx, ty, tz = target
    line_x, line_y = tx - x, ty - y
    distance = math.hypot(line_x, line_y)
    if distance > 1e-9:
        line_x, line_y = line_x / distance, line_y / distance
    dx, dy = x - gx, y - gy
    qx, qy, qz, qw = state.orientation
    yaw = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    features = (
        *(gx, gy, gz),
        *robot.velocity,
        robot.width,
        *(dx, dy, z - gz),
        *(tx - gx, ty - gy, tz - gz),
        distance,
        *(line_x, line_y),
        -(dx * line_x + dy * line_y),
        dx * line_y - dy * line_x,
        *state.velocity,
        *(math.cos(4 * yaw), math.sin(4 * yaw)),
        state.spin[2],
        math.hypot(dx, dy),
        n_left / MAX_OBJECTS,
        *(x, y, z),
        *(tx, ty, tz),
    )
    if math.hypot(*features) > BOUND:  # one call; no number is larger than the length of all together
        features = tuple(max(-BOUND, min(BOUND, number)) for number in features)
    return np.array(features, dtype=np.float32)
