"""The world around the robot: table and coloured objects in one PyBullet client, stepped, read and put back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import pybullet
import pybullet_data

from progpolicy_envs.panda.robot import PandaRobot
from progpolicy_envs.panda.shapes import visual_drum

MAX_OBJECTS = 8
#: Levels of a tower beyond which the solver gets no more iterations.
MAX_LEVELS = 6
#: Seconds of one control step.
CONTROL_STEP = 1 / 30
TABLE_HEIGHT = 0.4
#: An object whose centre is this far below the table's top has left the table, metres.
FALL_DEPTH = 0.05

Point = tuple[float, float, float]

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_STILL = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Physics:
    """How finely the world is simulated.

    :param frequency: physics steps per second
    :param substeps: physics steps in one control step
    :param solver_iterations: iterations of the contact solver in each physics step, for each level of a tower: ten
        are enough for blocks on the table, but a tower of eight needs about fifty to stand
    :param sleeping: whether bodies at rest are left out of the simulation until something touches them
    """

    frequency: int = 240
    substeps: int = 8
    solver_iterations: int = 10
    sleeping: bool = True


#: panda-gym's settings, to compare with; its control step is 1/25 s.
PANDA_GYM_PHYSICS = Physics(frequency=500, substeps=20, solver_iterations=50, sleeping=False)


@dataclass(frozen=True)
class Table:
    """A table whose top is at height 0, symmetric about y = 0.

    :param low_x: edge at the robot's side, metres
    :param high_x: far edge, metres
    :param width: extent along y, metres
    """

    low_x: float = -0.85
    high_x: float = 0.25
    width: float = 0.7


@dataclass(frozen=True)
class ObjectKind:
    """What the objects of a task are.

    :param shape: ``"box"`` or ``"cylinder"``
    :param half_extents: half the size along x, y and z, metres; a cylinder's radius is the first
    :param mass: kg
    :param friction: lateral friction coefficient; PyBullet multiplies those of the two bodies in contact
    """

    shape: Literal["box", "cylinder"]
    half_extents: tuple[float, float, float]
    mass: float
    friction: float

    @property
    def height(self) -> float:
        """Height of the centre of an object that lies on the table, metres."""
        return self.half_extents[2]


class ObjectState(NamedTuple):
    """One object. All in metres, seconds and radians.

    :param position: ``(3,)``
    :param orientation: quaternion ``(4,)``, scalar last
    :param velocity: ``(3,)``
    :param spin: angular velocity ``(3,)``
    """

    position: Sequence[float]
    orientation: Sequence[float]
    velocity: Sequence[float]
    spin: Sequence[float]


class Scene:
    """One PyBullet world with the robot, a table and up to eight objects of one kind.

    All eight objects exist from the start, so that a reset only moves bodies; those that a variation does not use
    sleep far below the floor.

    :param table: size of the table
    :param kind: kind of the objects; ``None`` for a world without objects
    :param physics: how finely to simulate
    :param visual: whether pictures will be taken
    """

    def __init__(
        self, table: Table, kind: ObjectKind | None, physics: Physics | None = None, visual: bool = False
    ) -> None:
        self.table = table
        self.kind = kind
        self.physics = physics or Physics()
        self.n_objects = 0
        self.client = pybullet.connect(pybullet.DIRECT)
        self._build(visual)
        self._levels = 1
        #: Centres of the objects in use.
        self.positions: list[Point] = []
        self.place([])

    def _build(self, visual: bool) -> None:
        client = self.client
        # The simple broadphase keeps no history and so lets a reset world repeat itself bit for bit.
        pybullet.resetSimulation(pybullet.RESET_USE_SIMPLE_BROADPHASE, physicsClientId=client)
        pybullet.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=client)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=1 / self.physics.frequency,
            numSolverIterations=self.physics.solver_iterations,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        self.robot = PandaRobot(client, 1 / self.physics.frequency, visual)
        self._build_table(visual)
        self.objects = [self._build_object(visual) for _ in range(MAX_OBJECTS if self.kind else 0)]

    def _build_table(self, visual: bool) -> None:
        table = self.table
        half = [(table.high_x - table.low_x) / 2, table.width / 2, TABLE_HEIGHT / 2]
        look = {"halfExtents": half, "rgbaColor": [0.93, 0.92, 0.9, 1], "specularColor": [0, 0, 0]}
        client = self.client
        body = pybullet.createMultiBody(
            baseCollisionShapeIndex=pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client
            ),
            baseVisualShapeIndex=pybullet.createVisualShape(pybullet.GEOM_BOX, physicsClientId=client, **look)
            if visual
            else -1,
            basePosition=[(table.low_x + table.high_x) / 2, 0, -TABLE_HEIGHT / 2],
            physicsClientId=client,
        )
        if self.physics.sleeping:
            # Contacts are computed anew in every step unless both bodies sleep.
            self._activate(body, pybullet.ACTIVATION_STATE_ENABLE_SLEEPING)
            self._activate(body, pybullet.ACTIVATION_STATE_SLEEP)

    def _build_object(self, visual: bool) -> int:
        assert self.kind is not None
        client, kind = self.client, self.kind
        radius, height = kind.half_extents[0], 2 * kind.half_extents[2]
        if kind.shape == "box":
            geometry = pybullet.GEOM_BOX
            size: dict[str, Any] = {"halfExtents": kind.half_extents}
        else:
            geometry = pybullet.GEOM_CYLINDER
            size = {"radius": radius, "height": height}
        body: int = pybullet.createMultiBody(
            baseMass=kind.mass,
            baseCollisionShapeIndex=pybullet.createCollisionShape(geometry, physicsClientId=client, **size),
            baseVisualShapeIndex=self._look(kind) if visual else -1,
            basePosition=(0, 0, 0),
            physicsClientId=client,
        )
        pybullet.changeDynamics(body, -1, lateralFriction=kind.friction, physicsClientId=client)
        if self.physics.sleeping:
            self._activate(body, pybullet.ACTIVATION_STATE_ENABLE_SLEEPING)
        return body

    def _look(self, kind: ObjectKind) -> int:
        matt = {"specularColor": [0, 0, 0], "physicsClientId": self.client}
        if kind.shape == "box":
            return int(pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=kind.half_extents, **matt))
        return visual_drum(kind.half_extents[0], 2 * kind.half_extents[2], **matt)

    @property
    def rest_height(self) -> float:
        """Height of the centre of an object that lies on the table, metres."""
        return self.kind.height if self.kind else 0.0

    def place(self, positions: Sequence[Point]) -> None:
        """Put the robot into its neutral pose and objects onto the table, all at rest; the rest of the world is as new.

        Objects that lie on the table start asleep.

        :param positions: the centres of the objects, metres, no two overlapping
        """
        for index, body in enumerate(self.objects):
            self._move(body, _parking(index))
        self.robot.place()
        # Apart from each other nothing touches: contacts and their warm starts are forgotten. A body takes a step to
        # wake up and another to fall asleep, so that all enter the episode alike, asleep before anything moves them.
        for state in (pybullet.ACTIVATION_STATE_WAKE_UP, pybullet.ACTIVATION_STATE_SLEEP):
            for body in self.objects:
                self._activate(body, state)
            pybullet.stepSimulation(physicsClientId=self.client)
        self.robot.place()
        self.n_objects = len(positions)
        for index, body in enumerate(self.objects):
            used = index < self.n_objects
            self._move(body, positions[index] if used else _parking(index))
            if used and not (self.physics.sleeping and positions[index][2] == self.rest_height):
                self._activate(body, pybullet.ACTIVATION_STATE_WAKE_UP)
        pybullet.performCollisionDetection(physicsClientId=self.client)
        self.read()

    def park(self, index: int) -> None:
        """Take an object off the table for the rest of the episode."""
        body = self.objects[index]
        self._move(body, _parking(index))
        self._activate(body, pybullet.ACTIVATION_STATE_SLEEP)

    def step(self) -> None:
        """Simulate one control step."""
        self._set_iterations()
        step, client = pybullet.stepSimulation, self.client
        for _ in range(self.physics.substeps):
            step(client)
        self.read()

    def _set_iterations(self) -> None:
        if self.kind is None or not self.positions:
            return
        highest = max([position[2] for position in self.positions])
        levels = min(MAX_LEVELS, max(1, round(highest / (2 * self.kind.height) + 0.5)))
        if levels != self._levels:
            self._levels = levels
            pybullet.setPhysicsEngineParameter(
                numSolverIterations=(6 if levels > 1 else 1) * self.physics.solver_iterations,
                physicsClientId=self.client,
            )

    def read(self) -> None:
        """Take over the state of the robot and the positions of all objects in use."""
        self.robot.read()
        read, client = pybullet.getBasePositionAndOrientation, self.client
        self._poses = [read(body, client) for body in self.objects[: self.n_objects]]
        self.positions = [pose[0] for pose in self._poses]

    def object_state(self, index: int) -> ObjectState:
        """Return the full state of one object."""
        velocity, spin = pybullet.getBaseVelocity(self.objects[index], self.client)
        position, orientation = self._poses[index]
        return ObjectState(position, orientation, velocity, spin)

    def close(self) -> None:
        """Disconnect from PyBullet; a second call does nothing."""
        if self.client >= 0:
            pybullet.disconnect(self.client)
            self.client = -1

    def _move(self, body: int, position: Sequence[float]) -> None:
        pybullet.resetBasePositionAndOrientation(body, position, _UPRIGHT, self.client)
        pybullet.resetBaseVelocity(body, _STILL, _STILL, physicsClientId=self.client)

    def _activate(self, body: int, state: Any) -> None:
        pybullet.changeDynamics(body, -1, activationState=state, physicsClientId=self.client)


def _parking(index: int) -> Point:
    """Return a place where an object meets nothing."""
    return 10.0 + index, 0.0, -10.0
