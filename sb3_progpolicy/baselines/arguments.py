"""Checks of the arguments that the baselines share."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces


def check_range(name: str, value: float, low: float, high: float = float("inf"), *, open_low: bool = False) -> None:
    """Raise an error unless ``low <= value <= high``.

    :param name: of the argument
    :param value: given for it
    :param low: least value accepted, or the bound that is not reached if ``open_low``
    :param high: greatest value accepted
    :raises ValueError: for a value outside, or NaN
    """
    inside = (low < value if open_low else low <= value) and value <= high
    if not inside:
        bound = f"{'more than' if open_low else 'at least'} {low:g}"
        limit = "" if high == float("inf") else f" and at most {high:g}"
        raise ValueError(f"{name}={value!r} is not accepted; it is {bound}{limit}")


def check_off_policy(arguments: dict[str, Any]) -> None:
    """Raise an error if one of SB3's off-policy arguments is out of range.

    :param arguments: of the constructor, by name
    :raises ValueError: at the first that is
    """
    for name, low in {"buffer_size": 1, "learning_starts": 0, "batch_size": 1, "gradient_steps": -1}.items():
        check_range(name, arguments[name], low)
    check_range("tau", arguments["tau"], 0, 1)
    check_range("gamma", arguments["gamma"], 0, 1)


def check_action_space(algorithm: str, space: spaces.Space[Any], accepted: tuple[type[spaces.Space[Any]], ...]) -> None:
    """Raise an error if an algorithm has no use for an action space.

    :param algorithm: its name
    :param space: given
    :param accepted: types of space
    :raises ValueError: naming the types accepted
    """
    if not isinstance(space, accepted):
        names = " or ".join(kind.__name__ for kind in accepted)
        raise ValueError(f"{algorithm} takes {names} actions; the environment has {space}")
