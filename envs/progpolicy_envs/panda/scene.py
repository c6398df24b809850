"""The world around the robot: table and coloured objects in one PyBullet client, simulated, read and reset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from progpolicy_envs.panda.libraries import pybullet, pybullet_data
from progpolicy_envs.panda.robot import PandaRobot
from progpolicy_envs.panda.shapes import bearing_box, drum_inertia, footed_drum, visual_drum

MAX_OBJECTS = 8
#: Seconds of one control step.
CONTROL_STEP = 1 / 30
TABLE_HEIGHT = 0.4
#: An object whose centre is this near to the point between the fingertips may be held, metres.
HOLD_DISTANCE = 0.03
#: An object whose centre is this far above where it lies on the table has been lifted, metres.
LIFT_HEIGHT = 0.005
#: An object that moves less than this in one control step is still, metres; after so many such steps it is deactivated.
STILL_MOTION, STILL_STEPS = 1e-5, 3
#: An object whose centre is this far below the table's top has left the table, metres.
FALL_DEPTH = 0.05
#: By how much Bullet enlarges all bodies to find those that may touch, metres.
BULLET_MARGIN = 0.02

Point = tuple[float, float, float]

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_STILL = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Physics:
    """How finely the world is simulated.

    Coarse steps with few iterations of the contact solver are good enough for pushing objects over the table. But with
    them a block slips out of the fingers when it is lifted, and a tower trembles until it falls. So the world is called
    delicate while an object is between the fingers or off the table, and then has finer steps with more iterations.

    :param frequency: physics steps per second
    :param substeps: physics steps in one control step, which therefore takes ``substeps / frequency`` seconds
    :param solver_iterations: iterations of the contact solver in each physics step
    :param delicate_substeps: physics steps in one control step while the world is delicate
    :param delicate_iterations: iterations of the contact solver while the world is delicate
    :param sleeping: whether bodies at rest are left out of the simulation until something touches them; an object
        is put to sleep after a tenth of a second of rest, where Bullet would wait two seconds
    :param contact_margin: by how much all bodies are enlarged to find those that may touch, metres, while the world is
        not delicate; with a small margin more of the objects near the hand can sleep
    :param stock_bodies: whether table and objects are PyBullet's default, as in panda-gym: multibodies, each a box or a
        cylinder. Otherwise the table, and every object whose kind does not ask for a multibody, are rigid bodies, with
        shapes that do not sink in when they slide
    """

    frequency: int = 120
    substeps: int = 4
    solver_iterations: int = 10
    delicate_substeps: int = 8
    delicate_iterations: int = 60
    sleeping: bool = True
    contact_margin: float = 0.005
    stock_bodies: bool = False

    @property
    def control_step(self) -> float:
        """Seconds of one control step."""
        return self.substeps / self.frequency


#: panda-gym's settings, to compare with; its control step is 1/25 s.
PANDA_GYM_PHYSICS = Physics(
    frequency=500,
    substeps=20,
    solver_iterations=50,
    delicate_substeps=20,
    delicate_iterations=50,
    sleeping=False,
    contact_margin=BULLET_MARGIN,
    stock_bodies=True,
)


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
    :param multibody: whether PyBullet computes it as a multibody, which makes steadier towers, or as a plain rigid
        body, whose contacts take less work to solve
    """

    shape: Literal["box", "cylinder"]
    half_extents: tuple[float, float, float]
    mass: float
    friction: float
    multibody: bool = False

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
        self._lifted = self.rest_height + LIFT_HEIGHT
        self.client = pybullet.connect(pybullet.DIRECT)
        self._build(visual)
        self._set_delicate(False)
        self._still_steps = [0] * MAX_OBJECTS
        #: Centres of the objects in use.
        self.positions: list[Point] = []
        self._used: list[int] = []
        self.place([])

    def _build(self, visual: bool) -> None:
        client = self.client
        # The simple broadphase keeps no history and so lets a reset world repeat itself bit for bit.
        pybullet.resetSimulation(pybullet.RESET_USE_SIMPLE_BROADPHASE, physicsClientId=client)
        pybullet.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=client)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        self.robot = PandaRobot(client, visual)
        self._build_table(visual)
        self.objects = [self._build_object(visual) for _ in range(MAX_OBJECTS if self.kind else 0)]

    def _build_table(self, visual: bool) -> None:
        table = self.table
        half = [(table.high_x - table.low_x) / 2, table.width / 2, TABLE_HEIGHT / 2]
        look = {"halfExtents": half, "rgbaColor": [0.93, 0.92, 0.9, 1], "specularColor": [0, 0, 0]}
        client, stock = self.client, self.physics.stock_bodies
        shape = (
            pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
            if stock
            else bearing_box(half, client)
        )
        # A plain rigid body: contacts with a multibody, though it is fixed too, take 40 % more work to solve.
        body = pybullet.createMultiBody(
            baseCollisionShapeIndex=shape,
            baseVisualShapeIndex=pybullet.createVisualShape(pybullet.GEOM_BOX, physicsClientId=client, **look)
            if visual
            else -1,
            basePosition=[(table.low_x + table.high_x) / 2, 0, -TABLE_HEIGHT / 2],
            useMaximalCoordinates=not stock,
            physicsClientId=client,
        )
        if self.physics.sleeping:
            # Contacts are computed anew in every step unless both bodies sleep.
            self._activate(body, pybullet.ACTIVATION_STATE_ENABLE_SLEEPING)
            self._activate(body, pybullet.ACTIVATION_STATE_SLEEP)

    def _build_object(self, visual: bool) -> int:
        assert self.kind is not None
        client, kind = self.client, self.kind
        multibody = kind.multibody or self.physics.stock_bodies
        body: int = pybullet.createMultiBody(
            baseMass=kind.mass,
            baseCollisionShapeIndex=self._solid(kind),
            baseVisualShapeIndex=self._look(kind) if visual else -1,
            basePosition=(0, 0, 0),
            useMaximalCoordinates=not multibody,
            physicsClientId=client,
        )
        if kind.shape == "cylinder":
            inertia = drum_inertia(kind.mass, kind.half_extents[0], 2 * kind.half_extents[2])
            pybullet.changeDynamics(body, -1, kind.mass, localInertiaDiagonal=inertia, physicsClientId=client)
        pybullet.changeDynamics(body, -1, lateralFriction=kind.friction, physicsClientId=client)
        if not multibody:
            # A multibody has this damping by default.
            pybullet.changeDynamics(body, -1, linearDamping=0.04, angularDamping=0.04, physicsClientId=client)
        if self.physics.sleeping:
            self._activate(body, pybullet.ACTIVATION_STATE_ENABLE_SLEEPING)
        return body

    def _solid(self, kind: ObjectKind) -> int:
        size, client = kind.half_extents, self.client
        if kind.shape == "box":
            return int(pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=size, physicsClientId=client))
        radius, height = size[0], 2 * size[2]
        if self.physics.stock_bodies:
            shape: int = pybullet.createCollisionShape(
                pybullet.GEOM_CYLINDER, radius=radius, height=height, physicsClientId=client
            )
            return shape
        return footed_drum(radius, height, client)

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
        """Put the robot into its neutral pose and objects onto the table, all at rest, as in a new world.

        Objects that lie on the table start asleep.

        :param positions: the centres of the objects, metres, no two overlapping
        """
        self._set_delicate(False)
        for index, body in enumerate(self.objects):
            self._move(body, _parking(index))
        self.robot.place()
        # Parked objects touch nothing, so Bullet drops all contacts and what it kept to solve them. Waking and falling
        # asleep take a body one step each, after which all objects start every episode in the same state.
        self._set_steps(self.physics.substeps, 1)
        for state in (pybullet.ACTIVATION_STATE_WAKE_UP, pybullet.ACTIVATION_STATE_SLEEP):
            for body in self.objects:
                self._activate(body, state)
            pybullet.stepSimulation(physicsClientId=self.client)
        self._set_delicate(False)
        self.robot.place()
        self.n_objects = len(positions)
        self._used = self.objects[: self.n_objects]
        self._still_steps = [0] * MAX_OBJECTS
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
        """Simulate one control step and read the state after it."""
        self.simulate()
        self.sync_state()

    def simulate(self) -> None:
        """Compute the physics of one control step."""
        step, set_engine, client = pybullet.stepSimulation, pybullet.setPhysicsEngineParameter, self.client
        other_margin = self._margin != BULLET_MARGIN
        # Bullet has one margin for the whole process, so it is set back at once for other worlds.
        if other_margin:
            set_engine(contactBreakingThreshold=self._margin, physicsClientId=client)
        try:
            for _ in self._calls:
                step(client)
        finally:
            if other_margin:
                set_engine(contactBreakingThreshold=BULLET_MARGIN, physicsClientId=client)

    def sync_state(self) -> None:
        """Read the state after the physics, and deactivate the objects that lie still."""
        before = self.positions
        self.read()
        if self.physics.sleeping and before:
            self._deactivate(before)

    def _is_delicate(self) -> bool:
        gripper, lifted = self.robot.position, self._lifted
        for position in self.positions:  # noqa: SIM110 - a generator costs more in what every step does
            if position[2] > lifted or math.dist(position, gripper) < HOLD_DISTANCE:
                return True
        return False

    def _set_delicate(self, delicate: bool) -> None:
        physics = self.physics
        self._delicate = delicate
        self._margin = BULLET_MARGIN if delicate or not self.objects else physics.contact_margin
        substeps = physics.delicate_substeps if delicate else physics.substeps
        # Bullet divides seconds in each call to find how many steps it makes, which is exact for powers of two.
        self._set_steps(substeps // (substeps & -substeps), substeps & -substeps)
        iterations = physics.delicate_iterations if delicate else physics.solver_iterations
        pybullet.setPhysicsEngineParameter(numSolverIterations=iterations, physicsClientId=self.client)

    def _set_steps(self, calls: int, in_one_call: int) -> None:
        """Divide a control step into calls of the simulation, each of which makes several physics steps.

        Several physics steps in one call take a fifth less time than in as many calls. The result is the same to the
        last bit, but for a rigid body that is woken during a call: Bullet applies gravity at the beginning of a call,
        so that the body has no weight until the next one, which is at most a control step later.
        """
        self._calls = range(calls)
        seconds = self.physics.control_step / calls
        self.robot.set_time_step(seconds / in_one_call, in_one_call)
        pybullet.setPhysicsEngineParameter(fixedTimeStep=seconds, numSubSteps=in_one_call, physicsClientId=self.client)

    def _deactivate(self, before: Sequence[Point]) -> None:
        """Put the objects to sleep that have not moved for a while; whatever touches one wakes it.

        :param before: the objects' centres one control step ago
        """
        still, positions = self._still_steps, self.positions
        for index, old in enumerate(before):
            new = positions[index]
            if old != new and math.dist(old, new) > STILL_MOTION:
                still[index] = 0
            else:
                still[index] += 1
                if still[index] == STILL_STEPS:
                    self._activate(self.objects[index], pybullet.ACTIVATION_STATE_SLEEP)

    def read(self) -> None:
        """Read the robot and the positions of the objects in use, and choose how finely to simulate them."""
        self.robot.read()
        read, client = pybullet.getBasePositionAndOrientation, self.client
        self._poses = [read(body, client) for body in self._used]
        self.positions = [pose[0] for pose in self._poses]
        delicate = self._is_delicate()
        if delicate != self._delicate:
            self._set_delicate(delicate)

    def object_state(self, index: int, position: Point | None = None) -> ObjectState:
        """Return the full state of one object.

        :param index: which object
        :param position: returned as its centre; by default where it is
        """
        velocity, spin = pybullet.getBaseVelocity(self.objects[index], self.client)
        return ObjectState(position or self.positions[index], self._poses[index][1], velocity, spin)

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
