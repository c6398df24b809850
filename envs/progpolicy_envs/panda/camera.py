"""Pictures of a Panda scene, drawn with PyBullet's software renderer."""

from __future__ import annotations

from typing import Any

import numpy as np

from progpolicy_envs.panda.libraries import pybullet
from progpolicy_envs.panda.physics import MAX_OBJECTS
from progpolicy_envs.panda.scene import Scene
from progpolicy_envs.panda.shapes import visual_drum
from progpolicy_envs.panda.tasks import Mark, Task
from progpolicy_envs.rendering import Frame

WIDTH, HEIGHT = 480, 360
#: Colours in the order in which objects are to be finished.
COLOURS = (
    (0.84, 0.15, 0.16),
    (0.12, 0.47, 0.71),
    (0.17, 0.63, 0.17),
    (1.0, 0.75, 0.0),
    (0.58, 0.25, 0.75),
    (1.0, 0.5, 0.05),
    (0.1, 0.75, 0.8),
    (0.9, 0.45, 0.75),
)
MARKER_COLOUR = (0.05, 0.05, 0.05)
_AWAY = (0.0, 0.0, -50.0)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def _pale(colour: tuple[float, float, float]) -> list[float]:
    return [0.45 * part + 0.55 for part in colour] + [1.0]


class Camera:
    """Draws the scene, the task's marks in their objects' colours, and black pins over what is in focus.

    What it adds to the world can be seen but not touched.

    :param scene: a scene built with ``visual=True``
    :param task: its task
    """

    def __init__(self, scene: Scene, task: Task) -> None:
        self.scene = scene
        self.task = task
        for body, colour in zip(scene.objects, COLOURS, strict=False):
            pybullet.changeVisualShape(body, -1, rgbaColor=[*colour, 1], physicsClientId=scene.client)
        #: For each mark of the task one body in each colour.
        self._marks = [[self._mark(mark, colour) for colour in COLOURS] for mark in task.marks]
        self._pins = [self._pin() for _ in range(2)]
        self._floor = self._ghost(pybullet.GEOM_BOX, [0.55, 0.6, 0.64, 1.0], halfExtents=[3, 3, 0.01])
        self._put(self._floor, (0.0, 0.0, -0.42))

    def __getstate__(self) -> dict[str, Any]:
        return {"scene": self.scene, "task": self.task}

    def __setstate__(self, state: dict[str, Any]) -> None:
        if state["scene"].client < 0:  # closed: there is nothing to draw
            self.scene, self.task = state["scene"], state["task"]
        else:
            self.__init__(**state)  # type: ignore[misc]

    def frame(self, focus: int) -> Frame:
        """Return a picture ``(360, 480, 3)`` of bytes.

        :param focus: index of the object in focus
        """
        task = self.task
        for index in range(MAX_OBJECTS):
            shown = index < len(task.targets)
            positions = task.mark_positions(index) if shown else [None] * len(self._marks)
            for bodies, position in zip(self._marks, positions, strict=True):
                self._put(bodies[index], position or _AWAY)
        for (head, needle), position in zip(self._pins, task.pin_positions(focus), strict=False):
            x, y, z = position or _AWAY
            self._put(head, (x, y, z + 0.085))
            self._put(needle, (x, y, z + 0.05))
        middle = (self.scene.table.low_x + self.scene.table.high_x) / 2
        view = pybullet.computeViewMatrixFromYawPitchRoll((middle + 0.05, 0, 0.2), 1.6, 60, -33, 0, 2)
        projection = pybullet.computeProjectionMatrixFOV(42, WIDTH / HEIGHT, 0.1, 10)
        pixels = pybullet.getCameraImage(
            WIDTH,
            HEIGHT,
            view,
            projection,
            lightDirection=[0.6, 0.9, 2.0],
            # Shadows would double the time and only darken whole faces of the table and the floor.
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.scene.client,
        )[2]
        return np.asarray(pixels, dtype=np.uint8).reshape(HEIGHT, WIDTH, 4)[:, :, :3].copy()

    def _pin(self) -> tuple[int, int]:
        head = self._ghost(pybullet.GEOM_SPHERE, [*MARKER_COLOUR, 1.0], radius=0.012)
        return head, self._ghost(pybullet.GEOM_CYLINDER, [*MARKER_COLOUR, 1.0], radius=0.0035, length=0.06)

    def _mark(self, mark: Mark, colour: tuple[float, float, float]) -> int:
        shade, (radius, _, half_height) = _pale(colour) if mark.pale else [*colour, 1.0], mark.half_extents
        if mark.shape == "drum":
            return self._body(visual_drum(radius, 2 * half_height, **self._look(shade)))
        if mark.shape == "box":
            return self._ghost(pybullet.GEOM_BOX, shade, halfExtents=list(mark.half_extents))
        return self._ghost(pybullet.GEOM_SPHERE, shade, radius=radius)

    def _ghost(self, geometry: int, colour: list[float], **size: float | list[float]) -> int:
        return self._body(pybullet.createVisualShape(geometry, **self._look(colour), **size))

    def _look(self, colour: list[float]) -> dict[str, Any]:
        return {"rgbaColor": colour, "specularColor": [0, 0, 0], "physicsClientId": self.scene.client}

    def _body(self, shape: int) -> int:
        body: int = pybullet.createMultiBody(
            baseMass=0, baseVisualShapeIndex=shape, basePosition=_AWAY, physicsClientId=self.scene.client
        )
        return body

    def _put(self, ghost: int, position: tuple[float, float, float]) -> None:
        pybullet.resetBasePositionAndOrientation(ghost, position, _UPRIGHT, self.scene.client)
