"""Replacements for shapes of PyBullet that its software renderer or its contact search handles badly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from progpolicy_envs.panda.libraries import pybullet

_SEGMENTS = 32
#: How far a compound's only shape is off the centre, metres; PyBullet replaces a compound of one centred shape by that.
_EPSILON = 1e-9
#: How far a drum's foot stands out of its end, metres.
_FOOT = 0.001
#: Half the side of a drum's square foot, divided by the radius; the corners stay just inside the circle.
_FOOT_SIZE = 0.7


def bearing_box(half_extents: Sequence[float], client: int) -> int:
    """Return a collision shape: a box on which things slide without tilting.

    Between two boxes PyBullet keeps at most four points of contact. It first adds those of the present step and then
    drops those that have slid away, so that a sliding box is left with one or two, tilts and digs in. Between a box and
    a compound it drops before it adds.

    :param half_extents: half the size along x, y and z, metres
    :param client: the physics client
    """
    shape: int = pybullet.createCollisionShapeArray(
        shapeTypes=[pybullet.GEOM_BOX],
        halfExtents=[list(half_extents)],
        collisionFramePositions=[[0.0, 0.0, _EPSILON]],
        physicsClientId=client,
    )
    return shape


def footed_drum(radius: float, length: float, client: int) -> int:
    """Return a collision shape: an upright cylinder that stands on a square foot, at both ends, a millimetre high.

    For a cylinder PyBullet finds one point of contact in a step. At rest the points add up to four, but sliding at
    0.4 m/s, in steps of 1/120 s, a cylinder had one, at its rim, and sank 11 mm into the table. A box has four at once.

    :param radius: metres
    :param length: metres, from end to end
    :param client: the physics client
    """
    side = _FOOT_SIZE * radius
    shape: int = pybullet.createCollisionShapeArray(
        shapeTypes=[pybullet.GEOM_BOX, pybullet.GEOM_CYLINDER],
        halfExtents=[[side, side, length / 2], [0.0, 0.0, 0.0]],
        radii=[0.0, radius],
        lengths=[0.0, length - 2 * _FOOT],
        physicsClientId=client,
    )
    return shape


def drum_inertia(mass: float, radius: float, length: float) -> tuple[float, float, float]:
    """Return the moments of inertia of an upright cylinder, kg m^2; for a compound PyBullet computes those of a box.

    :param mass: kg
    :param radius: metres
    :param length: metres, from end to end
    """
    across = mass * (3 * radius**2 + length**2) / 12
    return across, across, mass * radius**2 / 2


def visual_drum(radius: float, length: float, **look: Any) -> int:
    """Return a visual shape: an upright cylinder with flat ends.

    PyBullet's own cylinders have one normal at an edge for the end and the side, so that the renderer makes a flat one
    look like a ball and a disc like a cone. Here ends and side have normals of their own.

    :param radius: metres
    :param length: metres, from end to end
    :param look: further arguments of ``createVisualShape``
    """
    circle = [(math.cos(angle), math.sin(angle)) for angle in _angles()]
    vertices: list[list[float]] = []
    normals: list[list[float]] = []
    indices: list[int] = []

    def ring(z: float, normal_z: float) -> int:
        """Add a circle of vertices, with normals along z or, for 0, outwards; return the index of its first."""
        first = len(vertices)
        vertices.extend([x * radius, y * radius, z] for x, y in circle)
        normals.extend([0.0, 0.0, normal_z] if normal_z else [x, y, 0.0] for x, y in circle)
        return first

    for side in (1.0, -1.0):
        first = ring(side * length / 2, side)
        for k in range(1, _SEGMENTS - 1):
            corners = (first, first + k, first + k + 1)
            indices.extend(corners if side > 0 else corners[::-1])
    upper, lower = ring(length / 2, 0.0), ring(-length / 2, 0.0)
    for k in range(_SEGMENTS):
        after = (k + 1) % _SEGMENTS
        indices.extend((lower + k, lower + after, upper + after, lower + k, upper + after, upper + k))
    shape: int = pybullet.createVisualShape(
        pybullet.GEOM_MESH, vertices=vertices, normals=normals, indices=indices, **look
    )
    return shape


def _angles() -> list[float]:
    return [2 * math.pi * k / _SEGMENTS for k in range(_SEGMENTS)]
