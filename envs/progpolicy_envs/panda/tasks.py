"""The four tasks: reach, push, slide and stack."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.panda.physics import Hand, ObjectKind, Point, Table
from progpolicy_envs.panda.placement import (
    Place,
    Points,
    all_apart,
    all_extended,
    all_within,
    apart,
    corridor_distance,
    corridor_distances,
    extended,
    in_reach,
    reachable,
    read_points,
    sample_in_order,
)
from progpolicy_envs.panda.potential import way_behind, way_onto
from progpolicy_envs.panda.robot import BASE_POSITION, MAX_WIDTH, beyond_reach
from progpolicy_envs.panda.scene import Scene
from progpolicy_envs.panda.task import DISC, Mark, Task

#: How far behind a block and a puck the gripper has to be to push it, metres, and how much nearer it is in contact.
BEHIND_BLOCK, BEHIND_PUCK, GAP = 0.05, 0.06, 0.02
#: How high above a block that has been stacked the gripper rises, metres.
RISEN = 0.06
#: An object that moves less than this in one control step is at rest, metres.
REST_MOTION = 0.001


class Reach(Task):
    """The gripper visits the targets in order."""

    marks = (Mark("sphere", (0.02, 0.02, 0.02)),)
    separation = 0.1

    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return no starts and targets in the air, apart from each other and from the gripper's start."""
        gripper = (0.04, 0.0, 0.2)

        def propose(number: int) -> tuple[Points, Points]:
            targets = rng.uniform((-0.2, -0.25, 0.05), (0.13, 0.25, 0.35), (number, 3))
            return targets, targets

        def fits(_: Place, target: Place, before: Sequence[Place], __: Sequence[Place]) -> bool:
            return apart(target, [gripper, *before], self.separation)

        return np.zeros((0, 3)), sample_in_order(n_objects, propose, fits)[1]

    def approach_point(self, index: int) -> Point | None:
        """Return ``None``: the gripper itself is what moves."""
        return None

    def hand_after(self, index: int) -> Hand:
        """Return the target itself."""
        return Hand(self.targets[index])

    @property
    def out_of_reach(self) -> bool:
        """``False``: there are no objects."""
        return False

    def distance_left(self) -> float:
        """Return the length of the gripper's way through the targets that are left, metres."""
        if False not in self.finished:
            return 0.0
        left = [self.positions[0], *self.targets[self.focus :]]
        return sum(map(math.dist, left, left[1:]))

    def way_left(self, scene: Scene) -> float:
        """Return 0: the gripper itself is what moves."""
        return 0.0

    def approach(self, scene: Scene, index: int) -> float:
        """Return 0: the gripper itself is what moves."""
        return 0.0

    def read_start(self, n_objects: int, starts: Any, targets: Any, n_done: int = 0) -> tuple[Points, Points]:
        """Return no starts, and targets that a user gives.

        :param n_objects: how many targets
        :param starts: not used
        :param targets: x, y and z of each target, metres
        :param n_done: not used
        :raises ValueError: if they are not of that form, below the table's top, or out of the arm's reach
        """
        points = read_points("targets", targets, np.full(n_objects, np.nan))
        if (points[:, 2] < 0).any():
            raise ValueError(f"targets={points.tolist()} are not accepted; z is above the table, at least 0")
        for point in points.tolist():
            if (beyond := beyond_reach(*point)) > self.tolerance:
                raise ValueError(
                    f"targets={points.tolist()} are not accepted; the gripper comes no nearer to {point} than "
                    f"{beyond:.2f} m, and {self.tolerance} m is near enough"
                )
        return np.zeros((0, 3)), points

    def mark_positions(self, index: int) -> tuple[Point | None, ...]:
        """Return the target, until it has been visited."""
        return (None if self.finished[index] else self.targets[index],)

    def pin_positions(self, index: int) -> tuple[Point | None, ...]:
        """Return the target."""
        return (self.targets[index],)

    def _positions(self, scene: Scene) -> list[Point]:
        return [scene.robot.position] * len(self.targets)

    def _finished(self, scene: Scene) -> list[bool]:
        # A target counts only once those before it have been visited.
        finished, focus = self.finished, self.focus
        if finished[focus] or math.dist(self.positions[focus], self.targets[focus]) >= self.tolerance:
            return finished
        return [*finished[:focus], True, *finished[focus + 1 :]]


class Push(Task):
    """Every block lies within 5 cm of its target, all at once."""

    kind = ObjectKind("box", (0.02, 0.02, 0.02), mass=1.0, friction=0.5)
    separation, clearance = 0.09, 0.08
    run_up = 0.08

    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return blocks and targets so that each block in colour order can be pushed straight to its target."""
        low, high = np.array((-0.3, -0.27)), np.array((0.1, 0.27))
        nearest, farthest = 0.1, 0.35

        def propose(number: int) -> tuple[Points, Points]:
            # What rng.uniform computes, in a third of the time.
            points = low + (high - low) * rng.random((2, number, 2))
            return points[0], points[1]

        def fits(start: Place, target: Place, before: Sequence[Place], done: Sequence[Place]) -> bool:
            if not (nearest < math.dist(start, target) < farthest and reachable(start) and reachable(target)):
                return False
            if not (apart(start, before, self.separation) and apart(target, done, self.separation)):
                return False
            behind = extended(start, target, self.run_up)
            # While this block is pushed the earlier ones lie on their targets; while they are, it lies at its start.
            return reachable(behind) and all(
                corridor_distance(behind, target, there) > self.clearance
                and corridor_distance(extended(here, there, self.run_up), there, start) > self.clearance
                for here, there in zip(before, done, strict=True)
            )

        def screen(
            starts: Points, targets: Points, before: Sequence[Place], done: Sequence[Place]
        ) -> NDArray[np.bool_]:
            # The same tests for many, wider by epsilon because arrays round differently; the expensive ones come last.
            epsilon, base = 1e-9, np.array(BASE_POSITION[:2])
            in_reach = 0.26 - epsilon, 0.74 + epsilon
            keep = all_within(starts, targets, nearest - epsilon, farthest + epsilon)
            keep &= all_within(starts, base, *in_reach) & all_within(targets, base, *in_reach)
            if before:
                heres, theres, far = np.array(before), np.array(done), self.separation - epsilon
                keep[keep] = all_apart(starts[keep], heres, far)
                keep[keep] = all_apart(targets[keep], theres, far)
                starts, targets, clear = starts[keep, None], targets[keep, None], self.clearance - epsilon
                behind, others = all_extended(starts, targets, self.run_up), all_extended(heres, theres, self.run_up)
                free = corridor_distances(behind, targets, theres) > clear
                free &= corridor_distances(others, theres, starts) > clear
                keep[keep] = free.all(axis=1)
            return keep

        return _on_table(*sample_in_order(n_objects, propose, fits, screen), height=self.kind.height)

    def hand_after(self, index: int) -> Hand:
        """Return the place behind the block on the straight way that it has come."""
        return Hand(_beyond(self.targets[index], self.starts[index], BEHIND_BLOCK))

    def approach_point(self, index: int) -> Point:
        """Return the point behind the block on the line to its target."""
        return _behind(self.positions[index], self.targets[index], BEHIND_BLOCK)

    def approach(self, scene: Scene, index: int) -> float:
        """Return the way behind the block."""
        places = self.positions[index], self.targets[index]
        return way_behind(scene.robot.position, *places, BEHIND_BLOCK, BEHIND_BLOCK - GAP)


class Slide(Task):
    """Every puck has been inside its target disc, beyond the arm's reach; it is then taken off the table."""

    table = Table(low_x=-0.8, high_x=0.6)
    kind = ObjectKind("cylinder", (0.03, 0.03, 0.015), mass=1.0, friction=0.04)
    marks = (DISC, Mark("drum", kind.half_extents))
    clearance = 0.08
    run_up = 0.06
    #: Half axes of the ellipse around a puck in which no other starts; longer along x, the way to the targets.
    separation = (0.14, 0.1)
    #: Tangent of the largest angle between the x axis and the way to the target.
    slope = 0.4

    def __init__(self) -> None:
        super().__init__()
        self._before: list[Point] = []

    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return pucks near the robot and targets out of its reach, the ways in colour order free."""

        def propose(number: int) -> tuple[Points, Points]:
            starts = rng.uniform((-0.28, -0.28), (0.02, 0.28), (number, 2))
            return starts, starts

        def fits(start: Place, _: Place, before: Sequence[Place], __: Sequence[Place]) -> bool:
            wide, deep = self.separation
            return reachable(start, 0.34, 0.64) and all(
                math.hypot((start[0] - x) / wide, (start[1] - y) / deep) > 1 for x, y in before
            )

        while True:
            starts = sample_in_order(n_objects, propose, fits)[0]
            # The front pucks come first, so that they are not in the way of those behind them.
            starts = starts[np.argsort(-starts[:, 0])]
            targets = self._sample_targets(rng, starts.tolist())
            if len(targets) == n_objects:
                return _on_table(starts, np.array(targets), height=self.kind.height)

    def _sample_targets(self, rng: np.random.Generator, starts: Sequence[Place]) -> list[Place]:
        """Return targets, x and y, in the order of the pucks, up to the first puck for which there is no place."""
        targets: list[Place] = []
        for index, start in enumerate(starts):
            candidates: list[Place] = rng.uniform((0.3, -0.29), (0.54, 0.29), (128, 2)).tolist()
            found = next(
                (place for place in candidates if self._fits(start, place, starts[index + 1 :], targets)), None
            )
            if found is None:
                break
            targets.append(found)
        return targets

    def _fits(self, start: Place, target: Place, later: Sequence[Place], targets: Sequence[Place]) -> bool:
        """Return whether a target lies ahead of its puck, apart from the others, no later puck in the way."""
        if not abs(target[1] - start[1]) < self.slope * (target[0] - start[0]):
            return False
        run_up = extended(start, target, self.run_up)
        return apart(target, targets, 2 * self.tolerance) and all(
            corridor_distance(run_up, target, other) > self.clearance for other in later
        )

    def place(self, scene: Scene, starts: Points, targets: Points, n_done: int = 0, neutral: bool = False) -> None:
        """Begin an episode; the pucks that are delivered already are off the table. See :meth:`Task.place`."""
        super().place(scene, starts, targets, n_done, neutral)
        for index in range(n_done):
            scene.park(index)

    def lying(self, finished: Points) -> Points:
        """Return no places: delivered pucks are off the table."""
        return finished[:0]

    def update(self, scene: Scene) -> None:
        """Read the state of the world and take delivered pucks off the table."""
        before, self._before = self.finished, self.positions
        super().update(scene)
        if self.finished != before:
            for index, (old, new) in enumerate(zip(before, self.finished, strict=True)):
                if new and not old:
                    scene.park(index)

    def approach_point(self, index: int) -> Point:
        """Return the point behind the puck on the line to its target."""
        return _behind(self.positions[index], self.targets[index], BEHIND_PUCK)

    def approach(self, scene: Scene, index: int) -> float:
        """Return the way behind the puck."""
        return way_behind(
            scene.robot.position, self.positions[index], self.targets[index], BEHIND_PUCK, BEHIND_PUCK - GAP
        )

    @property
    def out_of_reach(self) -> bool:
        """Whether a puck lies still, neither delivered nor where the arm can work at it: most targets are beyond."""
        return any(
            not finished and not in_reach(position) and math.dist(position, before) < REST_MOTION
            for finished, position, before in zip(self.finished, self.positions, self._before, strict=True)
        )

    def mark_positions(self, index: int) -> tuple[Point | None, ...]:
        """Return the target's disc and, once the puck is delivered and off the table, the place where it was."""
        return *super().mark_positions(index), self.positions[index] if self.finished[index] else None

    def _positions(self, scene: Scene) -> list[Point]:
        # A delivered puck keeps the place where it was delivered, although it is off the table.
        if True not in self.finished:
            return scene.positions
        places = zip(self.finished, self.positions, scene.positions, strict=True)
        return [old if finished else new for finished, old, new in places]

    def _finished(self, scene: Scene) -> list[bool]:
        there = super()._finished(scene)
        return [old or new for old, new in zip(self.finished, there, strict=True)] if True in self.finished else there


class Stack(Task):
    """The blocks stand on each other in colour order at the tower's place, at rest, the gripper away from them."""

    kind = ObjectKind("box", (0.02, 0.02, 0.02), mass=1.0, friction=0.5, multibody=True)
    tolerance = 0.03
    marks = (Mark("box", (0.01, 0.01, 0.01)),)

    def __init__(self) -> None:
        super().__init__()
        self._before: list[Point] = []

    def sample(self, rng: np.random.Generator, n_objects: int) -> tuple[Points, Points]:
        """Return blocks that the open gripper can pick up and their places in a tower beside them."""
        foot = rng.uniform((-0.02, -0.12), (0.08, 0.12))

        def propose(number: int) -> tuple[Points, Points]:
            starts = rng.uniform((-0.32, -0.28), (0.08, 0.28), (number, 2))
            return starts, np.broadcast_to(foot, starts.shape)

        def fits(start: Place, target: Place, before: Sequence[Place], _: Sequence[Place]) -> bool:
            x, y = start[0] - target[0], start[1] - target[1]
            # The wrist behind the gripper must not meet the tower, nor the hand, which is 20 cm wide.
            beside = x < -0.1 or abs(y) > 0.2
            return (
                beside
                and reachable(start)
                and all(abs(start[0] - other[0]) > 0.07 or abs(start[1] - other[1]) > 0.11 for other in before)
            )

        starts, targets = _on_table(*sample_in_order(n_objects, propose, fits), height=self.kind.height)
        targets[:, 2] = self.target_heights(n_objects)
        return starts, targets

    def place(self, scene: Scene, starts: Points, targets: Points, n_done: int = 0, neutral: bool = False) -> None:
        """Begin an episode; the blocks that are stacked already are the lowest. See :meth:`Task.place`."""
        super().place(scene, starts, targets, n_done, neutral)
        self._before = self.positions

    def hand_after(self, index: int) -> Hand:
        """Return the place above the tower to which the open gripper rises."""
        x, y, z = self.targets[index]
        return Hand((x, y, z + RISEN), MAX_WIDTH)

    def lying(self, finished: Points) -> Points:
        """Return the place of the tower."""
        return finished[:1]

    def target_heights(self, n_objects: int) -> Points:
        """Return the heights of the blocks in the tower, metres, ``(n,)``."""
        height = self.kind.height
        return np.array([height + 2 * height * level for level in range(n_objects)])

    def read_start(self, n_objects: int, starts: Any, targets: Any, n_done: int = 0) -> tuple[Points, Points]:
        """Return starts and targets as :meth:`Task.read_start` does; the targets have one x and one y, the tower's."""
        starts, targets = super().read_start(n_objects, starts, targets, n_done)
        if (targets[:, :2] != targets[0, :2]).any():
            raise ValueError(f"targets={targets.tolist()} are not accepted; x and y of a tower are the same in all")
        return starts, targets

    def update(self, scene: Scene) -> None:
        """Read the state of the world after a control step."""
        self._before = self.positions
        super().update(scene)

    def approach_point(self, index: int) -> Point:
        """Return the block's own position."""
        return self.positions[index]

    def approach(self, scene: Scene, index: int) -> float:
        """Return the way around the block, with open fingers."""
        return way_onto(scene.robot.position, scene.robot.width, self.positions[index], MAX_WIDTH)

    def mark_positions(self, index: int) -> tuple[Point | None, ...]:
        """Return a place in a small model of the tower, which stands beside it, where the gripper does not hide it."""
        x, y, _ = self.targets[index]
        return ((x + 0.12, y, 0.01 + 0.02 * index),)

    def settled(self, scene: Scene, index: int) -> bool:
        """Return whether the block is at rest and free of the gripper: fingertips above it, or beside it."""
        x, y, z = self.positions[index]
        gripper_x, gripper_y, gripper_z = scene.robot.position
        free = gripper_z - z > 0.03 or math.hypot(gripper_x - x, gripper_y - y) > 0.06
        return free and math.dist(self.positions[index], self._before[index]) < REST_MOTION

    def _finished(self, scene: Scene) -> list[bool]:
        there = super()._finished(scene)
        if True not in there:
            return there
        return [near and self.settled(scene, index) for index, near in enumerate(there)]


def _on_table(starts: Points, targets: Points, height: float) -> tuple[Points, Points]:
    heights = np.full((len(starts), 1), height)
    return np.hstack((starts, heights)), np.hstack((targets, heights))


def _beyond(place: Point, other: Point, way: float) -> Point:
    """Return the point so far from a place in the direction of another one."""
    x, y, z = place
    way_x, way_y = other[0] - x, other[1] - y
    share = way / max(math.hypot(way_x, way_y), 1e-6)
    return x + share * way_x, y + share * way_y, z


def _behind(position: Point, target: Point, back: float) -> Point:
    x, y, z = position
    way_x, way_y = target[0] - x, target[1] - y
    share = back / max(math.hypot(way_x, way_y), 1e-6)
    return x - share * way_x, y - share * way_y, z
