"""Training stops at the first number that is not finite, before it can reach the parameters or a checkpoint."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th


def check_step(what: str, values: Any, timesteps: int) -> None:
    """Raise an error that says which environment gave a number that is not finite, and when.

    :param what: such as ``"reward"``
    :param values: of one step, ``(n_envs, ...)``, or a dict of such; whole numbers are not looked at
    :param timesteps: environment steps made so far
    :raises FloatingPointError: at the first NaN or infinity
    """
    if isinstance(values, dict):
        for key, part in values.items():
            check_step(f"{what} {key!r}", part, timesteps)
        return
    array = np.asarray(values)
    # The sum of squares is cheaper, and never finite where a number is not.
    if array.dtype.kind != "f" or math.isfinite(np.vdot(array, array)) or np.isfinite(array).all():
        return
    finite = np.isfinite(array.reshape(len(array), -1)).all(axis=1)
    raise FloatingPointError(
        f"{what} of environment {int(finite.argmin())} is not finite (NaN or infinite) at step {timesteps}; "
        "training has stopped"
    )


_ADVICE = "A smaller learning_rate, normalize_observations or scale_rewards may help"


def check_update(loss: th.Tensor, timesteps: int, advice: str = _ADVICE) -> None:
    """Raise an error if a loss is not finite.

    :param loss: of a minibatch
    :param timesteps: environment steps made so far
    :param advice: last sentence of the message, what may help
    :raises FloatingPointError: for NaN or infinity
    """
    if not bool(th.isfinite(loss)):
        raise FloatingPointError(
            f"the loss is not finite (NaN or infinite) in the update at step {timesteps}; training has stopped. "
            f"{advice}"
        )


def check_parameters(parameters: Iterable[tuple[str, th.Tensor]], timesteps: int) -> None:
    """Raise an error that names the first parameter that is not finite.

    :param parameters: names and tensors
    :param timesteps: environment steps made so far
    :raises FloatingPointError: at the first NaN or infinity
    """
    for name, parameter in parameters:
        if not bool(th.isfinite(parameter).all()):
            raise FloatingPointError(
                f"parameter {name} is not finite (NaN or infinite) after the update at step {timesteps}; training has "
                "stopped. A smaller learning_rate or max_grad_norm may help"
            )
