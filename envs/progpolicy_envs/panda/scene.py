"""The world around the robot: table and coloured objects in one PyBullet client, simulated, read and reset."""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from typing import Any

from progpolicy_envs.panda.history import History
from progpolicy_envs.panda.libraries import pybullet, pybullet_data
from progpolicy_envs.panda.physics import (
    BULLET_MARGIN,
    MAX_OBJECTS,
    Hand,
    ObjectKind,
    ObjectState,
    Physics,
    Point,
    Table,
)
from progpolicy_envs.panda.robot import PandaRobot
from progpolicy_envs.panda.shapes import bearing_box, drum_inertia, footed_drum, visual_drum

TABLE_HEIGHT = 0.4
#: An object whose centre is this near to the point between the fingertips may be held, metres.
HOLD_DISTANCE = 0.03
#: An object whose centre is this far above where it lies on the table has been lifted, metres.
LIFT_HEIGHT = 0.005
#: An object that moves less than this in one control step is still, metres; after so many such steps it is deactivated.
STILL_MOTION, STILL_STEPS = 1e-5, 3
#: An object whose centre is this far below the table's top has left the table, metres.
FALL_DEPTH = 0.05

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_STILL = (0.0, 0.0, 0.0)


class Scene:
    """One PyBullet world with the robot, a table and up to eight objects of one kind.

    All eight objects exist from the start, so that a reset only moves bodies; those that a variation does not use
    sleep far below the floor.

    A scene that is dropped frees its world. A deep or pickled copy has a world of its own, in which everything since
    the last :meth:`place` is done again, so that it is in the same state to the last bit.

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
        self._visual = visual
        self._lifted = self.rest_height + LIFT_HEIGHT
        self.client = pybullet.connect(pybullet.DIRECT)
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self.client)
        self._disconnect.atexit = False  # the end of the process frees it anyway
        self._build(visual)
        self._set_delicate(False)
        self._still_steps = [0] * MAX_OBJECTS
        #: Centres of the objects in use.
        self.positions: list[Point] = []
        self._used: list[int] = []
        self.place([])

    def __getstate__(self) -> dict[str, Any]:
        made_of = {"table": self.table, "kind": self.kind, "physics": self.physics, "visual": self._visual}
        return {"made_of": made_of, "open": self.client >= 0, "history": self._history}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state["made_of"])  # type: ignore[misc]
        state["history"].repeat(self)
        if not state["open"]:
            self.close()

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

    def place(self, positions: Sequence[Point], hand: Hand | None = None) -> None:
        """Put the robot into a pose and objects onto the table, all at rest, as in a new world.

        Objects that lie on the table start asleep.

        :param positions: the centres of the objects, metres, no two overlapping
        :param hand: where the gripper is; by default the pose is the neutral one
        """
        self._history = History(tuple(positions), hand)
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
        self.robot.place(hand)
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
        self._history.park(index)
        body = self.objects[index]
        self._move(body, _parking(index))
        self._activate(body, pybullet.ACTIVATION_STATE_SLEEP)

    def act(self, action: Sequence[float]) -> None:
        """Set the motors for one action; see :meth:`PandaRobot.act`."""
        self._history.pending = action
        self.robot.act(action)

    def step(self) -> None:
        """Simulate one control step and read the state after it."""
        self.simulate()
        self.sync_state()

    def simulate(self) -> None:
        """Compute the physics of one control step."""
        self._history.end_step()
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
        self._disconnect()
        self.client = -1

    def _move(self, body: int, position: Sequence[float]) -> None:
        pybullet.resetBasePositionAndOrientation(body, position, _UPRIGHT, self.client)
        pybullet.resetBaseVelocity(body, _STILL, _STILL, physicsClientId=self.client)

    def _activate(self, body: int, state: Any) -> None:
        pybullet.changeDynamics(body, -1, activationState=state, physicsClientId=self.client)


def _parking(index: int) -> Point:
    """Return a place where an object meets nothing."""
    return 10.0 + index, 0.0, -10.0
