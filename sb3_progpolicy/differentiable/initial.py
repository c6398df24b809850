"""From a program as plain data to the parameters of the module that computes it: the inverse of extraction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch as th

from sb3_progpolicy.differentiable.module import Conditions, ProgramModule
from sb3_progpolicy.programs.syntax import GATES, STATELESS, Condition, ProgramData


def shape_of(program: ProgramData) -> tuple[str, int] | None:
    """Return the cell and the size that all conditions of a program have: hidden units, or affine sums of a min.

    Affine conditions are mins of one sum where others have more.

    :param program: well formed
    :return: ``None`` for a program without conditions
    :raises ValueError: if its conditions differ in them; a module computes all of its conditions in one layer
    """
    cells = {condition.cell for condition in program.conditions}
    if "min" in cells and cells <= set(STATELESS):
        return "min", max(len(condition.sums) for condition in program.conditions)
    shapes = {(condition.cell, condition.hidden_size or 1) for condition in program.conditions}
    if len(shapes) > 1:
        named = ", ".join(f"{cell} of size {size}" for cell, size in sorted(shapes))
        raise ValueError(f"conditions of different kinds ({named}) are not accepted; all are of one cell and one size")
    return shapes.pop() if shapes else None


@th.no_grad()
def put_program(module: ProgramModule, program: ProgramData) -> None:
    """Let a module be a program: its parameters are the program's, W is decided, and nothing else is run.

    Extracting the program gives it back, its numbers rounded to the module's precision. Inputs beyond the program's get
    the weight 0. Neither the temperature nor what the program does not use is changed.

    :param module: with as many layers, conditions of the same kind and the same outputs, and no fewer inputs
    :param program: what it is to compute
    :raises ValueError: if the program does not fit
    """
    if module.group is not None:
        raise ValueError("a module whose weights are tied over symmetries is not accepted; a program's need not be")
    n_conditions, shape, has = len(program.conditions), shape_of(program), module.conditions
    if program.n_inputs > module.n_inputs or program.action.sizes != module.action.sizes:
        raise ValueError(
            f"a program of {program.n_inputs} inputs and outputs {program.action.sizes} does not fit; the module has "
            f"{module.n_inputs} inputs and outputs {module.action.sizes}"
        )
    if n_conditions >= module.depth:
        raise ValueError(
            f"a program of {n_conditions} conditions does not fit; depth={module.depth} has up to {module.depth - 1}, "
            f"depth={n_conditions + 1} is needed"
        )
    if shape is not None and shape != (has.cell, has.size):
        raise ValueError(
            f"a program with conditions of the cell {shape[0]!r} and size {shape[1]} does not fit; the policy's are "
            f"{has.cell!r} of size {has.size}"
        )
    module.search.select(n_conditions)
    for k, condition in enumerate(program.conditions):
        _put_condition(has, k, condition)
    rows = module.controllers_in_use
    for parameter, values in (
        (module.controllers.weight, [controller.weights for controller in program.controllers]),
        (module.controllers.bias, [controller.bias for controller in program.controllers]),
    ):
        blocks = parameter.unflatten(0, (module.n_controllers, -1))
        for row, value in zip(rows, values, strict=True):
            _put(blocks[row], value)


def _put_condition(conditions: Conditions, k: int, condition: Condition) -> None:
    if not conditions.recurrent:
        # What has fewer sums than others has its last one several times; equal sums are trained alike.
        for number in range(conditions.n_sums):
            row = k * conditions.n_sums + number
            constant, weights = condition.sums[min(number, len(condition.sums) - 1)]
            _put(conditions.affine.weight[row], weights)
            conditions.affine.bias[row] = constant
        return
    units = slice(k * conditions.size, (k + 1) * conditions.size)
    n_gates = len(GATES[conditions.cell])
    for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
        parameter = cast(th.Tensor, getattr(conditions.rnn, f"{name}_l0"))
        blocks = parameter.unflatten(0, (n_gates, conditions.hidden_size))[:, units]
        rows: Sequence[object] = getattr(condition, name)
        for gate in range(n_gates):
            block = blocks[gate][:, units] if name == "weight_hh" else blocks[gate]
            _put(block, rows[gate * conditions.size : (gate + 1) * conditions.size])
    _put(conditions.readout[k], condition.readout)
    conditions.readout_bias[k] = condition.readout_bias


def _put(target: th.Tensor, values: object) -> None:
    """Write numbers into the first columns of a view of a parameter, and zeros into the others."""
    given = th.as_tensor(values, dtype=target.dtype, device=target.device)
    target.zero_()
    target[..., : given.shape[-1]] = given
