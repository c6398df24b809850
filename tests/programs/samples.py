"""Programs for the tests of what is exported."""

from dataclasses import replace

from sb3_progpolicy.programs import ActionSpec, Condition, Controller, IfThenElse, Program

HOSTILE_NAMES = (
    'a"b', "a'b", "back\\slash", '"""', "#", "$x$", "{", "}%", "~^_&", "é→", "import os", "class", "h1_1", "b1", "self",
    "scores", "p_0", "B1 [label=x]; }",
)  # fmt: skip


def with_hostile_names(program):
    inputs = (HOSTILE_NAMES * 3)[: program.n_inputs]
    outputs = (HOSTILE_NAMES[::-1] * 3)[: program.action.n_outputs]
    return replace(program, input_names=inputs, output_names=outputs)


def program_by_hand(weight=-1.0):
    """Three moves of a cart: away from the left wall, else by the angle, never right after moving left."""
    nothing = (0.0,) * 9
    near = Condition("affine", (), (), (), (), (-2.0, *(0.0,) * 8), 1.0)
    lean = (0.0, weight, 0.0, 0.0, -5.0, 0.0, 0.0, 0.0, 0.0)
    body = IfThenElse(
        near,
        Controller((nothing,) * 3, (0.0, 0.0, 1.0)),
        Controller((lean, nothing, (0.0, 3.0, *(0.0,) * 7)), (0.0, 2.0, -1.0)),
    )
    moves = ("left", "stay", "right")
    names = ("position", "angle[0]", "wind", "light", *(f"previous {move}" for move in moves))
    names = (*names, "previous reward", "previous done")
    return Program(body, 4, ActionSpec("discrete", (3,)), True, names, moves, metadata={"env": "Cart-v0"})
