"""Bounds of the numbers that trainings take, from Python, a file or the command line alike."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any

#: Largest number of environments, and of transitions in a rollout.
MAX_ENVS, MAX_ROLLOUT = 2**16, 2**28
_POSITIVE = (math.ulp(0.0), math.inf)
#: Both included.
BOUNDS: Mapping[str, tuple[float, float]] = {
    "learning_rate": (0.0, math.inf),
    "meta_learning_rate": (0.0, math.inf),
    "temperature": _POSITIVE,
    "action_temperature": _POSITIVE,
    "action_std": _POSITIVE,
    "clip_range": _POSITIVE,
    "clip_range_vf": _POSITIVE,
    "max_grad_norm": _POSITIVE,
    "target_kl": _POSITIVE,
    "gamma": (0.0, 1.0),
    "gae_lambda": (0.0, 1.0),
    "search_fraction": (0.0, 1.0),
    "vf_coef": (0.0, math.inf),
    "length_coef": (0.0, math.inf),
    "n_envs": (1, MAX_ENVS),
    "n_steps": (1, MAX_ROLLOUT),
    "n_timesteps": (1, 2**53),
    "max_episode_steps": (1, 2**53),
    # As SB3 has them: -1 for as many gradient steps as steps were made, or noise drawn once a rollout.
    "gradient_steps": (-1, math.inf),
    "sde_sample_freq": (-1, math.inf),
    "learning_starts": (0, math.inf),
    "high_learning_starts": (0, math.inf),
}


def limits_of(value: float, low: float, high: float) -> str:
    """Return in words which bound a number is beyond.

    :param value: the number
    :param low: least one
    :param high: largest one
    """
    return "above 0" if low == math.ulp(0.0) else f"of at least {low:g}" if value < low else f"of at most {high:g}"


def check_whole(name: str, value: Any, least: int) -> None:
    """Check a whole number.

    :param name: of the argument
    :param value: given
    :param least: that is accepted
    :raises ValueError: if it is not one, or a smaller one
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < least:
        raise ValueError(f"{name}={value!r} is not accepted; it is a whole number of at least {least}")


def check_number(name: str, value: Any, may_be_infinite: bool = False) -> None:
    """Check a number against the bounds of its name.

    :param name: of the argument
    :param value: given
    :param may_be_infinite: whether infinity is accepted, where nothing is limited
    :raises ValueError: if it is not a number, or beyond its bounds
    """
    low, high = BOUNDS.get(name, (-math.inf, math.inf))
    if isinstance(value, bool) or not isinstance(value, Real) or math.isnan(float(value)):
        raise ValueError(f"{name}={value!r} is not accepted; it is a number")
    number = float(value)
    if math.isinf(number) and not (may_be_infinite and number > 0):
        raise ValueError(f"{name}={value!r} is not accepted; it is a finite number")
    if not low <= number <= high:
        raise ValueError(f"{name}={value!r} is not accepted; it is a number {limits_of(number, low, high)}")
