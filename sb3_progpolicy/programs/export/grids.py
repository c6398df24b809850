"""Blocks of inputs that lie on a grid, printed as a function of row and column, or as a table of whole numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sb3_progpolicy.programs.syntax import ProgramData

#: A picture shows sums of up to so many terms in full, and of larger ones so many.
FEW_TERMS, MOST_TERMS = 6, 3
MaxTerms = int | None | Literal["auto"]
#: A table has so many numbers that are not zero, and so many in all, columns and digits.
MIN_NUMBERS, MAX_NUMBERS, MAX_COLUMNS, MAX_SIZE = 4, 120, 12, 9999
Table = tuple[tuple[int, ...], ...]
#: Said where a function of row and column, or a table, is printed.
LEGEND = "{name}*(...) is summed over all cells {name}[row,column]; rows and columns count from 0."


@dataclass(frozen=True)
class Block:
    """A grid among the inputs.

    :param name: such as ``table``
    :param start: index of its first number; rows follow each other
    :param rows: how many
    :param columns: how many
    """

    name: str
    start: int
    rows: int
    columns: int

    @property
    def stop(self) -> int:
        """Index after its last number."""
        return self.start + self.rows * self.columns


def blocks_of(program: ProgramData) -> list[Block]:
    """Return the grids that a program's metadata names, as far as they fit its inputs.

    :param program: whose ``metadata["grids"]``, if it is there, is a list of ``name``, ``start``, ``rows``, ``columns``
    """
    named: Any = program.metadata.get("grids")
    found: list[Block] = []
    for entry in named if isinstance(named, (list, tuple)) else ():
        if not isinstance(entry, dict) or set(entry) != {"name", "start", "rows", "columns"}:
            continue
        name, sizes = entry["name"], [entry[key] for key in ("start", "rows", "columns")]
        if not isinstance(name, str) or not name.isidentifier() or any(type(size) is not int for size in sizes):
            continue
        block = Block(name, *sizes)
        after = found[-1].stop if found else 0
        if block.rows > 0 and block.columns > 0 and after <= block.start <= block.stop <= program.n_observations:
            found.append(block)
    return found


def as_function(block: Block, weights: Sequence[float]) -> tuple[float, float, float] | None:
    """Return ``(a, b, c)`` if the weights of a grid are ``a + b*row + c*column``, in whole numbers; else ``None``.

    :param block: the grid
    :param weights: of all inputs
    """
    given = np.array(weights[block.start : block.stop]).reshape(block.rows, block.columns)
    a = float(given[0, 0])
    b = float(given[1, 0] - a) if block.rows > 1 else 0.0
    c = float(given[0, 1] - a) if block.columns > 1 else 0.0
    rows, columns = np.indices(given.shape)
    whole = all(number == round(number) for number in (a, b, c))
    return (a, b, c) if whole and np.array_equal(a + b * rows + c * columns, given) else None


def as_table(block: Block, weights: Sequence[float]) -> Table | None:
    """Return the weights of a grid in its shape, if they are whole numbers, several and not too many; else ``None``.

    :param block: the grid
    :param weights: of all inputs
    """
    given = weights[block.start : block.stop]
    if len(given) > MAX_NUMBERS or block.columns > MAX_COLUMNS or sum(map(bool, given)) < MIN_NUMBERS:
        return None
    if any(number != round(number) or abs(number) > MAX_SIZE for number in given):
        return None
    numbers = [int(number) for number in given]
    return tuple(tuple(numbers[row * block.columns :][: block.columns]) for row in range(block.rows))


class Tables:
    """The tables of a print, named T1, T2 ... in the order in which they are met; equal ones have one name."""

    def __init__(self) -> None:
        self._names: dict[Table, str] = {}
        self._n_shown = 0

    def name(self, table: Table) -> str:
        """Return the name of a table."""
        return self._names.setdefault(table, f"T{len(self._names) + 1}")

    def new_lines(self) -> list[str]:
        """Return the lines of the tables that were named since the last time."""
        lines: list[str] = []
        for table, name in list(self._names.items())[self._n_shown :]:
            width = max(len(str(number)) for row in table for number in row)
            rows = ["  ".join(str(number).rjust(width) for number in row) for row in table]
            start = f"{name} = "
            lines += [(start if not place else " " * len(start)) + row for place, row in enumerate(rows)]
        self._n_shown = len(self._names)
        return lines


def block_text(block: Block, weights: Sequence[float], tables: Tables) -> str | None:
    """Return how the weights of a grid are printed as one term; ``None`` if they are printed one by one, or zero.

    :param block: the grid
    :param weights: of all inputs
    :param tables: of the print
    """
    function = as_function(block, weights)
    if function is not None:
        return function_text(block, function) if any(function) else None
    table = as_table(block, weights)
    return None if table is None else f"{block.name}*({tables.name(table)})"


def function_text(block: Block, function: tuple[float, float, float]) -> str:
    """Return a function of row and column in words, such as ``table*(4 - 2*row)``.

    :param block: the grid
    :param function: from :func:`as_function`; not all zero
    """
    parts: list[str] = []
    for number, name in zip(function, ("", "row", "column"), strict=True):
        if number:
            size = abs(int(number))
            words = f"{size}*{name}" if name and size != 1 else name or str(size)
            parts.append((" - " if number < 0 else " + ") + words if parts else ("-" if number < 0 else "") + words)
    return f"{block.name}*({''.join(parts)})"


def collapse(
    blocks: Sequence[Block], weights: Sequence[float], names: Sequence[str], tables: Tables
) -> tuple[list[float], list[str]]:
    """Return weights and names in which a grid that is a function or a table is one term, of weight 1.

    :param blocks: of the program
    :param weights: of all inputs
    :param names: of all inputs
    :param tables: of the print
    """
    left, named = list(weights), list(names)
    for block in reversed(blocks):
        text = block_text(block, weights, tables)
        if text is not None:
            left[block.start : block.stop] = [1.0]
            named[block.start : block.stop] = [text]
    return left, named


def beginnings(blocks: Sequence[Block]) -> tuple[str, ...]:
    """Return with what the names begin that :func:`collapse` gives to grids."""
    return tuple(f"{block.name}*(" for block in blocks)


def terms_to_show(program: ProgramData, max_terms: MaxTerms) -> int | None:
    """Return how many terms of each sum a small picture shows: all where there are few, else three.

    :param program: that is drawn
    :param max_terms: as given; ``"auto"`` to choose, ``None`` for all
    """
    if max_terms != "auto":
        return max_terms
    blocks = blocks_of(program)
    rows = [row for controller in program.controllers for row in controller.weights]
    rows += [weights for condition in program.conditions for _, weights in condition.sums]
    counts = [sum(map(bool, collapse(blocks, row, program.input_names, Tables())[0])) for row in rows]
    return None if max(counts, default=0) <= FEW_TERMS else MOST_TERMS
