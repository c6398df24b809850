"""All numbers of a decision list at once: gradient descent on the expected loss of a branch that is drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.imitation.decision_list import Data, DecisionList
from sb3_progpolicy.imitation.losses import Loss

if TYPE_CHECKING:
    import torch as th

_SLOPE = 3.0  # length of a condition's weights at the start


def fine_tune(
    loss: Loss,
    program: DecisionList,
    data: Data,
    n_steps: int,
    seed: int,
    temperatures: tuple[float, float] = (0.3, 0.03),
    learning_rate: float = 1e-2,
    batch_size: int = 512,
    keep_zeros: bool = False,
) -> DecisionList:
    """Return the list after Adam on the expected loss of the branch drawn by the conditions' sigmoids.

    It is the loss of the branch that acts, not of a mixture of actions, which no branch would take; while the
    temperature falls, the draw becomes the crisp choice.

    :param loss: of the action space
    :param program: to begin with
    :param data: labelled states
    :param n_steps: of Adam
    :param seed: of the batches
    :param temperatures: of the sigmoids, at the start and at the end
    :param learning_rate: at the start; it falls to almost 0
    :param batch_size: states a step
    :param keep_zeros: whether weights that are 0 stay 0
    """
    import torch as th

    generator = th.Generator().manual_seed(seed)
    inputs, targets = (th.tensor(part, dtype=th.float32) for part in (data.inputs, data.targets))
    weights = th.tensor(data.weights / data.weights.mean(), dtype=th.float32)
    lengths = np.linalg.norm(program.conditions[:, :-1], axis=1, keepdims=True)
    scaled = program.conditions / np.maximum(lengths, 1e-9) * _SLOPE
    conditions = th.tensor(scaled, dtype=th.float32, requires_grad=True)
    controllers = th.tensor(program.controllers, dtype=th.float32, requires_grad=True)
    parameters = [conditions, controllers] if len(scaled) else [controllers]
    masks = [(parameter != 0).float() for parameter in parameters]
    optimizer = th.optim.Adam(parameters, lr=learning_rate)
    places = _places_of_sums(program)
    first, last = temperatures
    for step in range(n_steps):
        done = step / n_steps
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * (1 - done) + 1e-5
        rows = th.randint(len(data), (batch_size,), generator=generator)
        outputs = th.einsum("nd,kod->nko", inputs[rows], controllers)
        losses = loss.expected(outputs, targets[rows])
        values = inputs[rows] @ conditions.T
        if places:
            values = th.stack([values[:, place].amin(dim=1) for place in places], dim=1)
        chances = branch_chances(values / (first * (last / first) ** done))
        objective = ((chances * losses).sum(dim=1) * weights[rows]).mean()
        optimizer.zero_grad()
        objective.backward()
        if keep_zeros:
            for parameter, mask in zip(parameters, masks, strict=True):
                assert parameter.grad is not None
                parameter.grad *= mask
        optimizer.step()
    return replace(
        program,
        conditions=conditions.detach().double().numpy(),
        controllers=controllers.detach().double().numpy(),
    )


def _places_of_sums(program: DecisionList) -> list[NDArray[np.intp]]:
    """Return the indices of the sums of each condition; none if each condition is one sum."""
    if len(program.owners) < program.n_branches:
        return []
    return [np.flatnonzero(program.owners == condition) for condition in range(program.n_branches - 1)]


def branch_chances(values: th.Tensor) -> th.Tensor:
    """Return how likely each branch acts, ``(n, n_branches)``, for the conditions' values ``(n, n_branches - 1)``."""
    import torch as th

    holds, fails = (th.nn.functional.logsigmoid(sign * values) for sign in (1, -1))
    never = th.zeros(len(values), 1)
    reached = th.cat([never, fails.cumsum(dim=1)], dim=1)
    return (reached + th.cat([holds, never], dim=1)).exp()
