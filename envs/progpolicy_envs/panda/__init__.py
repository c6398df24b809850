"""Four manipulation tasks for a Franka Panda in PyBullet, on any number of objects behind one observation."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import numpy as np

from progpolicy_envs.documentation import with_sections
from progpolicy_envs.panda.env import Action, FlatObservation, Observation, PandaEnv
from progpolicy_envs.panda.goal import EntryPoint, PandaGoalEnv
from progpolicy_envs.panda.physics import MAX_OBJECTS, PANDA_GYM_PHYSICS, Physics
from progpolicy_envs.panda.sections import SECTIONS
from progpolicy_envs.panda.tasks import Push, Reach, Slide, Stack, Task
from progpolicy_envs.planners import panda as controllers
from progpolicy_envs.single import require_reset
from progpolicy_envs.variation import IntParameter, VariationSpace, check_n_done, n_done_parameter

__all__ = [
    "PANDA_GYM_PHYSICS",
    "PandaEnv",
    "PandaGoalEnv",
    "PandaPushEnv",
    "PandaPushGoalEnv",
    "PandaReachEnv",
    "PandaReachGoalEnv",
    "PandaSlideEnv",
    "PandaSlideGoalEnv",
    "PandaStackEnv",
    "PandaStackGoalEnv",
    "Physics",
    "make_push",
    "make_reach",
    "make_slide",
    "make_stack",
]


class _ObjectsEnv(PandaEnv):
    """What the three environments with objects have in common."""

    variations: ClassVar[VariationSpace] = VariationSpace(
        IntParameter("n_objects", 1, MAX_OBJECTS, 1, "number of objects"),
        n_done_parameter(MAX_OBJECTS - 1, "objects that are finished"),
        check=partial(check_n_done, size="n_objects"),
        starts={"starts": "x and y of each object, metres", "targets": "x and y of each target, metres"},
    )

    def __init__(
        self,
        n_objects: int = 1,
        *,
        reward_type: str = "dense",
        render_mode: str | None = None,
        physics: Physics | None = None,
        context: str = "hidden",
        n_done: int | str = 0,
    ) -> None:
        variation = {"n_objects": n_objects, "n_done": n_done}
        super().__init__(variation, reward_type=reward_type, render_mode=render_mode, physics=physics, context=context)


@with_sections(SECTIONS, id="PandaReach-v0", size="n_targets", things="targets")
class PandaReachEnv(PandaEnv):
    """Visit coloured points in the air with the gripper, in order.

    ## Description
    A target is visited when the gripper comes within 5 cm of it while it is in focus. The object of the observation
    is the gripper itself.

    $colours

    $spaces

    ### What a short program can do with it
    The way to the target is in the observation as a difference, so one affine controller is enough: 20 times
    ``target_d`` is a full step towards it and less when it is near. The focus does the rest, for any number of
    targets.

    ## Rewards
    ``reward_type="dense"`` (default), the sum of

    * 10 per metre by which the object in focus came closer to its target,
    $rewards

    ``reward_type="potential"``: $gains

    * -10 per metre of the gripper's way through the targets that are left, in order,
    * 1 for every target that has been visited.

    ``reward_type="sparse"``: 0 where the object in focus is at its target, -1 otherwise.

    ## Starting State
    The arm in its neutral pose, the gripper near (0.04, 0, 0.2), fingers closed. Targets by seed in a box of 33 x
    50 x 30 cm, at least 10 cm apart and from the gripper. ``env.reset(options={"targets": [[0.1, 0.2, 0.3]]})`` gives
    them instead, in metres; ``env.unwrapped.start`` is what the present episode started with, in this form. With
    ``n_done`` above 0 the first targets have been visited, and the gripper is at the last of these.

    ## Episode End
    Terminated when the last target is visited; truncated after 500 steps (``max_episode_steps``).

    $rules
    """

    task_class: ClassVar[type[Task]] = Reach
    variations: ClassVar[VariationSpace] = VariationSpace(
        IntParameter("n_targets", 1, MAX_OBJECTS, 1, "number of targets"),
        n_done_parameter(MAX_OBJECTS - 1, "targets that have been visited"),
        check=partial(check_n_done, size="n_targets"),
        starts={"targets": "x, y and z of each target, metres"},
    )
    controller: ClassVar[Callable[[FlatObservation], Action]] = staticmethod(controllers.reach)

    def __init__(
        self,
        n_targets: int = 1,
        *,
        reward_type: str = "dense",
        render_mode: str | None = None,
        physics: Physics | None = None,
        context: str = "hidden",
        n_done: int | str = 0,
    ) -> None:
        variation = {"n_targets": n_targets, "n_done": n_done}
        super().__init__(variation, reward_type=reward_type, render_mode=render_mode, physics=physics, context=context)


@with_sections(SECTIONS, id="PandaPush-v0", size="n_objects", things="blocks")
class PandaPushEnv(_ObjectsEnv):
    """Bring every block to the disc of its colour on the table.

    ## Description
    Blocks of 4 cm and 1 kg lie on the table. The task is done when all of them are within 5 cm of their targets at
    once.

    $colours

    $spaces

    ### What a short program can do with it
    One affine test is neither an interval nor an "and". But each branch is reached only where the tests before it
    fail, and ``reach`` and ``distance`` are lengths already, so that one affine test of a length and a height bounds
    a cone. Five branches are enough: in a funnel above the block, go down with open fingers; high above the table,
    fly over the block; low and not around it, rise; around it with open fingers, close them; otherwise draw it along
    the line. Positions relative to the gripper make every command a weighted sum, in which neither a place on the
    table nor the number of blocks occurs. Which of these is to be done is not in the observation.

    ## Rewards
    ``reward_type="dense"`` (default), the sum of

    * 10 per metre by which the object in focus came closer to its target,
    * 5 per metre by which the gripper came closer to the point 5 cm behind the object, seen from its target,
    $rewards

    ``reward_type="potential"``: $gains

    $left
    * -5 per metre of the gripper's way to where it pushes the block in focus from: 3 to 5 cm behind its centre, seen
      from the target, at its height. The way is the horizontal distance from there, plus half of the height above the
      centre, plus 1.5 times the height that the gripper lacks: it should be 0.8 times as high above the centre as it is
      away, up to 8 cm, and 5 cm over the block itself. So the way leads through the air, down behind the block, and
      no place on top of the block or around it is at rest,
    $leaving

    $reach

    ``reward_type="sparse"``: 0 where the object in focus is at its target, -1 otherwise.

    ## Starting State
    The arm in its neutral pose, fingers closed. Blocks and targets by seed, in reach, at least 9 cm apart from
    their like, 10 to 35 cm from block to target; taken in colour order every straight way, with a run-up of 8 cm,
    is 8 cm clear of the other blocks. With ``n_done`` above 0 the first blocks lie on their targets, and the gripper is
    5 cm behind the last of these, at its height, on the straight way that it has come.

    $start

    ## Episode End
    Terminated when every object is finished, or as a failure when one leaves the table or, with
    ``reward_type="potential"``, is out of reach; truncated after 500 steps (``max_episode_steps``).

    $rules
    """

    task_class: ClassVar[type[Task]] = Push
    controller: ClassVar[Callable[[FlatObservation], Action]] = staticmethod(controllers.push)


@with_sections(SECTIONS, id="PandaSlide-v0", size="n_objects", things="pucks")
class PandaSlideEnv(_ObjectsEnv):
    """Give every puck a push that makes it slide to the disc of its colour, beyond the arm's reach.

    ## Description
    Pucks of 6 cm and 1 kg lie on a slippery table. A puck is delivered when its centre has been within 5 cm of its
    target's at the end of a step, at whatever speed; it is then taken off the table. The task is done when all are
    delivered.

    $colours

    $spaces

    A delivered puck keeps the position at which it was delivered.

    ### What a short program can do with it
    Seven branches are enough, in this order: at the end of the arm's reach, draw back; not behind the puck, fly there;
    low behind a puck at rest, take it gently into the middle between the fingers; low behind a puck that moves, push;
    puck under way, draw back; behind it and high, go down; otherwise fly there. "Behind", "low" and "near" are sums of
    ``object_d``, ``gripper`` and ``reach``. A push goes in the direction of ``line`` and corrects the puck's offset
    across it; its speed, ``0.3 + 0.75 * object_v``, keeps the fingers a little faster than the puck, so that they do
    not lose it. Which speed or which way is right is not in the observation.

    ## Rewards
    ``reward_type="dense"`` (default), the sum of

    * 10 per metre by which the object in focus came closer to its target,
    * 5 per metre by which the gripper came closer to the point 6 cm behind the object, seen from its target,
    $rewards

    ``reward_type="potential"``: $gains

    $left
    * -5 per metre of the gripper's way to where it pushes the puck in focus from: 4 to 6 cm behind its centre, seen
      from the target, at its height. The way is the horizontal distance from there, plus half of the height above the
      centre, plus 1.5 times the height that the gripper lacks: it should be 0.8 times as high above the centre as it is
      away, up to 8 cm, and 5 cm over the puck itself; 0.6 m more for every other puck that is left,
    * 1 for every delivered puck.

    With it, a puck that lies still beyond 80 cm from the axis on which the arm turns, not delivered, ends the episode
    as a failure; most targets are beyond.

    ``reward_type="sparse"``: 0 where the object in focus is at its target, -1 otherwise.

    ## Starting State
    The arm in its neutral pose, fingers closed. Pucks by seed in the near half of the table, the front ones first
    in colour order; targets at x from 0.3 to 0.54, at most 22 degrees off the x axis as seen from their pucks;
    taken in colour order every straight way is 8 cm clear of the other pucks. With ``n_done`` above 0 the first pucks
    have been delivered; the arm is in its neutral pose.

    $start

    ## Episode End
    Terminated when every object is finished, or as a failure when one leaves the table or, with
    ``reward_type="potential"``, is out of reach; truncated after 500 steps (``max_episode_steps``).

    $rules
    """

    task_class: ClassVar[type[Task]] = Slide
    controller: ClassVar[Callable[[FlatObservation], Action]] = staticmethod(controllers.slide)


@with_sections(SECTIONS, id="PandaStack-v0", size="n_objects", things="blocks")
class PandaStackEnv(_ObjectsEnv):
    """Build a tower of the blocks in colour order, at a given place.

    ## Description
    Blocks of 4 cm and 1 kg lie on the table. A block is finished when it is within 3 cm of its place in the tower,
    at rest (less than 1 mm in the last step) and free of the gripper, whose fingertips are then above it or beside
    it. The task is done when the tower is complete.

    $colours

    $spaces

    ### What a short program can do with it
    The difficulty is the tower: what to do with a block depends on its height above its place in the tower. That height
    is ``object`` minus ``target`` for every block, and ``distance`` is a length, so one affine test of both is a cone
    whose tip is the place. A block above a flat cone is being carried and comes down on it; a block inside a steep
    cone, at the tip, has been set down; a block on the table is in neither, however high the tower. Seven branches are
    enough, in this order: carry; let go and rise; in a funnel above the block, go down; above the tower, fly over the
    block; not around it, rise; fingers open, close them; otherwise lift. Since ``target`` rises with the tower, flying
    6 cm above it clears the tower. Which of these is to be done is not in the observation.

    ## Rewards
    ``reward_type="dense"`` (default), the sum of

    * 10 per metre by which the object in focus came closer to its target,
    * 5 per metre by which the gripper came closer to the object,
    $rewards

    ``reward_type="potential"``: $gains

    $left
    * -5 per metre of the gripper's way to the block in focus: the horizontal distance, plus half of the height above
      it, plus 1.5 times the height that the gripper lacks, which should be twice as high above the block as it is away,
      up to 8 cm; and while it is above the block, what the fingers lack to be open, 8 cm,
    $leaving

    $reach

    ``reward_type="sparse"``: 0 where the object in focus is at its target, at rest and free of the gripper,
    -1 otherwise.

    ## Starting State
    The arm in its neutral pose, fingers closed. The tower's place by seed, x from -0.02 to 0.08, y from -0.12 to
    0.12; blocks by seed where the gripper can pick them up without touching the tower or another block. With ``n_done``
    above 0 the first blocks have been stacked, and the open gripper is 6 cm above the last of these.

    $start In a tower all targets have the same x and y.

    ## Episode End
    Terminated when every object is finished, or as a failure when one leaves the table or, with
    ``reward_type="potential"``, is out of reach; truncated after 500 steps (``max_episode_steps``).

    $rules
    """

    task_class: ClassVar[type[Task]] = Stack
    controller: ClassVar[Callable[[FlatObservation], Action]] = staticmethod(controllers.stack)

    def begin_tower(self, n_done: int) -> Observation:
        """Begin the episode once more with the first blocks in their places, as if they had been stacked.

        Unlike ``n_done`` it leaves the arm in its neutral pose, whose gripper is just above a tower of four.

        :param n_done: how many, fewer than there are
        :return: the observation
        :raises ValueError: if there are not so many blocks
        """
        require_reset(self._started, "begin_tower()")
        n_objects = len(self.task.targets)
        if not 0 <= n_done < n_objects:
            raise ValueError(f"n_done={n_done} is not accepted; of {n_objects} blocks 0 to {n_objects - 1} can be done")
        return self._place(np.array(self.task.starts), np.array(self.task.targets), n_done, neutral=True)


class PandaReachGoalEnv(PandaGoalEnv, PandaReachEnv):
    """:class:`PandaReachEnv` with the observation of a goal environment."""


class PandaPushGoalEnv(PandaGoalEnv, PandaPushEnv):
    """:class:`PandaPushEnv` with the observation of a goal environment."""


class PandaSlideGoalEnv(PandaGoalEnv, PandaSlideEnv):
    """:class:`PandaSlideEnv` with the observation of a goal environment."""


class PandaStackGoalEnv(PandaGoalEnv, PandaStackEnv):
    """:class:`PandaStackEnv` with the observation of a goal environment."""


make_reach = EntryPoint(PandaReachEnv, PandaReachGoalEnv)
make_push = EntryPoint(PandaPushEnv, PandaPushGoalEnv)
make_slide = EntryPoint(PandaSlideEnv, PandaSlideGoalEnv)
make_stack = EntryPoint(PandaStackEnv, PandaStackGoalEnv)
