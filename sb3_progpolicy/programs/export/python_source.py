"""Pieces of Python source that :mod:`~sb3_progpolicy.programs.export.python` puts together."""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterable, Iterator, Sequence

from sb3_progpolicy.programs.export.visitor import CELL_NAMES, counted, is_whole, pack
from sb3_progpolicy.programs.syntax import Condition

WIDTH = 110
TERMS_PER_STATEMENT = 50  # Python's parser and compiler limit how long a sum may be
_MAX_IDENTIFIER = 40
# Names that the written method uses itself, and Python's own.
_TAKEN = {"self", "observation", "previous_action", "previous_reward", "previous_done", "reward", "done", "action"}
_TAKEN |= {"scores", "tanh", "frexp", "ldexp", "float", "int", "len", "max", "min", "map", *keyword.kwlist}
# The local variables of the written method: one of these letters or words, then numbers.
_OURS = re.compile(r"((new_)?[bhcrznifgoupm]|on|off|scores|given|action)(_?[0-9])+")


class Identifiers:
    """Readable and unique variable names of ASCII letters, digits and underscores, made from any text."""

    def __init__(self) -> None:
        self.used: set[str] = set()
        self.versions: dict[str, int] = {}  # the last version of each name that is used more than once

    def new(self, text: str) -> str:
        """Return a name that has not been used."""
        text = re.sub(r"(?<![0-9a-zA-Z])-(?=[0-9])", "_minus_", text)  # rank[-1] is not rank[1]
        name = re.sub(r"[^0-9a-zA-Z]+", "_", text).strip("_").lower()[:_MAX_IDENTIFIER]
        if not name or name[0].isdigit() or name in _TAKEN or _OURS.fullmatch(name):
            name = f"x_{name}".rstrip("_")
        unique = name
        while unique in self.used:
            self.versions[name] = self.versions.get(name, 1) + 1
            unique = f"{name}_v{self.versions[name]}"
        self.used.add(unique)
        return unique


def sum_statements(name: str, constant: float | None, terms: Sequence[tuple[float, str]]) -> list[str]:
    """Statements for ``name = constant + terms``, or ``name + terms`` where the constant is ``None``."""
    kept = [(weight, variable) for weight, variable in terms if weight]
    start, lines = name if constant is None else number(constant), []
    for first in range(0, max(len(kept), constant is not None), TERMS_PER_STATEMENT):
        tokens = sum_tokens(start, kept[first : first + TERMS_PER_STATEMENT])
        if len(name) + sum(len(token) + 1 for token in tokens) <= WIDTH - 15:
            lines.append(f"{name} = {' '.join(tokens)}")
        else:
            lines += [f"{name} = (", *pack(tokens, "    ", "    ", WIDTH - 12), ")"]
        start = name
    return lines


def sum_tokens(start: str, terms: Sequence[tuple[float, str]]) -> list[str]:
    """The sum ``start + terms``, without a start of 0 where there are terms."""
    tokens = [_token(term) for term in terms]
    if not tokens or start != "0":
        return [start, *tokens]
    return [tokens[0].replace("- ", "-", 1) if tokens[0][0] == "-" else tokens[0][2:], *tokens[1:]]


def _token(term: tuple[float, str]) -> str:
    weight, variable = term
    sign = "-" if weight < 0 else "+"
    return f"{sign} {variable}" if abs(weight) == 1 else f"{sign} {number(abs(weight))} * {variable}"


def cell_statements(cell: str, unit: str) -> Iterator[str]:
    """Update one unit of a GRU, an LSTM or a switch from its sums; those of an RNN are updated together."""
    if cell == "gru":
        yield f"r{unit} = 0.5 + 0.5 * tanh(0.5 * r{unit})"
        yield f"z{unit} = 0.5 + 0.5 * tanh(0.5 * z{unit})"
        yield f"n{unit} = tanh(n{unit} + r{unit} * u{unit})"
        yield f"h{unit} = n{unit} + z{unit} * (h{unit} - n{unit})"
    elif cell == "lstm":
        yield f"i{unit} = 0.5 + 0.5 * tanh(0.5 * i{unit})"
        yield f"f{unit} = 0.5 + 0.5 * tanh(0.5 * f{unit})"
        yield f"o{unit} = 0.5 + 0.5 * tanh(0.5 * o{unit})"
        yield f"c{unit} = f{unit} * c{unit} + i{unit} * tanh(g{unit})"
        yield f"h{unit} = o{unit} * tanh(c{unit})"
    elif cell == "switch":
        yield f"h{unit} = 1.0 if on{unit} >= 0.0 else 0.0 if off{unit} >= 0.0 else h{unit}"


def condition_words(condition: Condition) -> str:
    """What a condition remembers, for a comment."""
    if not condition.remembers:
        return "affine, no memory" if condition.cell == "affine" else "the least of affine sums, no memory"
    words = {
        "rnn": "h = tanh(...)",
        "gru": "reset r, update z, candidate n, memory h",
        "switch": "h is 1 once on >= 0, 0 once off >= 0",
    }
    how = words.get(condition.cell, "input i, forget f, candidate g, output o, memory c and h")
    return f"{counted(condition.hidden_size, CELL_NAMES[condition.cell] + ' unit')}: {how}"


def index_statements(name: str, given: str, start: int, size: int) -> list[str]:
    """Statements that turn an action into an index, -1 for none."""
    shift = f" - {start}" if start else ""
    return [
        f"{name} = -1 if {given} is None else int({given}){shift}",
        f"if {name} >= {size} or {name} < 0 and {given} is not None:",
        f'    raise ValueError("previous_action=%r is not accepted; {start} to {start + size - 1} is" % ({given},))',
    ]


def unpack(names: Sequence[str], source: str) -> list[str]:
    """A statement that gives the numbers of a sequence their names."""
    lines = pack(separated(names), "(", " ", WIDTH - 30)
    lines[-1] += f") = {source}"
    return lines


def separated(items: Iterable[str]) -> list[str]:
    """The items of a tuple, with commas as Python wants them."""
    *first, last = items
    return [*(f"{item}," for item in first), last if first else f"{last},"]


def tuple_of(items: Iterable[str]) -> str:
    """A tuple on one line."""
    return f"({' '.join(separated(items))})"


def list_lines(start: str, items: Iterable[str]) -> list[str]:
    """A list with one item a line."""
    return [f"{start} [", *(f"    {item}," for item in items), "]"]


def strings_lines(name: str, values: Sequence[str]) -> list[str]:
    """A tuple of texts."""
    return [f"{name} = (", *pack([f"{_literal(value)}," for value in values], "        ", "        ", WIDTH), "    )"]


def _literal(text: str) -> str:
    return ascii(str(text))  # str, because NumPy's strings are written with their type


def commented(text: str) -> str:
    """A text as it may stand in a comment: ASCII, with all else escaped."""
    return _literal(text)[1:-1]


def number(value: float) -> str:
    """A number as a person writes it: without a point where it is whole."""
    return str(int(value)) if is_whole(value) else float_number(value)


def float_number(value: float) -> str:
    """A number with a point."""
    # The sum of two constants may be infinite, and "inf" would be a variable.
    return repr(float(value)).replace("inf", "1e999")
