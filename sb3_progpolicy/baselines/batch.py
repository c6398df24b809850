"""What a gradient step is made from, and the step of one optimizer."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs


class Batch(NamedTuple):
    """Transitions of one gradient step.

    :param observations: ``(batch, ...)``
    :param actions: ``(batch, action_dim)`` in -1 to 1, or ``(batch, 1)`` whole numbers from 0 to ``n_actions - 1``
    :param rewards: ``(batch, 1)``
    :param next_observations: ``(batch, ...)``
    :param dones: ``(batch, 1)``; 1 where the episode ended by itself, 0 elsewhere and where its time was up
    :param discounts: of the value of the next observation, ``(batch, 1)`` or a number
    """

    observations: PyTorchObs
    actions: th.Tensor
    rewards: th.Tensor
    next_observations: PyTorchObs
    dones: th.Tensor
    discounts: th.Tensor | float


CheckLoss = Callable[[th.Tensor], None]  # raises FloatingPointError for a loss that is not finite


def minimize(loss: th.Tensor, optimizer: th.optim.Optimizer, check: CheckLoss) -> th.Tensor:
    """Make one step of an optimizer, unless the loss is not finite, and return the loss without gradient.

    :param loss: scalar
    :param optimizer: of the parameters that the loss is of
    :param check: called with the loss before any parameter changes
    """
    detached = loss.detach()
    check(detached)
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return detached
