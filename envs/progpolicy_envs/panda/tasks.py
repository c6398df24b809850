"""The four tasks: where things start, when an object is finished, and from where the gripper works on it."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.panda.placement import (
    Points,
    corridor_distances,
    distances,
    extended,
    reachable,
    sample_in_order,
)
from progpolicy_envs.panda.scene import FALL_DEPTH, ObjectKind, Scene, Table

Point = NDArray[np.float64]


class Task(ABC):
    """One task and its state in the running episode.

    Attributes: ``targets`` ``(n, 3)``, ``finished`` ``(n,)`` and ``positions`` ``(n, 3)``, what is to be brought to
    the targets.
    """

    table: Table = Table()
    kind: ObjectKind | None = None
    #: Distance from the target within which an object counts as there, metres.
    tolerance: float = 0.05

    def __init__(self) -> None:
        self.targets: Points = np.zeros((0, 3))
        self.positions: Points = np.zeros((0, 3))
        self.finished: NDArray[np.bool_] = np.zeros(0, dtype=bool)

    def reset(self, scene: Scene, rng: np.random.Generator, n_objects: int) -> None:
        """Draw starts and targets and place the objects.

        :param scene: the world
        :param rng: the only source of chance
        :param n_objects: how many objects, or targets of Reach
        """
        starts, self.targets = self.sample(rng, n_objects)
        scene.place(starts)
        self.finished = np.zeros(n_objects, dtype=bool)
        self.positions = self._positions(scene)

    def update(self, scene: Scene) -> None:
        """Take over the state of the world after a control step."""
        self.positions = self._positions(scene)
        self.finished = self._finished(scene)

    @property
    def focus(self) -> int:
        """Index of the first unfinished object in colour order; the last one when all are finished."""
        return int(self.finished.argmin()) if not self.finished.all() else len(self.finished) - 1

    @property
    def failed(self) -> bool:
        """Whether an object has left the table."""
        return bool((self.positions[:, 2] < -FALL_DEPTH).any())

    def settled(self, scene: Scene, index: int) -> bool:
        """Return whether an object at its target would count as finished, as far as the gripper is concerned."""
        return True

    @abstractmethod
    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return starts (``(n, 3)``; ``(0, 3)`` for Reach) and targets ``(n, 3)``."""

    @abstractmethod
    def handle(self, index: int) -> Point | None:
        """Return the point ``(3,)`` from which the gripper works on an object; ``None`` where there is none."""

    def _positions(self, scene: Scene) -> Points:
        return scene.positions

    def _finished(self, scene: Scene) -> NDArray[np.bool_]:
        offsets = self.positions - self.targets
        return (offsets * offsets).sum(axis=1) < self.tolerance**2


class Reach(Task):
    """The gripper visits the targets in order."""

    separation = 0.1

    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return no starts and targets in the air, apart from each other and from the gripper's start."""
        gripper = np.array([[0.04, 0.0, 0.2]])

        def propose(number: int) -> tuple[Points, Points]:
            targets = rng.uniform((-0.2, -0.25, 0.05), (0.13, 0.25, 0.35), (number, 3))
            return targets, targets

        def accept(starts: Points, targets: Points, _: Points, before: Points) -> NDArray[np.bool_]:
            return distances(targets, np.concatenate((gripper, before))) > self.separation

        return np.zeros((0, 3)), sample_in_order(n_objects, propose, accept)[1]

    def handle(self, index: int) -> Point | None:
        """Return ``None``: the gripper itself is what moves."""
        return None

    def _positions(self, scene: Scene) -> Points:
        return np.broadcast_to(scene.robot.position, self.targets.shape)

    def _finished(self, scene: Scene) -> NDArray[np.bool_]:
        finished = self.finished.copy()
        index = self.focus
        finished[index] |= bool(np.linalg.norm(scene.robot.position - self.targets[index]) < self.tolerance)
        return finished


class Push(Task):
    """Every block lies within 5 cm of its target, all at once."""

    kind = ObjectKind("box", (0.02, 0.02, 0.02), mass=1.0, friction=0.5)
    separation, clearance = 0.09, 0.08
    run_up = 0.08

    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return blocks and targets so that each block in colour order can be pushed straight to its target."""

        def propose(number: int) -> tuple[Points, Points]:
            points = rng.uniform((-0.3, -0.27), (0.1, 0.27), (2, number, 2))
            return points[0], points[1]

        def accept(starts: Points, targets: Points, before: Points, done: Points) -> NDArray[np.bool_]:
            behind = extended(starts, targets, self.run_up)
            length = np.linalg.norm(targets - starts, axis=1)
            fits = (length > 0.1) & (length < 0.35) & reachable(behind) & reachable(starts) & reachable(targets)
            fits &= (distances(starts, before) > self.separation) & (distances(targets, done) > self.separation)
            if len(before):
                # While this block is pushed the earlier ones lie on their targets, and the other way round.
                fits &= (corridor_distances(behind, targets, done) > self.clearance).all(axis=1)
                ways = corridor_distances(extended(before, done, self.run_up), done, starts)
                fits &= (ways > self.clearance).all(axis=0)
            return fits

        return _on_table(*sample_in_order(n_objects, propose, accept), height=self.kind.height)

    def handle(self, index: int) -> Point:
        """Return the point behind the block on the line to its target."""
        return _behind(self.positions[index], self.targets[index], 0.05)


class Slide(Task):
    """Every puck has been inside its target disc, beyond the arm's reach; it is then taken off the table."""

    table = Table(low_x=-0.8, high_x=0.6)
    kind = ObjectKind("cylinder", (0.03, 0.03, 0.015), mass=1.0, friction=0.04)
    separation, clearance = 0.1, 0.085
    run_up = 0.09
    #: Tangent of the largest angle between the x axis and the way to the target.
    slope = 0.4

    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return pucks near the robot and targets out of its reach, the ways in colour order free."""

        def propose_starts(number: int) -> tuple[Points, Points]:
            starts = rng.uniform((-0.3, -0.28), (-0.02, 0.28), (number, 2))
            return starts, starts

        def apart(starts: Points, _: Points, before: Points, __: Points) -> NDArray[np.bool_]:
            return reachable(starts) & (distances(starts, before) > self.separation)

        while True:
            starts = sample_in_order(n_objects, propose_starts, apart)[0]
            # The front pucks come first, so that they do not bar the way of those behind them.
            starts = starts[np.argsort(-starts[:, 0])]
            targets = self._sample_targets(rng, starts)
            if len(targets) == n_objects:
                return _on_table(starts, targets, height=self.kind.height)

    def _sample_targets(self, rng: np.random.Generator, starts: Points) -> Points:
        """Return targets ``(m, 2)`` for the first m pucks; fewer than there are pucks where one finds no place."""
        targets = np.zeros((0, 2))
        for index, start in enumerate(starts):
            candidates = rng.uniform((0.3, -0.28), (0.54, 0.28), (256, 2))
            ways = candidates - start
            run_up = extended(start, candidates, self.run_up)
            fits = np.abs(ways[:, 1]) < self.slope * ways[:, 0]
            fits &= distances(candidates, targets) > 2 * self.tolerance
            fits &= (corridor_distances(run_up, candidates, starts[index + 1 :]) > self.clearance).all(axis=1)
            if not fits.any():
                break
            targets = np.concatenate((targets, candidates[fits][:1]))
        return targets

    def update(self, scene: Scene) -> None:
        """Take over the state of the world and take delivered pucks off the table."""
        before = self.finished
        super().update(scene)
        for index in np.flatnonzero(self.finished & ~before):
            scene.park(int(index))

    def handle(self, index: int) -> Point:
        """Return the point behind the puck on the line to its target."""
        return _behind(self.positions[index], self.targets[index], 0.06)

    def _positions(self, scene: Scene) -> Points:
        # A delivered puck keeps the place where it was delivered, although it is off the table.
        return np.where(self.finished[:, None], self.positions, scene.positions) if self.finished.any() else (
            scene.positions
        )

    def _finished(self, scene: Scene) -> NDArray[np.bool_]:
        return self.finished | super()._finished(scene)


class Stack(Task):
    """The blocks stand on each other in colour order at the tower's place, at rest, the gripper away from them."""

    kind = ObjectKind("box", (0.02, 0.02, 0.02), mass=1.0, friction=0.5)
    tolerance = 0.03
    #: A block that moves less than this in one control step is at rest, metres.
    rest_motion = 0.001

    def __init__(self) -> None:
        super().__init__()
        self._before: Points = self.positions

    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return blocks that the open gripper can pick up and their places in a tower beside them."""
        foot = rng.uniform((-0.02, -0.12), (0.08, 0.12))

        def propose(number: int) -> tuple[Points, Points]:
            starts = rng.uniform((-0.32, -0.28), (0.08, 0.28), (number, 2))
            return starts, np.broadcast_to(foot, starts.shape)

        def accept(starts: Points, targets: Points, before: Points, done: Points) -> NDArray[np.bool_]:
            x, y = (starts - targets).T
            # The wrist behind the gripper must not meet the tower, nor the hand, which is 20 cm wide.
            fits = ((x < -0.1) | (np.abs(y) > 0.2)) & reachable(starts)
            apart = np.abs(starts[:, None] - before[None])
            return fits & ((apart[..., 0] > 0.07) | (apart[..., 1] > 0.11)).all(axis=1)

        starts, targets = _on_table(*sample_in_order(n_objects, propose, accept), height=self.kind.height)
        targets[:, 2] += 2 * self.kind.height * np.arange(n_objects)
        return starts, targets

    def reset(self, scene: Scene, rng: np.random.Generator, n_objects: int) -> None:
        """Draw starts and the tower's place and place the blocks."""
        super().reset(scene, rng, n_objects)
        self._before = self.positions

    def update(self, scene: Scene) -> None:
        """Take over the state of the world after a control step."""
        super().update(scene)
        self._before = self.positions

    def handle(self, index: int) -> Point:
        """Return the block's own position."""
        return self.positions[index]

    def settled(self, scene: Scene, index: int) -> bool:
        """Return whether the block is at rest and the gripper away from it."""
        return bool(self._at_rest()[index] and self._released(scene)[index])

    def _finished(self, scene: Scene) -> NDArray[np.bool_]:
        return super()._finished(scene) & self._at_rest() & self._released(scene)

    def _at_rest(self) -> NDArray[np.bool_]:
        return np.abs(self.positions - self._before).max(axis=1) < self.rest_motion

    def _released(self, scene: Scene) -> NDArray[np.bool_]:
        # A block is free of the gripper when the fingertips are above it or the gripper is beside it.
        x, y, z = (scene.robot.position - self.positions).T
        return (z > 0.03) | (x * x + y * y > 0.06**2)


def _on_table(starts: Points, targets: Points, height: float) -> tuple[Points, Points]:
    return tuple(np.column_stack((points, np.full(len(points), height))) for points in (starts, targets))  # type: ignore[return-value]


def _behind(position: Point, target: Point, back: float) -> Point:
    way = target - position
    length = max(float(np.hypot(way[0], way[1])), 1e-6)
    return position - (back / length) * np.array((way[0], way[1], 0.0))
