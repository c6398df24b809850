"""Shapes that PyBullet's software renderer draws badly by itself."""

from __future__ import annotations

import math
from typing import Any

import pybullet

_SEGMENTS = 32


def visual_drum(radius: float, length: float, **look: Any) -> int:
    """Return a visual shape: an upright cylinder with flat ends.

    The renderer gives PyBullet's own cylinders one normal for the end and the side of an edge, so that a flat one
    looks like a ball and a disc like a cone. Here each has normals of its own.

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
