"""Growing a program by one condition, so that nothing it does is changed at first.

A program is a decision list, ``if B_1 then C'_1 elif ... else C``. Its last two branches can be divided without a
change: the else-branch as it stands, and the last then-branch after ``if B then C' else C`` is turned round into
``if -B then C else C'``. Both halves begin with the controller of the branch, whatever the new condition says.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, cast

import torch as th

from sb3_progpolicy.differentiable.conditions import Conditions
from sb3_progpolicy.differentiable.module import ProgramModule
from sb3_progpolicy.differentiable.tied import TiedLinear
from sb3_progpolicy.programs.syntax import GATES

#: A new condition is this many temperatures away from 0 where its sum is one standard deviation away: decided for most
#: states, and not so much that it has no gradient.
SHARPNESS = 2.0
#: Least temperature that sharpness is measured by; below, a gradient step would be larger than all of a condition.
LEAST_TEMPERATURE = 0.1
#: Bias of gates that are to be open, or, with the other sign, closed, in a new recurrent condition.
GATE_BIAS = 2.0


@dataclass(frozen=True)
class Division:
    """Which branch of a program to divide, and by what.

    :param then: whether it is the last then-branch; otherwise it is the else-branch
    :param weight: of X, one number per input
    :param bias: the first half is where ``weight · X + bias >= 0``, a sum of standard deviation 1
    """

    then: bool
    weight: tuple[float, ...]
    bias: float


@th.no_grad()
def divide(module: ProgramModule, division: Division, optimizer: th.optim.Optimizer | None = None) -> None:
    """Put a condition before a branch of the selected program, with the branch's controller on both sides of it.

    Soft and crisp program do what they did (the crisp one but where a condition that is turned round is exactly 0).
    The moments that an optimizer keeps of controllers move with them; those of the conditions are dropped, as for a new
    layer, so that the first steps of the new one are not measured by the gradients of those that were never run.

    :param module: with a selected program and a layer left for another condition
    :param division: what to divide
    :param optimizer: of the module's parameters
    :raises ValueError: if there is no layer left, no program is selected, or no then-branch is there
    """
    n = module.search.most_likely()
    if module.search.searching or n + 1 >= module.depth or (division.then and not n):
        raise ValueError(
            f"{division!r:.60} is not accepted for a program of {n} conditions; depth={module.depth} has up to "
            f"{module.depth - 1}, the search has to be over, and without a condition there is no then-branch"
        )
    last, new_last = module.depth - 1 + n, module.depth + n
    for tensor in _tensors(module.controllers, optimizer):
        rows = tensor.unflatten(0, (module.n_controllers, -1))
        if division.then:
            rows[[n - 1, last]] = rows[[last, n - 1]]
        rows[[n, new_last]] = rows[last].clone()
    if division.then:
        _negate(module.conditions, n - 1)
    scale = SHARPNESS * max(float(module.temperature), LEAST_TEMPERATURE)
    _put(module.conditions, n, th.tensor(division.weight), division.bias, scale)
    if optimizer is not None:
        for parameter in module.conditions.parameters():
            optimizer.state.pop(parameter, None)
    module.search.select(n + 1)


def _tensors(controllers: Any, optimizer: th.optim.Optimizer | None) -> Iterable[th.Tensor]:
    """The parameters of the controllers and the moments of the same shape, all of which have a row per controller."""
    parameters = [controllers.free] if isinstance(controllers, TiedLinear) else [controllers.weight, controllers.bias]
    for parameter in parameters:
        yield parameter
        for moment in (optimizer.state.get(parameter, {}) if optimizer is not None else {}).values():
            if isinstance(moment, th.Tensor) and moment.shape == parameter.shape:
                yield moment


def _negate(conditions: Conditions, k: int) -> None:
    if conditions.recurrent:
        conditions.readout[k] *= -1
        conditions.readout_bias[k] *= -1
    else:
        conditions.affine.weight[k] *= -1
        conditions.affine.bias[k] *= -1


def _put(conditions: Conditions, k: int, weight: th.Tensor, bias: float, scale: float) -> None:
    """Let condition k be ``scale (weight · X + bias)``, or a recurrent one that is about ``scale tanh`` of it.

    The first unit of a recurrent condition computes it, with gates that are set to forget and can learn not to; the
    others stay as they are and are not read at first.
    """
    if not conditions.recurrent:
        conditions.affine.weight[k] = scale * weight
        conditions.affine.bias[k] = scale * bias
        return
    unit, gates = k * conditions.size, GATES[conditions.cell]
    constants = {"z": -GATE_BIAS, "f": -GATE_BIAS, "i": GATE_BIAS, "o": GATE_BIAS}  # r stays as it is
    rnn = {name: cast(th.Tensor, getattr(conditions.rnn, f"{name}_l0")) for name in ("weight_ih", "weight_hh")}
    rnn |= {name: cast(th.Tensor, getattr(conditions.rnn, f"{name}_l0")) for name in ("bias_ih", "bias_hh")}
    for number, gate in enumerate(gates):
        if gate == "r":
            continue
        row, reads = number * conditions.hidden_size + unit, gate in ("h", "n", "g")
        rnn["weight_ih"][row] = weight if reads else 0
        rnn["bias_ih"][row] = bias if reads else constants[gate]
        rnn["weight_hh"][row] = 0
        rnn["bias_hh"][row] = 0
    conditions.readout[k] = 0
    conditions.readout[k, 0] = scale
    conditions.readout_bias[k] = 0
