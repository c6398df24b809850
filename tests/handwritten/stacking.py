"""Stacking by four conditions and five constants: go to the largest plate, then pick it up."""

import gymnasium as gym

import progpolicy_envs  # noqa: F401 (registers the ids)
from progpolicy_envs.stacking import N_SIDE
from sb3_progpolicy.programs.syntax import Condition, Program
from tests.handwritten.build import Builder


def stacking_program() -> Program:
    """Return the program ``if further east: east, else if further west: west, ... else: pick``."""
    builder = Builder(gym.make("Stacking-v0"))

    def plate_lies(axis: str, sign: float) -> Condition:
        """Compare the largest plate's row or column with the gripper's; they differ by whole numbers."""
        weights = {
            f"table[{row},{column}]": sign * ((row if axis == "row" else column) - N_SIDE // 2)
            for row in range(N_SIDE)
            for column in range(N_SIDE)
        }
        return builder.affine({**weights, f"gripper[{axis}]": -sign * (N_SIDE // 2)}, bias=-0.5)

    branches = [
        (plate_lies("column", +1), builder.always("east")),
        (plate_lies("column", -1), builder.always("west")),
        (plate_lies("row", +1), builder.always("south")),
        (plate_lies("row", -1), builder.always("north")),
    ]
    return builder.program(builder.chain(branches, builder.always("pick")), env="Stacking-v0")
