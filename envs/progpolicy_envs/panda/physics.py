"""What a scene is made of and how it is computed, as plain data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Literal, NamedTuple

MAX_OBJECTS = 8
#: Seconds of one control step.
CONTROL_STEP = 1 / 30
#: By how much Bullet enlarges all bodies to find those that may touch, metres.
BULLET_MARGIN = 0.02

Point = tuple[float, float, float]


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
    :raises ValueError: if a number is not accepted
    """

    frequency: int = 120
    substeps: int = 4
    solver_iterations: int = 10
    delicate_substeps: int = 8
    delicate_iterations: int = 60
    sleeping: bool = True
    contact_margin: float = 0.005
    stock_bodies: bool = False

    def __post_init__(self) -> None:
        for name in ("frequency", "substeps", "solver_iterations", "delicate_substeps", "delicate_iterations"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
                raise ValueError(f"{name}={value!r} is not accepted; it is a whole number of at least 1")
        margin = self.contact_margin
        if isinstance(margin, bool) or not isinstance(margin, Real) or not 0 <= margin < math.inf:
            raise ValueError(f"contact_margin={margin!r} is not accepted; it is a number of metres of at least 0")

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
class Hand:
    """Where an episode finds the gripper that does not begin in the neutral pose.

    :param position: of the point between the fingertips, metres
    :param width: between the fingers, metres
    """

    position: Point
    width: float = 0.0


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
