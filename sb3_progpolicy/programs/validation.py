"""The rules for a well-formed program. They are checked before it is run, printed or saved, and after it is loaded."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from sb3_progpolicy.programs.syntax import (
    BOX_SEMANTICS,
    GATES,
    STATELESS,
    Cell,
    Condition,
    Controller,
    IfThenElse,
    ProgramData,
)
from sb3_progpolicy.spaces import ActionKind, ActionSpec

# Far above real use (a screen of Atari is 7 056 inputs), and small enough that every printer takes seconds.
MAX_CONDITIONS = 64
MAX_INPUTS = 32_768  # length of X
MAX_OUTPUTS = 4_096  # of a controller
MAX_NUMBERS = 250_000  # weights and constants of a whole program
MAX_NAME_LENGTH = 200
MAX_METADATA_DEPTH = 16


def check_program(program: ProgramData) -> None:
    """Check that sizes agree and are not excessive, that numbers are finite and that names are printable.

    :param program: any program
    :raises ValueError: naming the first field at fault, what it holds and what is accepted
    """
    if not isinstance(program, ProgramData):
        raise ValueError(f"{type(program).__name__} given; a sb3_progpolicy.programs.Program is accepted")
    _check_action(program.action)
    _check_inputs(program)
    _check_names("output_names", program.output_names, program.action.n_outputs)
    if not _is_finite(program.temperature) or program.temperature <= 0:
        raise ValueError(f"temperature={_short(program.temperature)} is not accepted; it is a finite number above 0")
    if program.semantics not in BOX_SEMANTICS:
        raise ValueError(
            f"semantics={_short(program.semantics)} is not accepted; it is one of {', '.join(BOX_SEMANTICS)}"
        )
    expression, index = program.body, 0
    while isinstance(expression, IfThenElse):
        if index == MAX_CONDITIONS:
            raise ValueError(f"branches: more than {MAX_CONDITIONS} conditions are not accepted")
        _check_condition(f"branches[{index}].if", expression.condition, program.n_inputs)
        _check_controller(f"branches[{index}].then", expression.then, program)
        expression, index = expression.orelse, index + 1
    _check_controller("else", expression, program)
    if (n_numbers := _count_numbers(program)) > MAX_NUMBERS:
        raise ValueError(f"{n_numbers} weights and constants given; a program has at most {MAX_NUMBERS}")
    if not isinstance(program.metadata, Mapping):
        raise ValueError(f"metadata: {type(program.metadata).__name__} given; a mapping is accepted")
    _check_json("metadata", dict(program.metadata), MAX_METADATA_DEPTH)


def check_size(n_inputs: int, action: ActionSpec, n_conditions: int, cell: Cell, condition_size: int) -> None:
    """Check that a program is not too large to be printed and saved, before it is learnt.

    :param n_inputs: length of X
    :param action: the action space
    :param n_conditions: of the longest program
    :param cell: of its conditions
    :param condition_size: their hidden units, or the sums of a ``"min"``
    :raises ValueError: naming the limit and what may be lowered
    """
    hidden = 0 if cell in STATELESS else condition_size
    n_rows = condition_size if cell == "min" else hidden * len(GATES[cell])
    of_condition = n_rows * (n_inputs + hidden + 2) + (n_inputs if cell == "affine" else hidden) + 1
    n_numbers = (n_conditions + 1) * action.n_outputs * (n_inputs + 1) + n_conditions * of_condition
    for what, given, most, advice in (
        ("inputs", n_inputs, MAX_INPUTS, "give shorter observations"),
        ("outputs", action.n_outputs, MAX_OUTPUTS, "give fewer actions"),
        ("conditions", n_conditions, MAX_CONDITIONS, "give a smaller depth, or n_conditions"),
        ("weights and constants", n_numbers, MAX_NUMBERS, "give a smaller depth, condition_size or observation"),
    ):
        if given > most:
            raise ValueError(f"a program of {given} {what} is not accepted; it has at most {most}: {advice}")


def _check_action(action: ActionSpec) -> None:
    if not isinstance(action, ActionSpec):
        raise ValueError(f"action: {type(action).__name__} given; an ActionSpec is accepted")
    if action.kind not in get_args(ActionKind):
        kinds = ", ".join(get_args(ActionKind))
        raise ValueError(f"action.kind={_short(action.kind)} is not accepted; it is one of {kinds}")
    sizes = action.sizes
    if not isinstance(sizes, tuple) or not sizes or not all(_is_int(size) and size > 0 for size in sizes):
        raise ValueError(f"action.sizes={_short(sizes)} is not accepted; it is a tuple of whole numbers above 0")
    if action.kind != "multi_discrete" and len(sizes) != 1:
        raise ValueError(f"action.sizes={_short(sizes)} is not accepted; {action.kind!r} has one size")
    if action.n_outputs > MAX_OUTPUTS:
        raise ValueError(f"action.sizes={_short(sizes)} is not accepted; they sum to at most {MAX_OUTPUTS}")
    start = action.start
    if not _is_int(start) or not _is_finite(start) or (start != 0 and action.kind != "discrete"):
        raise ValueError(
            f"action.start={_short(start)} is not accepted; "
            "it is a whole number from -2**53 to 2**53, and 0 unless kind is 'discrete'"
        )
    n_bounds = sizes[0] if action.kind == "box" else 0
    _check_vector("action.low", action.low, n_bounds)
    _check_vector("action.high", action.high, n_bounds)
    if any(low > high for low, high in zip(action.low, action.high, strict=True)):
        raise ValueError("action.low: a lower bound is above its upper bound in action.high")


def _check_inputs(program: ProgramData) -> None:
    if not _is_int(program.n_observations) or not 0 <= program.n_observations <= MAX_INPUTS:
        raise ValueError(f"n_observations={_short(program.n_observations)} is not accepted; 0 to {MAX_INPUTS}")
    if not isinstance(program.interaction, bool):
        raise ValueError(f"interaction={_short(program.interaction)} is not accepted; it is true or false")
    history = program.action.interaction_size if program.interaction else 0
    n_inputs = program.n_observations + history
    if n_inputs > MAX_INPUTS:
        raise ValueError(f"{n_inputs} inputs given, {history} for the history; at most {MAX_INPUTS} are accepted")
    _check_names("input_names", program.input_names, n_inputs)


def _check_condition(path: str, condition: Condition, n_inputs: int) -> None:
    if not isinstance(condition, Condition):
        raise ValueError(f"{path}: {type(condition).__name__} given; a Condition is accepted")
    if condition.cell not in tuple(GATES):
        raise ValueError(f"{path}.cell={_short(condition.cell)} is not accepted; it is one of {', '.join(GATES)}")
    n_hidden = condition.hidden_size
    if condition.remembers and n_hidden == 0:
        raise ValueError(f"{path}.readout: 0 hidden units given; a recurrent cell has at least 1")
    if condition.cell == "min":
        _check_min(path, condition, n_inputs)
        return
    n_rows = n_hidden * len(GATES[condition.cell])
    _check_matrix(f"{path}.weight_ih", condition.weight_ih, n_rows, n_inputs)
    _check_matrix(f"{path}.weight_hh", condition.weight_hh, n_rows, n_hidden)
    _check_vector(f"{path}.bias_ih", condition.bias_ih, n_rows)
    _check_vector(f"{path}.bias_hh", condition.bias_hh, n_rows)
    _check_vector(f"{path}.readout", condition.readout, n_hidden or n_inputs)
    _check_vector(f"{path}.readout_bias", (condition.readout_bias,), 1)


def _check_min(path: str, condition: Condition, n_inputs: int) -> None:
    """Check the least of some sums."""
    if not isinstance(condition.bias_ih, tuple) or not condition.bias_ih:
        raise ValueError(
            f"{path}.bias_ih: {_count(condition.bias_ih, 'numbers')} given; for 'min' a tuple of at least 1 is accepted"
        )
    _check_vector(f"{path}.bias_ih", condition.bias_ih, len(condition.bias_ih))
    _check_matrix(f"{path}.weight_ih", condition.weight_ih, len(condition.bias_ih), n_inputs)
    for name in ("weight_hh", "bias_hh", "readout"):
        _check_vector(f"{path}.{name}", getattr(condition, name), 0)
    _check_vector(f"{path}.readout_bias", (condition.readout_bias,), 1)
    if condition.readout_bias != 0:
        raise ValueError(f"{path}.readout_bias={_short(condition.readout_bias)} is not accepted; of 'min' it is 0")


def _count_numbers(program: ProgramData) -> int:
    n_numbers = len(program.controllers) * program.action.n_outputs * (program.n_inputs + 1)
    for condition in program.conditions:
        n_columns = program.n_inputs + condition.hidden_size + 2
        n_numbers += len(condition.bias_ih) * n_columns + len(condition.readout) + 1
    return n_numbers


def _check_controller(path: str, controller: Controller, program: ProgramData) -> None:
    if not isinstance(controller, Controller):
        raise ValueError(f"{path}: {type(controller).__name__} given; a Controller is accepted")
    _check_matrix(f"{path}.weights", controller.weights, program.action.n_outputs, program.n_inputs)
    _check_vector(f"{path}.bias", controller.bias, program.action.n_outputs)


def _check_matrix(path: str, matrix: Any, n_rows: int, n_columns: int) -> None:
    if not isinstance(matrix, tuple) or len(matrix) != n_rows:
        raise ValueError(f"{path}: {_count(matrix, 'rows')} given; a tuple of {n_rows} rows is accepted")
    for index, row in enumerate(matrix):
        _check_vector(f"{path}[{index}]", row, n_columns)


def _check_vector(path: str, vector: Any, length: int) -> None:
    if not isinstance(vector, tuple) or len(vector) != length:
        raise ValueError(f"{path}: {_count(vector, 'numbers')} given; a tuple of {length} numbers is accepted")
    for value in vector:
        if not _is_finite(value):
            raise ValueError(f"{path}: {_short(value)} is not accepted; finite numbers are")


def _check_names(path: str, names: Any, length: int) -> None:
    if not isinstance(names, tuple) or len(names) != length:
        raise ValueError(f"{path}: {_count(names, 'names')} given; a tuple of {length} names is accepted")
    for name in names:
        # Names end up in source code and markup, so nothing that breaks a line may pass.
        if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME_LENGTH or not name.isprintable():
            raise ValueError(
                f"{path}: {_short(name)} is not accepted; a name is 1 to {MAX_NAME_LENGTH} printable characters"
            )


def _check_json(path: str, value: Any, depth: int) -> None:
    if depth == 0:
        raise ValueError(f"{path}: nested more than {MAX_METADATA_DEPTH} deep, which is not accepted")
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise ValueError(f"{path}: the key {_short(key)} is not accepted; keys are strings")
            _check_json(f"{path}[{_short(key)}]", item, depth - 1)
    elif isinstance(value, list):
        for item in value:
            _check_json(f"{path}[]", item, depth - 1)
    elif value is not None and type(value) not in (str, bool) and not _is_json_number(value):
        raise ValueError(
            f"{path}: {_short(value)} ({type(value).__name__}) is not accepted; "
            "JSON values are: dict, list, str, int of 64 bits, finite float, bool, None"
        )


def _is_int(value: Any) -> bool:
    return type(value) is int


def _is_json_number(value: Any) -> bool:
    return abs(value) < 2**63 if _is_int(value) else type(value) is float and math.isfinite(value)


def _is_finite(value: Any) -> bool:
    """Whether ``value`` is a Python number that a float holds exactly."""
    if _is_int(value):
        return abs(value) <= 2**53
    return isinstance(value, float) and math.isfinite(value)


def _count(value: Any, what: str) -> str:
    return f"{len(value)} {what}" if isinstance(value, Sequence) else f"{_short(value)} instead of {what}"


def _short(value: Any) -> str:
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**50 else "a huge whole number"
    return text if len(text) <= 60 else text[:57] + "..."
