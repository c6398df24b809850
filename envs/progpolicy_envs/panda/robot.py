"""The Franka Panda: end-effector displacement and finger width in, gripper state out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pybullet
from numpy.typing import NDArray

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
_STILL = [0.0] * len(_JOINTS)
_FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 120.0, 120.0, 170.0, 170.0)
_NEUTRAL = (0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79, 0.0, 0.0)
# Limits of the joints in the URDF, drawn in a little so that the motors do not work against the stops.
_LOWER = tuple(low + 0.01 for low in (-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671))
_UPPER = tuple(high - 0.01 for high in (2.9671, 1.8326, 2.9671, 0.0, 2.9671, 3.8223, 2.9671))
# PyBullet's position motor removes this share of the error in each physics step of 1/240 s; see motor_gain. Stiffer
# motors run into their torque limits and swing the arm off its line without arriving sooner.
_GAIN_AT_240_HZ = 0.1
_DAMPING = 1e-3 * np.eye(6)
_POSTURE_GAIN = 0.1


def motor_gain(time_step: float) -> float:
    """Return the motors' position gain for a physics time step, so that the arm is as stiff at every time step.

    The motor removes the share ``gain`` of the error in every substep, so equal behaviour in equal time needs
    ``(1 - gain) ** (1 / time_step)`` to stay the same.

    :param time_step: seconds
    """
    return 1 - (1 - _GAIN_AT_240_HZ) ** (240 * time_step)


class PandaRobot:
    """The arm in one PyBullet world, its gripper always pointing down, its fingers opening along y.

    :param client: the physics client
    :param time_step: physics time step, seconds
    :param visual: whether to load the meshes needed for pictures
    """

    def __init__(self, client: int, time_step: float, visual: bool = False) -> None:
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
        self._gains = [motor_gain(time_step)] * len(_JOINTS)
        self.position = self.velocity = (0.0, 0.0, 0.0)
        self.width = 0.0
        self.place()
        self.read()

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

    def place(self) -> None:
        """Put all joints into the neutral pose, at rest, fingers closed."""
        for joint, angle in zip(_JOINTS, _NEUTRAL, strict=True):
            pybullet.resetJointState(self.body, joint, angle, 0.0, physicsClientId=self.client)
        self._drive(_NEUTRAL)

    def read(self) -> None:
        """Take over the state of the simulation; two calls of PyBullet in all."""
        self._joints = [state[0] for state in pybullet.getJointStates(self.body, _JOINTS, self.client)]
        link = pybullet.getLinkState(self.body, _GRIPPER, True, False, self.client)
        self.position = link[0]
        self.velocity = link[6]
        self._orientation = link[1]
        self.width = self._joints[-1] + self._joints[-2]

    def act(self, action: Sequence[float]) -> None:
        """Set the motors for one action.

        :param action: four numbers, clipped to [-1, 1]: displacement along x, y, z in units of 5 cm and change of the
            finger width in units of 20 cm, that is: open or close
        """
        x, y, z, fingers = [min(1.0, max(-1.0, number)) for number in action]
        # As in panda-gym the fingertips are not sent below the table.
        down = max(-self.position[2], z * MAX_DISPLACEMENT)
        angles = self._inverse_kinematics(x * MAX_DISPLACEMENT, y * MAX_DISPLACEMENT, down)
        finger = max(0.0, min(MAX_WIDTH, self.width + fingers * MAX_WIDTH_CHANGE)) / 2
        self._drive((*angles, finger, finger))

    def _drive(self, angles: Sequence[float]) -> None:
        pybullet.setJointMotorControlArray(
            self.body,
            _JOINTS,
            pybullet.POSITION_CONTROL,
            targetPositions=angles,
            forces=_FORCES,
            positionGains=self._gains,
            physicsClientId=self.client,
        )

    def _inverse_kinematics(self, x: float, y: float, z: float) -> list[float]:
        """Return arm angles for a displacement of the gripper, by one damped least-squares step.

        One step is exact to about 2 mm at 5 cm, and the next action starts from where the arm then is. What freedom
        is left pulls the arm towards its neutral pose, so that its posture hardly depends on the way it came.
        """
        jacobian = self._jacobian()
        # Rotation from the present orientation to (1, 0, 0, 0), pointing down, as a vector.
        qx, qy, qz, qw = self._orientation
        sign = math.copysign(2.0, qx)
        # A call of numpy costs more than a sum over seven joints, so only the matrices are arrays.
        pull = [_POSTURE_GAIN * (neutral - angle) for neutral, angle in zip(_NEUTRAL, self._joints, strict=True)]
        error = np.array((x, y, z, sign * qw, sign * qz, -sign * qy)) - jacobian.dot(pull)
        change = np.linalg.solve(jacobian.dot(jacobian.T) + _DAMPING, error).dot(jacobian).tolist()
        return [
            min(high, max(low, angle + posture + step))
            for angle, posture, step, low, high in zip(self._joints, pull, change, _LOWER, _UPPER, strict=False)
        ]

    def _jacobian(self) -> NDArray[np.float64]:
        """Return the ``(6, 9)`` Jacobian of the gripper with respect to the joints; the fingers do not move it."""
        linear, angular = pybullet.calculateJacobian(
            self.body, _GRIPPER, _STILL[:3], self._joints, _STILL, _STILL, self.client
        )
        return np.array(linear + angular)
