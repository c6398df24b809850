"""What a task is: where things start, when an object is finished, where the gripper has to be, what pictures show."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from progpolicy_envs.panda.physics import Hand, ObjectKind, Point, Table
from progpolicy_envs.panda.placement import Points, check_apart, check_on_table, in_reach, read_points
from progpolicy_envs.panda.potential import FULL_WAY, way_after
from progpolicy_envs.panda.scene import FALL_DEPTH, Scene


@dataclass(frozen=True)
class Mark:
    """A shape that pictures show for each object, in the object's colour, and that nothing in the world touches.

    :param shape: ``"sphere"``, ``"box"`` or ``"drum"``, which is an upright cylinder
    :param half_extents: half the size along x, y and z, metres; a radius is the first
    :param pale: whether the colour is made lighter
    """

    shape: Literal["sphere", "box", "drum"]
    half_extents: tuple[float, float, float]
    pale: bool = False


#: The target disc on the table.
DISC = Mark("drum", (0.05, 0.05, 0.001), pale=True)


class Task(ABC):
    """One task and its state in the running episode.

    ``positions`` (of what has to come to the targets), ``targets`` and ``finished`` have one entry per object. They are
    read at every step, so they are lists of plain floats, which are faster than small arrays.
    """

    table: ClassVar[Table] = Table()
    kind: ClassVar[ObjectKind | None] = None
    #: Distance from the target within which an object counts as there, metres.
    tolerance: ClassVar[float] = 0.05
    #: What pictures show of each object besides itself; the first shows its target.
    marks: ClassVar[tuple[Mark, ...]] = (DISC,)

    def __init__(self) -> None:
        self.starts: list[Point] = []
        self.positions: list[Point] = []
        self.targets: list[Point] = []
        self.finished: list[bool] = []
        #: How many objects were finished when the episode began.
        self.n_done = 0

    def place(self, scene: Scene, starts: Points, targets: Points, n_done: int = 0, neutral: bool = False) -> None:
        """Begin an episode: put the robot and the objects into the world.

        :param scene: the world
        :param starts: centres of the objects, metres, ``(n, 3)``; ``(0, 3)`` for Reach
        :param targets: ``(n, 3)``
        :param n_done: how many objects are finished: the first ones are at their targets, not at their starts
        :param neutral: whether the gripper is in its neutral pose even so, and not where it finished the last of them
        """
        self.starts = [tuple(start) for start in starts.tolist()]
        self.targets = [tuple(target) for target in targets.tolist()]
        self.finished = [index < n_done for index in range(len(self.targets))]
        self.n_done = n_done
        self.positions = [*self.targets[:n_done], *self.starts[n_done:]]
        hand = None if neutral or not n_done else self.hand_after(n_done - 1)
        scene.place(self.positions if self.kind else [], hand)
        self.positions = self._positions(scene)

    def hand_after(self, index: int) -> Hand | None:
        """Return where the gripper is that has just finished an object; ``None`` for the neutral pose."""
        return None

    def read_start(self, n_objects: int, starts: Any, targets: Any, n_done: int = 0) -> tuple[Points, Points]:
        """Return starts and targets that a user gives, ``(n, 3)`` each, as :meth:`place` takes them.

        :param n_objects: how many objects
        :param starts: x and y of each object's centre, metres; z too, if it is that of an object on the table
        :param targets: in the same form
        :param n_done: how many objects are finished, so that their starts do not matter
        :raises ValueError: if they are not of that form, or if objects would touch each other or the robot
        """
        assert self.kind is not None
        starts = read_points("starts", starts, np.full(n_objects, self.kind.height))
        targets = read_points("targets", targets, self.target_heights(n_objects))
        for name, points in (("starts", starts), ("targets", targets)):
            check_on_table(name, points, self.table)
        finished = self.lying(targets[:n_done])
        name = "starts" if not n_done else f"{len(finished)} finished and {n_objects - n_done} others"
        check_apart(name, np.concatenate([finished, starts[n_done:]]), self.kind)
        return starts, targets

    def lying(self, finished: Points) -> Points:
        """Return the places on the table that finished objects take up.

        :param finished: their targets, ``(n_done, 3)``
        """
        return finished

    def target_heights(self, n_objects: int) -> Points:
        """Return the heights of the targets, metres, ``(n,)``."""
        assert self.kind is not None
        return np.full(n_objects, self.kind.height)

    def update(self, scene: Scene) -> None:
        """Read the state of the world after a control step."""
        self.positions = self._positions(scene)
        self.finished = self._finished(scene)

    @property
    def focus(self) -> int:
        """Index of the first unfinished object in colour order; the last one when all are finished."""
        return self.finished.index(False) if False in self.finished else len(self.finished) - 1

    @property
    def failed(self) -> bool:
        """Whether an object has left the table."""
        for position in self.positions:  # noqa: SIM110 - a generator costs more in what every step does
            if position[2] < -FALL_DEPTH:
                return True
        return False

    @property
    def out_of_reach(self) -> bool:
        """Whether an unfinished object is where the arm cannot work at it, so that the task cannot be done any more."""
        return any(
            not finished and not in_reach(position)
            for finished, position in zip(self.finished, self.positions, strict=True)
        )

    def distance_left(self) -> float:
        """Return how far all objects are from their targets in all, finished ones too, metres."""
        return sum(map(math.dist, self.positions, self.targets))

    def way_left(self, scene: Scene) -> float:
        """Return the length of the gripper's ways to the objects that are unfinished, metres, 0 when there are none.

        The first of them is that to the object in focus, in which leaving a finished object comes first; each of the
        others counts :data:`~progpolicy_envs.panda.potential.FULL_WAY`.
        """
        if False not in self.finished:
            return 0.0
        finished = [place for place, done in zip(self.positions, self.finished, strict=True) if done]
        way = way_after(self.approach(scene, self.focus), scene.robot.position, finished)
        return way + FULL_WAY * (self.finished.count(False) - 1)

    def settled(self, scene: Scene, index: int) -> bool:
        """Return whether an object would be finished if it were at its target: whether all other conditions hold."""
        return True

    @abstractmethod
    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return starts (``(n, 3)``; ``(0, 3)`` for Reach) and targets ``(n, 3)``."""

    @abstractmethod
    def approach(self, scene: Scene, index: int) -> float:
        """Return the length of the gripper's way to where it moves an object from, metres."""

    @abstractmethod
    def approach_point(self, index: int) -> Point | None:
        """Return the point from which the gripper moves an object; ``None`` where there is none."""

    def mark_positions(self, index: int) -> tuple[Point | None, ...]:
        """Return where pictures show each of an object's :attr:`marks`; ``None`` for one that they do not show."""
        x, y, _ = self.targets[index]
        return ((x, y, 0.001),)

    def pin_positions(self, index: int) -> tuple[Point | None, ...]:
        """Return the points over which pictures show a pin while an object is in focus."""
        return self.mark_positions(index)[0], self.positions[index]

    def _positions(self, scene: Scene) -> list[Point]:
        return scene.positions

    def _finished(self, scene: Scene) -> list[bool]:
        """Return which objects are finished, given which were before and where all are now."""
        tolerance = self.tolerance
        return [
            math.dist(position, target) < tolerance
            for position, target in zip(self.positions, self.targets, strict=True)
        ]
