"""The Franka Panda: end-effector displacement and finger width in, gripper state out."""

from __future__ import annotations

import math
from collections.abc import Sequence

from progpolicy_envs.panda.libraries import pybullet
from progpolicy_envs.panda.physics import Hand

BASE_POSITION = (-0.6, 0.0, 0.0)
#: Largest displacement of the gripper that one action asks for, metres.
MAX_DISPLACEMENT = 0.05
#: Largest change of finger width that one action asks for, metres.
MAX_WIDTH_CHANGE = 0.2
#: Distance between the open fingers, metres.
MAX_WIDTH = 0.08

_ARM = (0, 1, 2, 3, 4, 5, 6)
_FINGERS = (9, 10)
_JOINTS = (*_ARM, *_FINGERS)
_GRIPPER = 11
_FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 120.0, 120.0, 170.0, 170.0)
_NEUTRAL = (0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79, 0.0, 0.0)
# The joints' limits in the URDF, narrowed a little so that the motors do not press against the stops.
_LOWER = tuple(low + 0.01 for low in (-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671))
_UPPER = tuple(high - 0.01 for high in (2.9671, 1.8326, 2.9671, 0.0, 2.9671, 3.8223, 2.9671))
# PyBullet's position motor removes this share of the error in each physics step of 1/240 s; see motor_gain. Stiffer
# motors run into their torque limits and swing the arm off its line without arriving sooner.
_GAIN_AT_240_HZ = 0.1
# Lengths of the arm in the URDF, metres: height of the shoulder; upper arm and forearm, with the elbow's offset from
# both; from the wrist's axis to the hand's and down to the fingertips.
_SHOULDER, _UPPER_ARM, _FOREARM, _ELBOW, _WRIST, _HAND = 0.333, 0.316, 0.384, 0.0825, 0.088, 0.212
_TO_ELBOW, _TO_WRIST = math.hypot(_UPPER_ARM, _ELBOW), math.hypot(_FOREARM, _ELBOW)
_ELBOW_ANGLES = math.atan2(_ELBOW, _UPPER_ARM), math.atan2(_ELBOW, _FOREARM)
_BENT = sum(_ELBOW_ANGLES)
#: The gripper stays this far from the axis on which the arm turns: nearer, a small displacement is a large turn.
NEAREST = 0.2
#: On the table the gripper comes this far from that axis.
FARTHEST = 0.8


def motor_gain(time_step: float) -> float:
    """Return the motors' position gain for a physics time step, so that the arm is as stiff at every time step.

    The motor removes the share ``gain`` of the error in every substep, so equal behaviour in equal time needs
    ``(1 - gain) ** (1 / time_step)`` to stay the same.

    :param time_step: seconds
    """
    return 1 - (1 - _GAIN_AT_240_HZ) ** (240 * time_step)


def beyond_reach(x: float, y: float, z: float) -> float:
    """Return how far a place at least stays from the gripper, wherever the arm goes, metres; 0 within its reach.

    :param x: metres
    :param y: metres
    :param z: metres above the table
    """
    out = math.hypot(x - BASE_POSITION[0], y - BASE_POSITION[1])
    span = math.hypot(max(NEAREST, out) - _WRIST, z + _HAND - _SHOULDER)
    return max(NEAREST - out, span - _TO_ELBOW - _TO_WRIST, 0.0)


def arm_angles(x: float, y: float, z: float) -> list[float]:
    """Return the arm's joint angles that bring the gripper to a place, pointing down, its fingers opening along y.

    Of the seven joints the third and the fifth stay at 0. The arm then moves in a vertical plane, where shoulder, elbow
    and wrist form a triangle: the solution is exact and does not depend on the arm's present angles. A place out of
    reach is moved towards the shoulder until it is in reach.

    :param x: metres
    :param y: metres
    :param z: metres above the table
    :return: seven angles within the joints' limits, radians
    """
    x, y = x - BASE_POSITION[0], y - BASE_POSITION[1]
    turn = math.atan2(y, x)
    out, up = max(NEAREST, math.hypot(x, y)) - _WRIST, z + _HAND - _SHOULDER
    span = math.hypot(out, up)
    at_elbow = _corner(_TO_ELBOW, _TO_WRIST, span)
    at_shoulder = _corner(_TO_ELBOW, span, _TO_WRIST)
    shoulder = math.atan2(out, up) - at_shoulder - _ELBOW_ANGLES[0]
    elbow = at_elbow - math.pi - _BENT
    wrist, hand = shoulder - elbow, turn + math.pi / 4
    angles = [turn, shoulder, 0.0, elbow, 0.0, wrist, hand]
    low, high = _LOWER, _UPPER
    if (
        low[0] <= turn <= high[0]
        and low[1] <= shoulder <= high[1]
        and low[3] <= elbow <= high[3]
        and low[5] <= wrist <= high[5]
        and low[6] <= hand <= high[6]
    ):
        return angles
    return [min(most, max(least, angle)) for angle, least, most in zip(angles, low, high, strict=True)]


def _corner(one: float, other: float, opposite: float) -> float:
    """Return the angle between two sides of a triangle; 0 or pi where the third is too short or too long."""
    cosine = (one * one + other * other - opposite * opposite) / (2 * one * other)
    return math.acos(cosine) if -1.0 < cosine < 1.0 else math.pi * (cosine < 0.0)


class PandaRobot:
    """The arm in one PyBullet world, its gripper always pointing down, its fingers opening along y.

    :param client: the physics client
    :param visual: whether to load the meshes needed for pictures
    """

    def __init__(self, client: int, visual: bool = False) -> None:
        self.client = client
        flags = 0 if visual else pybullet.URDF_IGNORE_VISUAL_SHAPES
        self.body = pybullet.loadURDF(
            "franka_panda/panda.urdf", BASE_POSITION, useFixedBase=True, flags=flags, physicsClientId=client
        )
        for finger in _FINGERS:
            pybullet.changeDynamics(
                self.body, finger, lateralFriction=1.0, spinningFriction=0.001, physicsClientId=client
            )
        self._couple_fingers()
        self.set_time_step(1 / 240)
        self.position = self.velocity = (0.0, 0.0, 0.0)
        self.width = 0.0
        self.place()
        self.read()

    def set_time_step(self, time_step: float, in_one_call: int = 1) -> None:
        """Adapt the motors to the physics time step; the next action uses them.

        :param time_step: seconds
        :param in_one_call: how many such steps one call of the simulation makes
        """
        self._gains = [motor_gain(time_step)] * len(_JOINTS)
        # PyBullet turns a force into the impulse of a whole call and lets the motor exert that in each of its steps.
        self._forces = [force / in_one_call for force in _FORCES]

    def _couple_fingers(self) -> None:
        """Make the fingers move symmetrically, as those of the real hand do; PyBullet leaves out the URDF's mimic."""
        gear = pybullet.createConstraint(
            *(self.body, _FINGERS[0], self.body, _FINGERS[1]),
            jointType=pybullet.JOINT_GEAR,
            jointAxis=[1, 0, 0],
            parentFramePosition=[0, 0, 0],
            childFramePosition=[0, 0, 0],
            physicsClientId=self.client,
        )
        pybullet.changeConstraint(gear, gearRatio=-1, erp=0.1, maxForce=100, physicsClientId=self.client)

    def place(self, hand: Hand | None = None) -> None:
        """Put all joints into a pose, at rest.

        :param hand: where the gripper is; by default the pose is the neutral one, fingers closed
        """
        pose = _NEUTRAL if hand is None else (*arm_angles(*hand.position), hand.width / 2, hand.width / 2)
        for joint, angle in zip(_JOINTS, pose, strict=True):
            pybullet.resetJointState(self.body, joint, angle, 0.0, physicsClientId=self.client)
        self._drive(pose)

    def read(self) -> None:
        """Read the gripper's position, velocity and width from the simulation, in two calls of PyBullet."""
        left, right = pybullet.getJointStates(self.body, _FINGERS, self.client)
        link = pybullet.getLinkState(self.body, _GRIPPER, True, False, self.client)
        self.position = link[0]
        self.velocity = link[6]
        self.width = left[0] + right[0]

    def act(self, action: Sequence[float]) -> None:
        """Set the motors for one action.

        :param action: four numbers, clipped to [-1, 1]: displacement along x, y, z in units of 5 cm and change of the
            finger width in units of 20 cm, that is: open or close
        """
        if max(action) > 1.0 or min(action) < -1.0:
            action = [min(1.0, max(-1.0, number)) for number in action]
        x, y, z, fingers = action
        px, py, pz = self.position
        # As in panda-gym the fingertips are not sent below the table.
        height = max(0.0, pz + z * MAX_DISPLACEMENT)
        angles = arm_angles(px + x * MAX_DISPLACEMENT, py + y * MAX_DISPLACEMENT, height)
        finger = max(0.0, min(MAX_WIDTH, self.width + fingers * MAX_WIDTH_CHANGE)) / 2
        self._drive((*angles, finger, finger))

    def _drive(self, angles: Sequence[float]) -> None:
        pybullet.setJointMotorControlArray(
            self.body,
            _JOINTS,
            pybullet.POSITION_CONTROL,
            targetPositions=angles,
            forces=self._forces,
            positionGains=self._gains,
            physicsClientId=self.client,
        )
