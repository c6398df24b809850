"""Four manipulation tasks for a Franka Panda in PyBullet, on any number of objects behind one observation."""

from __future__ import annotations

from typing import ClassVar

from progpolicy_envs.panda.env import PandaEnv
from progpolicy_envs.panda.scene import MAX_OBJECTS, PANDA_GYM_PHYSICS, Physics
from progpolicy_envs.panda.tasks import Push, Reach, Slide, Stack, Task
from progpolicy_envs.variation import IntParameter, VariationSpace

__all__ = [
    "PANDA_GYM_PHYSICS",
    "PandaEnv",
    "PandaPushEnv",
    "PandaReachEnv",
    "PandaSlideEnv",
    "PandaStackEnv",
    "Physics",
]

_N_OBJECTS = VariationSpace(IntParameter("n_objects", 1, MAX_OBJECTS, "number of objects"))
_N_TARGETS = VariationSpace(IntParameter("n_targets", 1, MAX_OBJECTS, "number of targets"))


class PandaReachEnv(PandaEnv):
    """Visit coloured points in the air with the gripper, in order.

    ## Description
    A target is visited when the gripper comes within 5 cm of it while it is in focus. The object of the observation
    is the gripper itself.

    Everything that has a colour is worked on in colour order: red, blue, green, yellow, violet, orange, cyan, pink.

    ## Action Space
    ``Box(-1, 1, (4,))``, applied for 1/30 s. The gripper points down and its fingers open along y.

    | Num | Action | Meaning                                                                        |
    |-----|--------|--------------------------------------------------------------------------------|
    | 0-2 | move   | displacement of the gripper along x, y and z; 1 is 5 cm (an arm of finite      |
    |     |        | strength covers a little more than half of it in the step)                     |
    | 3   | open   | change of the finger width; 1 is 20 cm, so that the sign opens or closes       |

    ## Observation Space
    ``Box(-10, 10, (32,))`` in metres and seconds: the robot and ONE object with its target, the first unfinished
    one in colour order, so that the numbers mean the same with any number of objects. Finishing an object moves the
    focus on; disturbing a finished one brings it back. With ``observation="goal"`` the same numbers come as a
    dictionary: ``observation`` (0-25), ``achieved_goal`` (26-28) and ``desired_goal`` (29-31).

    | Num   | Observation  | Meaning                                                                           |
    |-------|--------------|-----------------------------------------------------------------------------------|
    | 0-2   | gripper      | position of the gripper; the robot stands at (-0.6, 0, 0), the table's top is z = 0 |
    | 3-5   | gripper_v    | its velocity                                                                      |
    | 6     | fingers      | distance between the fingers, 0 to 0.08                                           |
    | 7-9   | object_d     | object minus gripper                                                              |
    | 10-12 | target_d     | target minus gripper                                                              |
    | 13    | distance     | horizontal distance from object to target                                         |
    | 14-15 | line         | unit vector from object to target in the plane                                    |
    | 16    | along        | gripper relative to the object along that line; negative is behind the object     |
    | 17    | across       | gripper relative to the object across that line, left of it positive              |
    | 18-20 | object_v     | velocity of the object                                                            |
    | 21-22 | turn         | cosine and sine of four times the object's yaw: a cube looks the same four times  |
    | 23    | spin         | angular velocity about z                                                          |
    | 24    | reach        | horizontal distance from gripper to object                                        |
    | 25    | left         | unfinished objects divided by 8                                                   |
    | 26-28 | object       | position of the object                                                            |
    | 29-31 | target       | position of its target                                                            |

    ### What a short program can do with it
    The way to the target is in the observation as a difference, so one affine controller is enough: 20 times
    ``target_d`` is a full step towards it and less when it is near. The focus does the rest, for any number of
    targets.

    ## Rewards
    ``reward_type="dense"`` (default), the sum of

    * 10 per metre by which the object in focus came closer to its target,
    * 1 for every object that becomes finished, -1 for every one that ceases to be,
    * -0.01 for the step,
    * -5 when an object leaves the table.

    Progress is measured as a difference, so that nothing is gained by moving to and fro.

    ``reward_type="sparse"``: 0 where the object in focus is at its target,
    -1 otherwise.

    ## Starting State
    The arm in its neutral pose, the gripper near (0.04, 0, 0.2), fingers closed. Targets by seed in a box of 33 x
    50 x 30 cm, at least 10 cm apart and from the gripper.

    ## Episode End
    Terminated when the last target is visited;
    truncated after 500 steps (``max_episode_steps``).

    ## Information
    ``info["is_success"]`` at every step; at reset also ``info["variation"]``. Steps also carry ``is_failure`` and what
    ``compute_reward`` of the goal form needs besides the goals: ``settled``, ``previous_achieved_goal``, ``shaping``.

    ## Arguments
    ``gym.make("PandaReach-v0", n_targets=5)`` or ``env.reset(options={"n_targets": 5})``; an option stays in force
    until it is changed. Values that are not accepted raise ``ValueError``.

    | Parameter   | Values              | Default   | Meaning                                                   |
    |-------------|---------------------|-----------|-----------------------------------------------------------|
    | n_targets   | 1 to 8              | 1         | number of targets                                         |
    | observation | "flat", "goal"      | "flat"    | one array, or the dictionary of a goal environment        |
    | reward_type | "dense", "sparse"   | "dense"   | see above                                                 |
    | physics     | ``Physics``, None   | None      | time step and solver; None is 120 Hz, 4 steps an action   |

    ## References
    panda-gym (Gallouédec, Cazin, Dellandréa and Chen, 2021), whose robot, table and control these are.

    ## Version History
    * v0: initial version
    """

    task_class: ClassVar[type[Task]] = Reach
    variations: ClassVar[VariationSpace] = _N_TARGETS

    def __init__(
        self,
        n_targets: int = 1,
        *,
        observation: str = "flat",
        reward_type: str = "dense",
        render_mode: str | None = None,
        physics: Physics | None = None,
    ) -> None:
        super().__init__(
            {"n_targets": n_targets},
            observation=observation,
            reward_type=reward_type,
            render_mode=render_mode,
            physics=physics,
        )


class PandaPushEnv(PandaEnv):
    """Bring every block to the disc of its colour on the table.

    ## Description
    Blocks of 4 cm and 1 kg lie on the table. The task is done when all of them are within 5 cm of their targets at
    once.

    Everything that has a colour is worked on in colour order: red, blue, green, yellow, violet, orange, cyan, pink.

    ## Action Space
    ``Box(-1, 1, (4,))``, applied for 1/30 s. The gripper points down and its fingers open along y.

    | Num | Action | Meaning                                                                        |
    |-----|--------|--------------------------------------------------------------------------------|
    | 0-2 | move   | displacement of the gripper along x, y and z; 1 is 5 cm (an arm of finite      |
    |     |        | strength covers a little more than half of it in the step)                     |
    | 3   | open   | change of the finger width; 1 is 20 cm, so that the sign opens or closes       |

    ## Observation Space
    ``Box(-10, 10, (32,))`` in metres and seconds: the robot and ONE object with its target, the first unfinished
    one in colour order, so that the numbers mean the same with any number of objects. Finishing an object moves the
    focus on; disturbing a finished one brings it back. With ``observation="goal"`` the same numbers come as a
    dictionary: ``observation`` (0-25), ``achieved_goal`` (26-28) and ``desired_goal`` (29-31).

    | Num   | Observation  | Meaning                                                                           |
    |-------|--------------|-----------------------------------------------------------------------------------|
    | 0-2   | gripper      | position of the gripper; the robot stands at (-0.6, 0, 0), the table's top is z = 0 |
    | 3-5   | gripper_v    | its velocity                                                                      |
    | 6     | fingers      | distance between the fingers, 0 to 0.08                                           |
    | 7-9   | object_d     | object minus gripper                                                              |
    | 10-12 | target_d     | target minus gripper                                                              |
    | 13    | distance     | horizontal distance from object to target                                         |
    | 14-15 | line         | unit vector from object to target in the plane                                    |
    | 16    | along        | gripper relative to the object along that line; negative is behind the object     |
    | 17    | across       | gripper relative to the object across that line, left of it positive              |
    | 18-20 | object_v     | velocity of the object                                                            |
    | 21-22 | turn         | cosine and sine of four times the object's yaw: a cube looks the same four times  |
    | 23    | spin         | angular velocity about z                                                          |
    | 24    | reach        | horizontal distance from gripper to object                                        |
    | 25    | left         | unfinished objects divided by 8                                                   |
    | 26-28 | object       | position of the object                                                            |
    | 29-31 | target       | position of its target                                                            |

    ### What a short program can do with it
    An interval or an "and" takes more than one affine test, but each branch sees only what those before it leave
    over, and ``reach`` and ``distance`` are lengths already, so that a test that adds one to a height bounds a cone.
    Five branches: in a funnel above the block, go down with open fingers; high above the table, fly over the block;
    low and not around it, rise; around it with open fingers, close them; otherwise draw it along the line.
    Positions relative to the gripper make every command a weighted sum, and nothing in them is of a place on the
    table or of a number of blocks. Which of these is to be done is not in the observation.

    ## Rewards
    ``reward_type="dense"`` (default), the sum of

    * 10 per metre by which the object in focus came closer to its target,
    * 5 per metre by which the gripper came closer to the point 5 cm behind the object, seen from its target,
    * 1 for every object that becomes finished, -1 for every one that ceases to be,
    * -0.01 for the step,
    * -5 when an object leaves the table.

    Progress is measured as a difference, so that nothing is gained by moving to and fro.

    ``reward_type="sparse"``: 0 where the object in focus is at its target,
    -1 otherwise.

    ## Starting State
    The arm in its neutral pose, fingers closed. Blocks and targets by seed, in reach, at least 9 cm apart from
    their like, 10 to 35 cm from block to target; taken in colour order every straight way, with a run-up of 8 cm,
    is 8 cm clear of the other blocks.

    ## Episode End
    Terminated when every object is finished, or as a failure when one leaves the table;
    truncated after 500 steps (``max_episode_steps``).

    ## Information
    ``info["is_success"]`` at every step; at reset also ``info["variation"]``. Steps also carry ``is_failure`` and what
    ``compute_reward`` of the goal form needs besides the goals: ``settled``, ``previous_achieved_goal``, ``shaping``.

    ## Arguments
    ``gym.make("PandaPush-v0", n_objects=5)`` or ``env.reset(options={"n_objects": 5})``; an option stays in force
    until it is changed. Values that are not accepted raise ``ValueError``.

    | Parameter   | Values              | Default   | Meaning                                                   |
    |-------------|---------------------|-----------|-----------------------------------------------------------|
    | n_objects   | 1 to 8              | 1         | number of blocks                                          |
    | observation | "flat", "goal"      | "flat"    | one array, or the dictionary of a goal environment        |
    | reward_type | "dense", "sparse"   | "dense"   | see above                                                 |
    | physics     | ``Physics``, None   | None      | time step and solver; None is 120 Hz, 4 steps an action   |

    ## References
    panda-gym (Gallouédec, Cazin, Dellandréa and Chen, 2021), whose robot, table and control these are.

    ## Version History
    * v0: initial version
    """

    task_class: ClassVar[type[Task]] = Push
    variations: ClassVar[VariationSpace] = _N_OBJECTS

    def __init__(
        self,
        n_objects: int = 1,
        *,
        observation: str = "flat",
        reward_type: str = "dense",
        render_mode: str | None = None,
        physics: Physics | None = None,
    ) -> None:
        super().__init__(
            {"n_objects": n_objects},
            observation=observation,
            reward_type=reward_type,
            render_mode=render_mode,
            physics=physics,
        )


class PandaSlideEnv(PandaEnv):
    """Give every puck a push that makes it slide to the disc of its colour, beyond the arm's reach.

    ## Description
    Pucks of 6 cm and 1 kg lie on a slippery table. A puck is delivered when its centre has been within 5 cm of its
    target's at the end of a step, at whatever speed; it is then taken off the table. The task is done when all are
    delivered.

    Everything that has a colour is worked on in colour order: red, blue, green, yellow, violet, orange, cyan, pink.

    ## Action Space
    ``Box(-1, 1, (4,))``, applied for 1/30 s. The gripper points down and its fingers open along y.

    | Num | Action | Meaning                                                                        |
    |-----|--------|--------------------------------------------------------------------------------|
    | 0-2 | move   | displacement of the gripper along x, y and z; 1 is 5 cm (an arm of finite      |
    |     |        | strength covers a little more than half of it in the step)                     |
    | 3   | open   | change of the finger width; 1 is 20 cm, so that the sign opens or closes       |

    ## Observation Space
    ``Box(-10, 10, (32,))`` in metres and seconds: the robot and ONE object with its target, the first unfinished
    one in colour order, so that the numbers mean the same with any number of objects. Finishing an object moves the
    focus on; disturbing a finished one brings it back. With ``observation="goal"`` the same numbers come as a
    dictionary: ``observation`` (0-25), ``achieved_goal`` (26-28) and ``desired_goal`` (29-31).

    | Num   | Observation  | Meaning                                                                           |
    |-------|--------------|-----------------------------------------------------------------------------------|
    | 0-2   | gripper      | position of the gripper; the robot stands at (-0.6, 0, 0), the table's top is z = 0 |
    | 3-5   | gripper_v    | its velocity                                                                      |
    | 6     | fingers      | distance between the fingers, 0 to 0.08                                           |
    | 7-9   | object_d     | object minus gripper                                                              |
    | 10-12 | target_d     | target minus gripper                                                              |
    | 13    | distance     | horizontal distance from object to target                                         |
    | 14-15 | line         | unit vector from object to target in the plane                                    |
    | 16    | along        | gripper relative to the object along that line; negative is behind the object     |
    | 17    | across       | gripper relative to the object across that line, left of it positive              |
    | 18-20 | object_v     | velocity of the object                                                            |
    | 21-22 | turn         | cosine and sine of four times the object's yaw: a cube looks the same four times  |
    | 23    | spin         | angular velocity about z                                                          |
    | 24    | reach        | horizontal distance from gripper to object                                        |
    | 25    | left         | unfinished objects divided by 8                                                   |
    | 26-28 | object       | position of the object                                                            |
    | 29-31 | target       | position of its target                                                            |

    A delivered puck keeps the position at which it was delivered.

    ### What a short program can do with it
    Seven branches, in this order: at the end of the arm's reach, draw back; not behind the puck, fly there; low
    behind a puck at rest, take it gently into the middle between the fingers; low behind a puck that moves, push;
    puck under way, draw back; behind it and high, go down; otherwise fly there. "Behind", "low" and "near" are sums of
    ``object_d``, ``gripper`` and ``reach``. A push has a direction and a speed: the one is ``line``, across which the
    puck's offset from the gripper is corrected, and the other is made relative to the puck's own,
    ``0.3 + 0.75 * object_v``, so that the fingers are always a little faster than the puck and do not lose it. Which
    speed or which way is right is not in the observation.

    ## Rewards
    ``reward_type="dense"`` (default), the sum of

    * 10 per metre by which the object in focus came closer to its target,
    * 5 per metre by which the gripper came closer to the point 6 cm behind the object, seen from its target,
    * 1 for every object that becomes finished, -1 for every one that ceases to be,
    * -0.01 for the step,
    * -5 when an object leaves the table.

    Progress is measured as a difference, so that nothing is gained by moving to and fro.

    ``reward_type="sparse"``: 0 where the object in focus is at its target,
    -1 otherwise.

    ## Starting State
    The arm in its neutral pose, fingers closed. Pucks by seed in the near half of the table, the front ones first
    in colour order; targets at x from 0.3 to 0.54, at most 22 degrees off the x axis as seen from their pucks;
    taken in colour order every straight way is 8 cm clear of the other pucks.

    ## Episode End
    Terminated when every object is finished, or as a failure when one leaves the table;
    truncated after 500 steps (``max_episode_steps``).

    ## Information
    ``info["is_success"]`` at every step; at reset also ``info["variation"]``. Steps also carry ``is_failure`` and what
    ``compute_reward`` of the goal form needs besides the goals: ``settled``, ``previous_achieved_goal``, ``shaping``.

    ## Arguments
    ``gym.make("PandaSlide-v0", n_objects=5)`` or ``env.reset(options={"n_objects": 5})``; an option stays in force
    until it is changed. Values that are not accepted raise ``ValueError``.

    | Parameter   | Values              | Default   | Meaning                                                   |
    |-------------|---------------------|-----------|-----------------------------------------------------------|
    | n_objects   | 1 to 8              | 1         | number of pucks                                           |
    | observation | "flat", "goal"      | "flat"    | one array, or the dictionary of a goal environment        |
    | reward_type | "dense", "sparse"   | "dense"   | see above                                                 |
    | physics     | ``Physics``, None   | None      | time step and solver; None is 120 Hz, 4 steps an action   |

    ## References
    panda-gym (Gallouédec, Cazin, Dellandréa and Chen, 2021), whose robot, table and control these are.

    ## Version History
    * v0: initial version
    """

    task_class: ClassVar[type[Task]] = Slide
    variations: ClassVar[VariationSpace] = _N_OBJECTS

    def __init__(
        self,
        n_objects: int = 1,
        *,
        observation: str = "flat",
        reward_type: str = "dense",
        render_mode: str | None = None,
        physics: Physics | None = None,
    ) -> None:
        super().__init__(
            {"n_objects": n_objects},
            observation=observation,
            reward_type=reward_type,
            render_mode=render_mode,
            physics=physics,
        )


class PandaStackEnv(PandaEnv):
    """Build a tower of the blocks in colour order, at a given place.

    ## Description
    Blocks of 4 cm and 1 kg lie on the table. A block is finished when it is within 3 cm of its place in the tower,
    at rest (less than 1 mm in the last step) and free of the gripper, whose fingertips are then above it or beside
    it. The task is done when the tower is complete.

    Everything that has a colour is worked on in colour order: red, blue, green, yellow, violet, orange, cyan, pink.

    ## Action Space
    ``Box(-1, 1, (4,))``, applied for 1/30 s. The gripper points down and its fingers open along y.

    | Num | Action | Meaning                                                                        |
    |-----|--------|--------------------------------------------------------------------------------|
    | 0-2 | move   | displacement of the gripper along x, y and z; 1 is 5 cm (an arm of finite      |
    |     |        | strength covers a little more than half of it in the step)                     |
    | 3   | open   | change of the finger width; 1 is 20 cm, so that the sign opens or closes       |

    ## Observation Space
    ``Box(-10, 10, (32,))`` in metres and seconds: the robot and ONE object with its target, the first unfinished
    one in colour order, so that the numbers mean the same with any number of objects. Finishing an object moves the
    focus on; disturbing a finished one brings it back. With ``observation="goal"`` the same numbers come as a
    dictionary: ``observation`` (0-25), ``achieved_goal`` (26-28) and ``desired_goal`` (29-31).

    | Num   | Observation  | Meaning                                                                           |
    |-------|--------------|-----------------------------------------------------------------------------------|
    | 0-2   | gripper      | position of the gripper; the robot stands at (-0.6, 0, 0), the table's top is z = 0 |
    | 3-5   | gripper_v    | its velocity                                                                      |
    | 6     | fingers      | distance between the fingers, 0 to 0.08                                           |
    | 7-9   | object_d     | object minus gripper                                                              |
    | 10-12 | target_d     | target minus gripper                                                              |
    | 13    | distance     | horizontal distance from object to target                                         |
    | 14-15 | line         | unit vector from object to target in the plane                                    |
    | 16    | along        | gripper relative to the object along that line; negative is behind the object     |
    | 17    | across       | gripper relative to the object across that line, left of it positive              |
    | 18-20 | object_v     | velocity of the object                                                            |
    | 21-22 | turn         | cosine and sine of four times the object's yaw: a cube looks the same four times  |
    | 23    | spin         | angular velocity about z                                                          |
    | 24    | reach        | horizontal distance from gripper to object                                        |
    | 25    | left         | unfinished objects divided by 8                                                   |
    | 26-28 | object       | position of the object                                                            |
    | 29-31 | target       | position of its target                                                            |

    ### What a short program can do with it
    The tower is the difficulty: what is right for a block depends on its height above its place, which grows from
    block to block. ``object`` minus ``target`` is that height at any level, and ``distance`` is a length, so one affine
    test of both is a cone that stands on the place. A block above a flat cone is being carried and comes down on it;
    a block at the tip, inside a steep one, has been set down; a block on the table is in neither, for towers of any
    height. Seven branches in this order: carry; let go and rise; in a funnel above the block, go down; above the
    tower, fly over the block; not around it, rise; fingers open, close them; otherwise lift. Since ``target`` rises
    with the tower, flying 6 cm above it clears the tower. Which of these is to be done is not in the observation.

    ## Rewards
    ``reward_type="dense"`` (default), the sum of

    * 10 per metre by which the object in focus came closer to its target,
    * 5 per metre by which the gripper came closer to the object,
    * 1 for every object that becomes finished, -1 for every one that ceases to be,
    * -0.01 for the step,
    * -5 when an object leaves the table.

    Progress is measured as a difference, so that nothing is gained by moving to and fro.

    ``reward_type="sparse"``: 0 where the object in focus is at its target, at rest and free of the gripper,
    -1 otherwise.

    ## Starting State
    The arm in its neutral pose, fingers closed. The tower's place by seed, x from -0.02 to 0.08, y from -0.12 to
    0.12; blocks by seed where the gripper can pick them up without touching the tower or another block.

    ## Episode End
    Terminated when every object is finished, or as a failure when one leaves the table;
    truncated after 500 steps (``max_episode_steps``).

    ## Information
    ``info["is_success"]`` at every step; at reset also ``info["variation"]``. Steps also carry ``is_failure`` and what
    ``compute_reward`` of the goal form needs besides the goals: ``settled``, ``previous_achieved_goal``, ``shaping``.

    ## Arguments
    ``gym.make("PandaStack-v0", n_objects=5)`` or ``env.reset(options={"n_objects": 5})``; an option stays in force
    until it is changed. Values that are not accepted raise ``ValueError``.

    | Parameter   | Values              | Default   | Meaning                                                   |
    |-------------|---------------------|-----------|-----------------------------------------------------------|
    | n_objects   | 1 to 8              | 1         | number of blocks                                          |
    | observation | "flat", "goal"      | "flat"    | one array, or the dictionary of a goal environment        |
    | reward_type | "dense", "sparse"   | "dense"   | see above                                                 |
    | physics     | ``Physics``, None   | None      | time step and solver; None is 120 Hz, 4 steps an action   |

    ## References
    panda-gym (Gallouédec, Cazin, Dellandréa and Chen, 2021), whose robot, table and control these are.

    ## Version History
    * v0: initial version
    """

    task_class: ClassVar[type[Task]] = Stack
    variations: ClassVar[VariationSpace] = _N_OBJECTS

    def __init__(
        self,
        n_objects: int = 1,
        *,
        observation: str = "flat",
        reward_type: str = "dense",
        render_mode: str | None = None,
        physics: Physics | None = None,
    ) -> None:
        super().__init__(
            {"n_objects": n_objects},
            observation=observation,
            reward_type=reward_type,
            render_mode=render_mode,
            physics=physics,
        )
