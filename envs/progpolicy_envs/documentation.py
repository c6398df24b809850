"""Docstrings of environments: sections that several share, and the table that says what an observation holds."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from inspect import cleandoc
from string import Template
from typing import TypeVar

_Class = TypeVar("_Class", bound=type)


def with_sections(sections: Mapping[str, str], **words: str) -> Callable[[_Class], _Class]:
    """Return a class decorator that replaces every ``$name`` in the class's docstring.

    :param sections: longer texts by name, which may contain ``$name`` of words
    :param words: short texts by name
    :raises KeyError: if the docstring, or a section, has a ``$name`` that is not given
    """
    texts = {name: Template(cleandoc(text)).substitute(words) for name, text in sections.items()}

    def fill(cls: _Class) -> _Class:
        if cls.__doc__:  # there is none under `python -OO`
            cls.__doc__ = Template(cleandoc(cls.__doc__)).substitute(texts, **words)
        return cls

    return fill


@dataclass(frozen=True)
class Row:
    """A row of the table of an observation space.

    :param numbers: indices of the numbers that it is about
    :param name: such as ``rank[peg]``
    :param meaning: in words
    """

    numbers: tuple[int, ...]
    name: str
    meaning: str


def observation_rows(docstring: str | None) -> list[Row]:
    """Return the table of an environment's observation space; nothing where it has none.

    :param docstring: of the environment's class, whose section "Observation Space" has a Markdown table with the
        columns Num, Observation and Meaning
    """
    section = re.search(r"^## Observation Space\n(.*?)(?=^## |\Z)", cleandoc(docstring or ""), re.M | re.S)
    cells = [
        [cell.strip() for cell in line.strip().strip("|").split("|")]
        for line in (section[1].splitlines() if section else ())
        if line.strip().startswith("|")
    ]
    if len(cells) < 2 or not {"Num", "Meaning"} <= set(cells[0]) or set(cells[1][0]) != {"-"}:
        return []
    number, meaning = (cells[0].index(name) for name in ("Num", "Meaning"))
    rows: list[list[str]] = []
    for row in cells[2:]:
        if row[number]:
            rows.append([row[number], row[1], row[meaning]])
        elif rows:  # a row without a number goes on with the one above
            rows[-1][2] += f" {row[meaning]}"
    return [Row(_numbers(numbers), name, meaning) for numbers, name, meaning in rows]


def _numbers(text: str) -> tuple[int, ...]:
    """Return the numbers of ``0, 3, 6`` or ``0 - 24``."""
    found: list[int] = []
    for part in text.split(","):
        ends = [int(end) for end in part.split("-")]
        found += range(ends[0], ends[-1] + 1)
    return tuple(found)
