"""Reading parts of a state that a user gives."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np

Cell = tuple[int, int]


def is_sequence(value: Any) -> bool:
    """Return whether a value is a list, a tuple, an array or the like, but not a text."""
    return isinstance(value, Sequence | np.ndarray) and not isinstance(value, str) and getattr(value, "ndim", 1) > 0


def read_cell(name: str, value: Any, n_rows: int, n_columns: int) -> Cell:
    """Return a cell as a tuple of row and column.

    :param name: of the part of the state, for the error
    :param value: a pair of whole numbers
    :param n_rows: how many rows there are
    :param n_columns: how many columns there are
    :raises ValueError: if it is not a cell
    """
    numbers = list(value) if is_sequence(value) else []
    is_pair = len(numbers) == 2 and all(isinstance(part, Integral) and not isinstance(part, bool) for part in numbers)
    if not is_pair or not (0 <= numbers[0] < n_rows and 0 <= numbers[1] < n_columns):
        raise ValueError(
            f"{name}: {value!r} is not accepted; a cell is a row from 0 to {n_rows - 1} and a column from 0 to "
            f"{n_columns - 1}"
        )
    return int(numbers[0]), int(numbers[1])


def check_choice(name: str, value: Any, choices: Sequence[Any]) -> None:
    """Raise ``ValueError`` if an argument is not one of the choices."""
    if value not in choices:
        allowed = ", ".join(repr(choice) for choice in choices)
        raise ValueError(f"{name}={value!r} is not accepted; {name} is one of {allowed}")
