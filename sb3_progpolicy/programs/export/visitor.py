"""What all printers share: walking the tree, and choosing which terms of a sum to show."""

from __future__ import annotations

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.syntax import GATES, Condition, Controller, Expression, IfThenElse, ProgramData
from sb3_progpolicy.programs.validation import check_program
from sb3_progpolicy.spaces import ActionSpec

Result = TypeVar("Result")

CELL_NAMES = {"affine": "affine", "min": "min", "rnn": "RNN", "gru": "GRU", "lstm": "LSTM", "switch": "switch"}


class ProgramVisitor(ABC, Generic[Result]):
    """One output format: a method for each kind of node.

    :param program: what is printed
    :raises ValueError: if the program is not well formed
    """

    def __init__(self, program: ProgramData) -> None:
        check_program(program)
        self.program = program

    def visit(self, expression: Expression, index: int = 0) -> Result:
        """Print a node; ``index`` counts the conditions passed on the way to it."""
        if isinstance(expression, IfThenElse):
            return self.visit_branch(expression, index)
        return self.visit_controller(expression, index)

    @abstractmethod
    def visit_branch(self, branch: IfThenElse, index: int) -> Result:
        """Print ``if B then C else E``."""

    @abstractmethod
    def visit_controller(self, controller: Controller, index: int) -> Result:
        """Print ``c + T·X``."""


@dataclass(frozen=True)
class Terms:
    """The terms of a sum that a reader should see.

    :param shown: (weight, name), the largest weight first
    :param n_dropped: how many other terms are not zero
    """

    shown: tuple[tuple[float, str], ...]
    n_dropped: int


def largest_terms(
    weights: Sequence[float], names: Sequence[str], decimals: int, max_terms: int | None, first: tuple[str, ...] = ()
) -> Terms:
    """Sort the terms of ``weights · names`` by size and drop those that round to zero.

    :param decimals: digits after the point
    :param max_terms: show no more than these; ``None`` for all
    :param first: beginnings of names that stand before the others and are always shown
    """
    terms = sorted(((weight, name) for weight, name in zip(weights, names, strict=True) if weight), key=_by_size)
    ahead = [term for term in terms if first and term[1].startswith(first)]
    others = [term for term in terms if term not in ahead and round(term[0], decimals)]
    shown = [*ahead, *others[:max_terms]]
    return Terms(tuple(shown), len(terms) - len(shown))


def is_whole(value: float) -> bool:
    """Whether a number is printed without a point: a whole one of up to nine digits."""
    return math.isfinite(value) and abs(value) < 1e9 and value == int(value)


class Decimals:
    """Numbers as people read them: whole ones without a point, all others rounded.

    :param digits: after the point
    """

    def __init__(self, digits: int) -> None:
        self.digits = digits

    def __call__(self, value: float) -> str:
        """Print a number; one that is not zero but rounds to it is 0.00, and zero itself is 0."""
        if is_whole(value):
            return str(int(value))
        shown = round(value, self.digits) or 0.0  # no "-0.00"
        return f"{shown:.{self.digits}f}"

    def factor(self, weight: float, between: str) -> str:
        """Print the size of a weight before a name, nothing for the whole number 1."""
        return "" if abs(weight) == 1 else f"{self(abs(weight))}{between}"


def _by_size(term: tuple[float, str]) -> float:
    return -abs(term[0])


def input_importance(condition: Condition) -> tuple[float, ...]:
    """How much each number of X can move a condition: its absolute weights into the units, each times the absolute
    weight of that unit in B, summed; without memory its absolute weights in all sums.
    """
    if not condition.remembers:
        return tuple(sum(map(abs, column)) for column in zip(*(weights for _, weights in condition.sums), strict=True))
    size = condition.hidden_size
    return tuple(
        sum(abs(weight * condition.readout[row % size]) for row, weight in enumerate(column))
        for column in zip(*condition.weight_ih, strict=True)
    )


def is_switch(condition: Condition) -> bool:
    """Whether a condition is one switch that does not read itself, which is printed as what turns it on and off."""
    return condition.cell == "switch" and condition.hidden_size == 1 and not any(map(any, condition.weight_hh))


def switch_sums(condition: Condition) -> list[tuple[str, tuple[float, Sequence[float]]]]:
    """What turns a switch on and off: ``"on"`` or ``"off"``, the constant and the weights of X of either sum."""
    constants = [one + other for one, other in zip(condition.bias_ih, condition.bias_hh, strict=True)]
    return list(zip(GATES["switch"], zip(constants, condition.weight_ih, strict=True), strict=True))


def always_or_never(constant: float, weights: Sequence[float]) -> str | None:
    """How often a sum that reads nothing is not below 0, ``"always"`` or ``"never"``; ``None`` if it reads."""
    return None if any(weights) else "always" if constant >= 0 else "never"


def gate_names(condition: Condition) -> list[tuple[str, int]]:
    """The gate and the unit that each row of a condition's weights belongs to."""
    return [(gate, unit) for gate in GATES[condition.cell] for unit in range(condition.hidden_size)]


def action_rule(action: ActionSpec) -> str:
    """How an action is chosen from a controller's outputs, as a sentence."""
    if action.kind == "discrete":
        return "Each line gives the score of one action; the action with the highest score is taken."
    if action.kind == "multi_discrete":
        return "Each line gives the score of one choice; in every part of the action the highest score is taken."
    if action.kind == "multi_binary":
        return "Each line gives the score of one switch; it is on where the score is above 0."
    return "Each line gives one number of the action, which is then clipped to its bounds."


def title(program: ProgramData) -> str:
    """The program's name, with ``metadata["env"]`` where that is a printable string of at most 100 characters."""
    environment = program.metadata.get("env")
    known = isinstance(environment, str) and environment.isprintable() and 0 < len(environment) <= 100
    return f"Program for {environment}" if known else "Program"


def simplified_as(program: ProgramData) -> list[str]:
    """What a simplified program's metadata says of it, in a sentence; nothing of any other program."""
    said = program.metadata.get("simplified")
    terms = said.get("terms") if isinstance(said, Mapping) else None
    if type(terms) is not int or not 0 < terms < 10**6:
        return []
    assert isinstance(said, Mapping)
    name, bound = said.get("symmetry"), said.get("terms_lower_bound")
    tied = isinstance(name, str) and name.isidentifier() and len(name) <= 40
    sentence = f"Simplified to {counted(terms, 'term')}"
    sentence += f", tied over a symmetry ({name})" if tied else ""
    return [sentence + ("; no program of this form has fewer." if bound == terms else ".")]


def counted(number: int, noun: str) -> str:
    """``1 condition``, ``2 conditions``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def pack(tokens: Iterable[str], first: str, following: str, width: int) -> list[str]:
    """Fill lines with tokens and one space between them, never breaking a token.

    :param first: start of the first line
    :param following: start of the other lines
    """
    lines, line, empty = [], first, True
    for token in tokens:
        if not empty and len(line) + 1 + len(token) > width:
            lines.append(line)
            line, empty = following, True
        line, empty = line + ("" if empty else " ") + token, False
    return [*lines, line]


def deliver(text: str, out_file: str | os.PathLike[str] | Any | None) -> str | None:
    """Return the text, or write it to a path or an open file and return ``None``, as scikit-learn does."""
    if out_file is None:
        return text
    if isinstance(out_file, (str, os.PathLike)):
        write_atomically(out_file, text)
    else:
        out_file.write(text)
    return None
