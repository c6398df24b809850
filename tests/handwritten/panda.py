"""The four Panda tasks by affine branches on the observation of the object in focus; nothing is remembered.

Heights are those of the fingertips. What a condition cannot say, an interval or "both", the order of the branches
says: each speaks of the states that those before it leave over.
"""

from collections.abc import Mapping

from progpolicy_envs.panda import PandaReachEnv
from sb3_progpolicy.programs.syntax import Condition, Controller, Program
from tests.handwritten.build import Builder

Sum = Mapping[str, float]  # weights by input name; "1" is the constant
GAIN = 20.0  # units of action per metre: 1 is 5 cm
#: The arm covers a little more than half of what it is asked for, so this is not too much where a block is set down.
CARRY_GAIN = 30.0

NOTHING: Sum = {}
OPEN, CLOSE = {"1": 1.0}, {"1": -1.0}
HALF_OPEN = {"1": 0.2, "fingers": -5.0}  # 4 cm, narrower than a puck
TO_OBJECT_X, TO_OBJECT_Y, TO_OBJECT_Z = ({f"object_d{axis}": GAIN} for axis in "xyz")
TO_TARGET_X, TO_TARGET_Y, TO_TARGET_Z = ({f"target_d{axis}": GAIN} for axis in "xyz")
#: Stays while the fingers hold a block and rises when they have let go of it.
RISE_WHEN_OPEN = {"fingers": 35.0, "1": -1.25}


def to_height(metres: float) -> Sum:
    """Return the vertical command that leads to a height above the table."""
    return {"gripper_z": -GAIN, "1": GAIN * metres}


class PandaBuilder(Builder):
    """Parts of a Panda program, written as weighted sums with a constant."""

    def __init__(self) -> None:
        env = PandaReachEnv()
        super().__init__(env)
        env.close()

    def when(self, **terms: float) -> Condition:
        """Return the test that a weighted sum is at least 0; ``constant`` is its constant."""
        return self.affine({name: weight for name, weight in terms.items() if name != "constant"}, terms["constant"])

    def move(self, x: Sum, y: Sum, z: Sum, fingers: Sum) -> Controller:
        """Return the controller with these four outputs."""
        rows = dict(zip(self.outputs, (x, y, z, fingers), strict=True))
        scores = {name: {key: weight for key, weight in row.items() if key != "1"} for name, row in rows.items()}
        return self.controller(scores, {name: row.get("1", 0.0) for name, row in rows.items()})

    def in_funnel(self) -> Condition:
        """Test whether the gripper is above the object, in a funnel that is the narrower the lower."""
        return self.when(object_dz=-1.0, reach=-5.0, constant=-0.01)

    def not_around(self) -> Condition:
        """Test whether the object is not between the fingers; the funnel has been dealt with before."""
        return self.when(object_dz=-1.0, reach=4.0, constant=-0.06)

    def fingers_open(self) -> Condition:
        """Test whether the fingers are further apart than a block is wide."""
        return self.when(fingers=1.0, constant=-0.058)

    def go_to_object(self, fingers: Sum) -> Controller:
        """Bring the middle between the fingertips to the middle of the object."""
        return self.move(TO_OBJECT_X, TO_OBJECT_Y, TO_OBJECT_Z, fingers)


def reach_program() -> Program:
    """Return one controller: straight to the target."""
    builder = PandaBuilder()
    return builder.program(builder.move(TO_TARGET_X, TO_TARGET_Y, TO_TARGET_Z, CLOSE), env="PandaReach-v0")


def push_program() -> Program:
    """Return the program that takes a block between the fingers and draws it over the table."""
    builder = PandaBuilder()
    branches = [
        (builder.in_funnel(), builder.go_to_object(OPEN)),
        # High above the table: over the block.
        (
            builder.when(gripper_z=1.0, constant=-0.085),
            builder.move(TO_OBJECT_X, TO_OBJECT_Y, to_height(0.1), OPEN),
        ),
        # Low, and not around the block: leave what the fingers are around.
        (builder.not_around(), builder.move(NOTHING, NOTHING, RISE_WHEN_OPEN, OPEN)),
        (builder.fingers_open(), builder.go_to_object(CLOSE)),
    ]
    draw = builder.move({"line_x": 0.3, "target_dx": 3.0}, {"line_y": 0.3, "target_dy": 3.0}, to_height(0.02), CLOSE)
    return builder.program(builder.chain(branches, draw), env="PandaPush-v0")


def slide_program() -> Program:
    """Return the program that takes a puck in front of the half-open fingers and gives it more and more speed."""
    builder = PandaBuilder()
    behind, above, on_table = {"object_dx": GAIN, "1": -0.053 * GAIN}, to_height(0.1), to_height(0.012)
    fly = builder.move(behind, TO_OBJECT_Y, above, HALF_OPEN)
    # Up first, then to x = -0.1, over the pucks that are left.
    draw_back = builder.move({"gripper_x": -10.0, "gripper_z": -20.0, "1": 1.0}, NOTHING, above, HALF_OPEN)
    low_behind = {"object_dx": -2.0, "gripper_z": -5.0, "constant": 0.3}
    branches = [
        # At the end of the arm's reach: let the puck go.
        (builder.when(gripper_x=1.0, constant=-0.074), draw_back),
        # Not behind the puck; the higher the gripper, the further back it is to come down.
        (builder.when(object_dx=-1.0, gripper_z=0.34, constant=0.011), fly),
        # On the table behind a puck that lies still: gently into the middle between the fingers.
        (
            builder.when(**low_behind, object_vx=-3.0),
            builder.move({"1": 0.35}, TO_OBJECT_Y, on_table, HALF_OPEN),
        ),
        # The same with a puck that moves: faster than it, so that it stays in the fingers, and along the line.
        (
            builder.when(**low_behind),
            builder.move({"object_vx": 0.75, "1": 0.3}, {"line_y": 0.7, "object_dy": 8.0}, on_table, HALF_OPEN),
        ),
        # The puck is on its way.
        (builder.when(object_vx=1.0, constant=-0.08), draw_back),
        # Near it, and by the second test behind it: down.
        (builder.when(reach=-1.0, constant=0.065), builder.move(behind, TO_OBJECT_Y, on_table, HALF_OPEN)),
    ]
    return builder.program(builder.chain(branches, fly), env="PandaSlide-v0")


def stack_program() -> Program:
    """Return the program that picks a block up, brings it over its place, sets it down and leaves it.

    The place is the tip of two cones that stand on it. A block above the flat one can only be carried: it comes down
    along a cone in between, clear of the tower. A block at the tip, within the steep one, has been set down. Both hold
    for towers of any height, and no block on the table is in either of them.
    """
    builder = PandaBuilder()
    above_place = {"object_z": 1.0, "target_z": -1.0}
    carry = builder.move(
        {"target_x": CARRY_GAIN, "object_x": -CARRY_GAIN},
        {"target_y": CARRY_GAIN, "object_y": -CARRY_GAIN},
        {"target_z": GAIN, "object_z": -GAIN, "distance": 0.5 * GAIN, "1": -0.08},
        CLOSE,
    )
    branches = [
        (builder.when(**above_place, distance=-0.2, constant=-0.009), carry),
        (
            builder.when(**above_place, distance=-0.8, constant=0.01),
            builder.move(TO_OBJECT_X, TO_OBJECT_Y, RISE_WHEN_OPEN, OPEN),
        ),
        # In the funnel above the block: down, a little below its middle.
        (
            builder.when(object_dz=-1.0, reach=-3.0, constant=-0.003),
            builder.move(TO_OBJECT_X, TO_OBJECT_Y, {**TO_OBJECT_Z, "1": -0.006 * GAIN}, OPEN),
        ),
        # Above the tower or far from the block, so without it: over the block, 6 cm above its place.
        (
            builder.when(target_dz=-1.0, reach=4.0, constant=-0.17),
            builder.move(TO_OBJECT_X, TO_OBJECT_Y, {**TO_TARGET_Z, "1": 0.06 * GAIN}, OPEN),
        ),
        (builder.not_around(), builder.move(NOTHING, NOTHING, RISE_WHEN_OPEN, OPEN)),
        (builder.fingers_open(), builder.go_to_object(CLOSE)),
    ]
    lift = builder.move(NOTHING, NOTHING, {"1": 1.0}, CLOSE)
    return builder.program(builder.chain(branches, lift), env="PandaStack-v0")


PROGRAMS = {
    "PandaReach-v0": reach_program,
    "PandaPush-v0": push_program,
    "PandaSlide-v0": slide_program,
    "PandaStack-v0": stack_program,
}
