"""Hand-written programs for the Panda tasks: they show that the focus observation lets short programs solve them.

Every condition is affine and every controller is affine, in the observation alone; nothing is remembered.

Measured on seeds 0-5: Reach and Push solve 6 of 6 with one and with eight objects, Stack 6 of 6 with one block but none
with eight (its first condition takes a block that lies below its place for one that has been put there), Slide 4 of
6 with one puck and 3 of 6 with three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.panda.focus import ACTION_NAMES, OBSERVATION_NAMES
from sb3_progpolicy.programs.syntax import ActionSpec, Condition, Controller, Expression, IfThenElse, Program

Affine = Mapping[str, float]  # weights by observation name; "1" is the constant
GAIN = 20.0  # units of action per metre: 1 is 5 cm


def _row(terms: Affine) -> tuple[tuple[float, ...], float]:
    unknown = set(terms) - {*OBSERVATION_NAMES, "1"}
    if unknown:
        raise ValueError(f"unknown observations {sorted(unknown)}")
    return tuple(terms.get(name, 0.0) for name in OBSERVATION_NAMES), terms.get("1", 0.0)


def condition(**terms: float) -> Condition:
    """Return the test that the weighted sum is at least 0; ``one`` is the constant."""
    weights, bias = _row({"1" if name == "one" else name: weight for name, weight in terms.items()})
    return Condition("affine", (), (), (), (), weights, bias)


def controller(x: Affine, y: Affine, z: Affine, fingers: Affine) -> Controller:
    """Return the controller whose four outputs are the given weighted sums."""
    weights, bias = zip(*(_row(terms) for terms in (x, y, z, fingers)), strict=True)
    return Controller(weights, bias)


def chain(*branches: tuple[Condition, Controller], otherwise: Controller) -> Program:
    """Return ``if B1 then C1 else if B2 then C2 ... else otherwise``."""
    body: Expression = otherwise
    for test, then in reversed(branches):
        body = IfThenElse(test, then, body)
    action = ActionSpec("box", (4,), (-1.0,) * 4, (1.0,) * 4)
    return Program(body, len(OBSERVATION_NAMES), action, False, OBSERVATION_NAMES, ACTION_NAMES)


def act(program: Program, observation: Sequence[float] | NDArray[np.float32]) -> NDArray[np.float32]:
    """Run a program of affine conditions by hand, independently of the package's own interpreters."""
    values = np.asarray(observation, dtype=np.float64)
    expression = program.body
    while isinstance(expression, IfThenElse):
        holds = np.dot(expression.condition.readout, values) + expression.condition.readout_bias >= 0
        expression = expression.then if holds else expression.orelse
    return np.clip(np.dot(expression.weights, values) + expression.bias, -1, 1).astype(np.float32)


OPEN, CLOSE = {"1": 1.0}, {"1": -1.0}
NOWHERE: Affine = {}
TO_OBJECT_X, TO_OBJECT_Y, TO_OBJECT_Z = ({f"object_d{axis}": GAIN} for axis in "xyz")


def height(metres: float) -> Affine:
    """Go to this height."""
    return {"1": GAIN * metres, "gripper_z": -GAIN}


RISE_OPEN = controller(NOWHERE, NOWHERE, {"1": -5.0, "fingers": 100.0}, OPEN)  # rises once the fingers are open
ONTO_OBJECT = controller(TO_OBJECT_X, TO_OBJECT_Y, TO_OBJECT_Z, OPEN)
GRASP = controller(TO_OBJECT_X, TO_OBJECT_Y, TO_OBJECT_Z, CLOSE)
# The gripper is in a funnel above the object, the narrower the lower.
IN_FUNNEL = condition(object_dz=-1.0, reach=-5.0, one=-0.01)
# The gripper is neither above nor around the object.
NOT_AROUND = condition(object_dz=-1.0, reach=4.0, one=-0.06)
FINGERS_OPEN = condition(fingers=1.0, one=-0.058)

REACH = chain(otherwise=controller(*({f"target_d{axis}": GAIN} for axis in "xyz"), CLOSE))

PUSH = chain(
    (IN_FUNNEL, ONTO_OBJECT),
    (condition(gripper_z=1.0, one=-0.085), controller(TO_OBJECT_X, TO_OBJECT_Y, height(0.1), OPEN)),
    (NOT_AROUND, RISE_OPEN),
    (FINGERS_OPEN, GRASP),
    otherwise=controller({"line_x": 0.3, "target_dx": 3.0}, {"line_y": 0.3, "target_dy": 3.0}, height(0.02), CLOSE),
)

OBJECT_TO_TARGET_X = {"target_x": GAIN, "object_x": -GAIN}
OBJECT_TO_TARGET_Y = {"target_y": GAIN, "object_y": -GAIN}

STACK = chain(
    # The block is on its place: let go of it and rise.
    (condition(distance=-1.0, object_z=-2.0, target_z=2.0, one=0.02), RISE_OPEN),
    (IN_FUNNEL, ONTO_OBJECT),
    # Above the tower with open fingers, nothing in them: fly to the block.
    (
        condition(target_dz=-1.0, fingers=10.0, one=-0.83),
        controller(TO_OBJECT_X, TO_OBJECT_Y, {"target_dz": GAIN, "1": GAIN * 0.06}, OPEN),
    ),
    (NOT_AROUND, RISE_OPEN),
    (FINGERS_OPEN, GRASP),
    # Over its place: down. Below the tower's top: up. Else over the tower.
    (
        condition(distance=-1.0, one=0.012),
        controller(OBJECT_TO_TARGET_X, OBJECT_TO_TARGET_Y, {"1": -0.05, "target_z": 12.0, "object_z": -12.0}, CLOSE),
    ),
    (condition(object_z=-1.0, target_z=1.0, one=0.035), controller(NOWHERE, NOWHERE, {"1": 1.0}, CLOSE)),
    otherwise=controller(
        OBJECT_TO_TARGET_X,
        OBJECT_TO_TARGET_Y,
        {"target_z": GAIN, "object_z": -GAIN, "1": GAIN * 0.06},
        CLOSE,
    ),
)

HALF_OPEN = {"1": 0.2, "fingers": -5.0}  # 4 cm
BEHIND = {"object_dx": GAIN, "1": -0.055 * GAIN}

BACK = controller({"1": 0.3, "gripper_z": -13.0}, NOWHERE, height(0.1), HALF_OPEN)

SLIDE = chain(
    # At the end of the arm's reach, or before the puck: rise, and go back the faster the higher.
    (condition(gripper_x=1.0, one=-0.06), BACK),
    (condition(object_dx=-1.0, one=0.02), BACK),
    # Low and close behind the puck: push, the faster the faster it moves already.
    (
        condition(object_dx=-2.0, gripper_z=-5.0, one=0.3),
        controller({"1": 0.35, "object_vx": 1.0}, {"line_y": 0.9, "object_dy": 8.0}, height(0.012), HALF_OPEN),
    ),
    # It slides: wait above.
    (condition(object_vx=1.0, one=-0.08), controller(NOWHERE, NOWHERE, height(0.1), HALF_OPEN)),
    # In the funnel behind it: down.
    (
        condition(gripper_z=1.0, reach=-5.0, one=0.29),
        controller(BEHIND, TO_OBJECT_Y, height(0.012), HALF_OPEN),
    ),
    otherwise=controller(BEHIND, TO_OBJECT_Y, height(0.1), HALF_OPEN),
)

PROGRAMS = {"PandaReach-v0": REACH, "PandaPush-v0": PUSH, "PandaSlide-v0": SLIDE, "PandaStack-v0": STACK}
