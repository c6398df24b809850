"""Values as JSON: numbers, text, lists, arrays, spaces and schedules; classes by name, of an explicit list."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from torch import nn, optim

from sb3_progpolicy.normalization import NormalizingExtractor

#: The classes that a file may name. Nothing is imported by a name that a file gives.
CLASSES: Mapping[str, type] = {
    kind.__name__: kind
    for kind in (
        *(nn.CELU, nn.ELU, nn.GELU, nn.Hardswish, nn.Identity, nn.LeakyReLU, nn.Mish, nn.ReLU, nn.ReLU6, nn.SELU),
        *(nn.Sigmoid, nn.SiLU, nn.Softplus, nn.Softsign, nn.Tanh),
        *(optim.Adadelta, optim.Adagrad, optim.Adam, optim.Adamax, optim.AdamW, optim.NAdam, optim.RAdam),
        *(optim.RMSprop, optim.SGD, RMSpropTFLike, FlattenExtractor, NormalizingExtractor),
    )
}
_DTYPES = (
    "bool",
    "float16",
    "float32",
    "float64",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)
_KIND = "__kind__"  # marks what JSON has no form of its own for


class NotDataError(ValueError):
    """A value that has no form as data."""


class ModelFormatError(ValueError):
    """A file that is not a model, is damaged, or holds what is not accepted."""


def to_data(value: Any) -> Any:
    """Return a value as JSON values, from which :func:`from_data` makes an equal one.

    :raises NotDataError: if the value is something else than data, such as a function
    """
    if value is None or type(value) in (bool, int, str):
        return value
    if isinstance(value, np.generic):
        return to_data(value.item())
    if type(value) is float:
        return value if math.isfinite(value) else {_KIND: "float", "value": str(value)}
    if type(value) is list:
        return [to_data(item) for item in value]
    if type(value) is dict and all(type(key) is str and key != _KIND for key in value):
        return {key: to_data(item) for key, item in value.items()}
    if isinstance(value, type) and CLASSES.get(value.__name__) is value:
        return {_KIND: "class", "name": value.__name__}
    return _object_to_data(value)


def _object_to_data(value: Any) -> Any:
    kind = type(value)
    if kind is tuple:
        return {_KIND: "tuple", "items": to_data(list(value))}
    if kind is np.ndarray and value.dtype.name in _DTYPES:
        return {_KIND: "array", "dtype": value.dtype.name, "shape": list(value.shape), "items": _items(value)}
    if kind is LinearSchedule:
        return {_KIND: "linear_schedule", **to_data(vars(value))}
    if kind is ConstantSchedule:
        return {_KIND: "constant_schedule", "val": to_data(value.val)}
    if kind is FloatSchedule:
        return {_KIND: "float_schedule", "schedule": to_data(value.value_schedule)}
    if kind is spaces.Box:
        return {_KIND: "box", "low": to_data(value.low), "high": to_data(value.high)}
    if kind is spaces.Discrete:
        return {_KIND: "discrete", "n": int(value.n), "start": int(value.start)}
    if kind is spaces.MultiDiscrete:
        return {_KIND: "multi_discrete", "nvec": to_data(value.nvec), "start": to_data(value.start)}
    if kind is spaces.MultiBinary:
        return {_KIND: "multi_binary", "shape": list(value.shape)}
    raise NotDataError(f"{value!r:.80} is not data")


def _items(array: np.ndarray[Any, Any]) -> list[Any]:
    """The numbers of an array; JSON has none that are not finite, so these become text."""
    flat = array.ravel().tolist()
    return flat if np.isfinite(array).all() else [x if math.isfinite(x) else str(x) for x in flat]


def from_data(data: Any) -> Any:
    """Return the value that :func:`to_data` has written.

    :raises ModelFormatError: if the data describe none
    """
    if isinstance(data, list):
        return [from_data(item) for item in data]
    if not isinstance(data, dict):
        return data
    fields = {key: from_data(item) for key, item in data.items()}
    kind = fields.pop(_KIND, None)
    if kind is None:
        return fields
    if not isinstance(kind, str) or kind not in _MAKE:
        raise ModelFormatError(f"{_KIND}={kind!r:.40} is not accepted; known: {', '.join(_MAKE)}")
    try:
        return _MAKE[kind](**fields)
    except (ValueError, TypeError, AttributeError, AssertionError, OverflowError) as error:
        raise ModelFormatError(f"not a {kind}: {error}") from None


def _class(name: str) -> type:
    if name not in CLASSES:
        raise ValueError(f"class {name!r:.40} is not accepted; known: {', '.join(CLASSES)}")
    return CLASSES[name]


def _array(dtype: str, shape: list[int], items: list[Any]) -> np.ndarray[Any, Any]:
    if dtype not in _DTYPES:
        raise ValueError(f"dtype={dtype!r:.40} is not accepted; known: {', '.join(_DTYPES)}")
    return np.array(items, dtype=dtype).reshape(shape)


def _box(low: np.ndarray[Any, Any], high: np.ndarray[Any, Any]) -> spaces.Box:
    if low.shape != high.shape or low.dtype != high.dtype:
        raise ValueError(f"a box from {low.dtype} {low.shape} to {high.dtype} {high.shape}")
    return spaces.Box(low, high, dtype=low.dtype.type)


def _linear(start: float, end: float, end_fraction: float) -> LinearSchedule:
    numbers = [_finite(number) for number in (start, end, end_fraction)]
    if not numbers[2] > 0:
        raise ValueError(f"end_fraction={end_fraction!r} is not accepted; it is above 0")
    return LinearSchedule(*numbers)


def _finite(number: Any) -> Any:
    if type(number) not in (int, float) or not math.isfinite(number):
        raise ValueError(f"{number!r:.40} is not a finite number")
    return number


def _float_schedule(schedule: Any) -> FloatSchedule:
    if type(schedule) not in (LinearSchedule, ConstantSchedule):
        raise ValueError(f"{schedule!r:.40} is not a schedule")
    return FloatSchedule(schedule)


_MAKE: Mapping[str, Any] = {
    "float": lambda value: {"inf": math.inf, "-inf": -math.inf}.get(value, math.nan),
    "tuple": lambda items: tuple(items),
    "class": _class,
    "array": _array,
    "linear_schedule": _linear,
    "constant_schedule": lambda val: ConstantSchedule(_finite(val)),
    "float_schedule": _float_schedule,
    "box": _box,
    "discrete": lambda n, start: spaces.Discrete(n, start=start),
    "multi_discrete": lambda nvec, start: spaces.MultiDiscrete(nvec, start=start),
    "multi_binary": lambda shape: spaces.MultiBinary(shape[0] if len(shape) == 1 else shape),
}
