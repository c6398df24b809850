"""A fitted list as a program on raw observations, its numbers as round as its behaviour allows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sb3_progpolicy.imitation.decision_list import DecisionList, Floats
from sb3_progpolicy.programs.program import Program
from sb3_progpolicy.programs.syntax import Condition, Controller, Expression, IfThenElse
from sb3_progpolicy.spaces import ActionSpec

#: Significant ones of the numbers of a program; the first that its episodes allow are taken.
DIGITS = (2, 3, 4, 6)


def to_program(
    raw: DecisionList,
    spec: ActionSpec,
    input_names: tuple[str, ...],
    output_names: tuple[str, ...],
    interaction: bool,
    **metadata: Any,
) -> Program:
    """Return a program.

    :param raw: on raw observations, with outputs in the unit of the actions
    :param spec: the action space
    :param input_names: one for each number of X
    :param output_names: one for each output
    :param interaction: whether X goes on with the previous action, reward and done flag
    :param metadata: JSON values to keep with it
    """
    controllers = [
        Controller(tuple(map(tuple, matrix[:, :-1].tolist())), tuple(matrix[:, -1].tolist()))
        for matrix in raw.controllers
    ]
    body: Expression = controllers[-1]
    for index in reversed(range(raw.n_branches - 1)):
        sums = raw.sums_of(index)
        weights, constants = tuple(map(tuple, sums[:, :-1].tolist())), tuple(sums[:, -1].tolist())
        if len(sums) == 1:
            condition = Condition("affine", (), (), (), (), weights[0], constants[0])
        else:
            condition = Condition("min", weights, (), constants, (), (), 0.0)
        body = IfThenElse(condition, controllers[index], body)
    return make_program(body, spec, input_names, output_names, interaction, **metadata)


def make_program(
    body: Expression,
    spec: ActionSpec,
    input_names: tuple[str, ...],
    output_names: tuple[str, ...],
    interaction: bool,
    **metadata: Any,
) -> Program:
    """Return a program. See :func:`to_program`.

    :param body: on raw observations, with outputs in the unit of the actions
    """
    return Program(
        body=body,
        n_observations=len(input_names) - (spec.interaction_size if interaction else 0),
        action=spec,
        interaction=interaction,
        input_names=input_names,
        output_names=output_names,
        metadata=metadata,
    )


def rounded(raw: DecisionList, digits: int, unit: Floats) -> DecisionList:
    """Return the list with numbers of so many significant digits; the largest weight of a condition's sum becomes 1.

    Constants of controllers are rounded to as many digits after the point, relative to what the controllers give.

    :param raw: on raw observations
    :param digits: of each number
    :param unit: size of an output that is large, ``(n_outputs,)``
    """
    largest = np.abs(raw.conditions[:, :-1]).max(axis=1, keepdims=True, initial=0.0)
    conditions = raw.conditions / np.where(largest > 0, largest, 1.0)
    controllers = significant(raw.controllers, digits)
    controllers[..., -1] = significant(np.round(controllers[..., -1] / unit, digits) * unit, digits + 2)
    return replace(raw, conditions=significant(conditions, digits), controllers=controllers)


def significant(numbers: Floats, digits: int) -> Floats:
    """Return numbers rounded to significant digits.

    :param numbers: of any shape
    :param digits: of each
    """
    flat = [float(f"{number:.{digits - 1}e}") for number in np.asarray(numbers, dtype=np.float64).ravel().tolist()]
    return np.array(flat).reshape(np.shape(numbers)) + 0.0  # no negative zeros
