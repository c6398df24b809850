"""Programs from programs."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.programs.syntax import Condition, Controller, Expression, IfThenElse, Matrix, ProgramData, Vector

AnyProgram = TypeVar("AnyProgram", bound=ProgramData)


def fold_normalization(program: AnyProgram, mean: NDArray[np.floating], scale: NDArray[np.floating]) -> AnyProgram:
    """Return the program that computes on X what the given one computes on ``(X - mean) * scale``.

    :param program: reads normalised numbers
    :param mean: ``(n_inputs,)``
    :param scale: ``(n_inputs,)``
    """

    def folded(weights: Matrix, bias: Vector) -> tuple[Matrix, Vector]:
        matrix = np.array(weights, dtype=np.float64).reshape(len(bias), -1) * scale
        shifted = np.array(bias) - matrix @ mean
        return tuple(map(tuple, matrix.tolist())), tuple(shifted.tolist())

    def controller(node: Controller) -> Controller:
        return Controller(*folded(node.weights, node.bias))

    def condition(node: Condition) -> Condition:
        if node.cell == "affine":
            (readout,), (bias,) = folded((node.readout,), (node.readout_bias,))
            return dataclasses.replace(node, readout=readout, readout_bias=bias)
        weights, bias_ih = folded(node.weight_ih, node.bias_ih)
        return dataclasses.replace(node, weight_ih=weights, bias_ih=bias_ih)

    body: Expression = controller(program.controllers[-1])
    for test, then in reversed(list(zip(program.conditions, program.controllers[:-1], strict=True))):
        body = IfThenElse(condition(test), controller(then), body)
    return dataclasses.replace(program, body=body)
