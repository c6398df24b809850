"""A program as one Python file that needs nothing but the standard library."""

from __future__ import annotations

import keyword
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sb3_progpolicy.programs.export.visitor import CELL_NAMES, ProgramVisitor, counted, deliver, gate_names, pack, title
from sb3_progpolicy.programs.syntax import Condition, Controller, IfThenElse, ProgramData

WIDTH = 110
TERMS_PER_STATEMENT = 50  # Python's parser and compiler limit how long a sum may be
# Python looks for a file's encoding in its first two lines. With this one first, no text of a program can set it.
_CODING = "# -*- coding: utf-8 -*-"
_MAX_IDENTIFIER = 40
# Names that the written method uses itself, and Python's own.
_TAKEN = {"self", "observation", "previous_action", "previous_reward", "previous_done", "reward", "done", "action"}
_TAKEN |= {"scores", "tanh", "float", "int", "len", "max", "min", "map", *keyword.kwlist}
# The local variables of the written method: one of these letters or words, then numbers.
_OURS = re.compile(r"((new_)?[bhcrznifgoup]|scores|given|action)(_?[0-9])+")


def export_python(program: ProgramData, out_file: str | os.PathLike[str] | Any | None = None) -> str | None:
    """Write a program as one standalone Python file (Python 3.8 or newer, standard library only).

    Its class ``ProgramPolicy`` has ``reset()`` and ``act(observation, previous_action, previous_reward,
    previous_done)`` and chooses the same actions as :class:`~sb3_progpolicy.programs.interpreter.ProgramRunner` with
    crisp semantics, to the last bit of every number: sums are taken in the same order.

    No text of a program becomes code, whoever made it: names and title are written as string literals and comments in
    ASCII, with all other characters escaped. Variables are named with letters, digits and underscores only.

    :param program: what to write
    :param out_file: a path or an open text file to write to
    :return: the source code if ``out_file`` is ``None``, else ``None``
    :raises ValueError: if the program is not well formed
    """
    return deliver(_PythonPrinter(program).print(), out_file)


@dataclass(frozen=True)
class _Row:
    """One sum ``name = constant + weights · X``."""

    name: str
    constant: float
    weights: Sequence[float]


class _PythonPrinter(ProgramVisitor[list[str]]):
    def __init__(self, program: ProgramData) -> None:
        super().__init__(program)
        action = program.action
        self.one_hot = program.interaction and action.kind in ("discrete", "multi_discrete")
        self.parts = len(action.sizes) if self.one_hot else 0
        self.names = _Identifiers()
        observed = program.n_observations
        self.inputs = [self.names.new(name) for name in program.input_names[:observed]]
        history = program.input_names[observed:-2] if program.interaction else ()
        # The one-hot code is never built: its index picks a row of a table instead.
        self.history = [""] * len(history) if self.one_hot else [self.names.new(name) for name in history]
        self.outputs = [self.names.new(name) for name in program.output_names]
        self.tables: list[str] = []

    def print(self) -> str:
        act = [*self._read_inputs(), *self._advance_conditions(), *self.visit(self.program.body)]
        act = [f"        {line}".rstrip() for line in act]
        tables = ["", "", "# What the previous action adds to each of the sums above."] if self.tables else []
        return "\n".join([*self._head(), *self._class(), *act, *tables, *self.tables]) + "\n"

    def visit_branch(self, branch: IfThenElse, index: int) -> list[str]:
        word = "elif" if index else "if"
        return [
            f"{word} b{index + 1} >= 0.0:",
            *(f"    {line}" for line in self._controller(branch.then, index)),
            *self.visit(branch.orelse, index + 1),
        ]

    def visit_controller(self, controller: Controller, index: int) -> list[str]:
        lines = self._controller(controller, index)
        return ["else:", *(f"    {line}" for line in lines)] if index else lines

    def _head(self) -> list[str]:
        n = len(self.program.conditions)
        return [
            _CODING,
            f"# {_commented(title(self.program))}: {counted(n, 'condition')}, {counted(n + 1, 'controller')}.",
            "# Written by sb3-progpolicy. Needs Python 3.8 or newer and nothing else.",
            "#",
            "#     policy = ProgramPolicy()",
            "#     action = policy.act(observation, None, 0.0, False)      # the first step",
            "#     action = policy.act(observation, action, reward, done)  # every later step",
            *(["", "from math import tanh"] if any(c.cell != "affine" for c in self.program.conditions) else []),
            "",
        ]

    def _class(self) -> list[str]:
        program, states = self.program, self._states()
        reset = [f"self._{name} = {_tuple('0.0' for _ in locals_)}" for name, locals_ in states]
        return [
            "",
            "class ProgramPolicy:",
            '    """An if-then-else over affine controllers whose conditions remember what they have read."""',
            "",
            f"    n_observations = {program.n_observations}",
            *_strings("    input_names", program.input_names),
            *_strings("    output_names", program.output_names),
            "",
            "    def __init__(self):",
            "        self.reset()",
            "",
            "    def reset(self):",
            '        """Forget everything. Call it when the task changes, not when an episode ends."""',
            *(f"        {line}" for line in reset),
            "",
            "    def act(self, observation, previous_action=None, previous_reward=0.0, previous_done=False):",
            f'        """Choose an action: {self._action_words()}.',
            "",
            f"        observation: {counted(program.n_observations, 'number')}.",
            "        previous_action: what the last call returned, None before the first.",
            "        previous_reward, previous_done: what the environment said after it.",
            '        """',
        ]

    def _action_words(self) -> str:
        action = self.program.action
        return {
            "discrete": f"a whole number from {action.start} to {action.start + action.n_outputs - 1}",
            "multi_discrete": f"a list of {len(action.sizes)} whole numbers, each from 0",
            "multi_binary": f"a list of {action.n_outputs} numbers, each 0 or 1",
            "box": f"a list of {action.n_outputs} numbers inside the bounds",
        }[action.kind]

    def _states(self) -> list[tuple[str, list[str]]]:
        """Every state variable with the local names of its numbers."""
        states = []
        for index, condition in enumerate(self.program.conditions, start=1):
            kinds = {"affine": "", "lstm": "hc"}.get(condition.cell, "h")
            states += [
                (f"{kind}{index}", [f"{kind}{index}_{u + 1}" for u in range(condition.hidden_size)]) for kind in kinds
            ]
        return states

    def _read_inputs(self) -> list[str]:
        program, action = self.program, self.program.action
        n = program.n_observations
        lines = [
            f"if len(observation) != {n}:",
            f'    raise ValueError("observation holds %d numbers; {n} are accepted" % len(observation))',
        ]
        if n:
            lines += _unpack(self.inputs, "map(float, observation)")
        observed = program.input_names[:n]
        lines += [f"# {variable}: {_commented(name)}" for variable, name in zip(self.inputs, observed, strict=True)]
        if not program.interaction:
            return lines
        if self.one_hot:
            lines.append(
                "# Actions pick rows of the tables at the end of the file; -1, the last row, is for no action."
            )
        if action.kind == "discrete":
            lines += _index("action", "previous_action", action.start, action.sizes[0])
        elif action.kind == "multi_discrete":
            source = f"[None] * {self.parts} if previous_action is None else previous_action"
            lines += _unpack([f"given_{part}" for part in range(self.parts)], source)
            for part, size in enumerate(action.sizes):
                lines += _index(f"action_{part}", f"given_{part}", 0, size)
        else:
            zeros = f"[0.0] * {len(self.history)} if previous_action is None else previous_action"
            lines += _unpack(self.history, f"map(float, {zeros})")
        return [*lines, "reward = float(previous_reward)", "done = float(previous_done)"]

    def _advance_conditions(self) -> list[str]:
        lines = [f"{_tuple(names)} = self._{name}" for name, names in self._states()]
        for index, condition in enumerate(self.program.conditions, start=1):
            lines += ["", f"# Condition {index}: {_condition_words(condition)}", *self._condition(condition, index)]
        return [*lines, ""]

    def _condition(self, condition: Condition, index: int) -> list[str]:
        if condition.cell == "affine":
            return self._affine([_Row(f"b{index}", condition.readout_bias, condition.readout)], f"CONDITION_{index}")
        hidden = [f"h{index}_{unit + 1}" for unit in range(condition.hidden_size)]
        gates = [f"{gate}{index}_{unit + 1}" for gate, unit in gate_names(condition)]
        if condition.cell == "rnn":
            gates = [f"new_{name}" for name in gates]
        rows, recurrent, size = [], [], condition.hidden_size
        for row, ((gate, _), name) in enumerate(zip(gate_names(condition), gates, strict=True)):
            terms = list(zip(condition.weight_hh[row], hidden, strict=True))
            if gate == "n":
                # The reset gate scales this sum before it joins the rest.
                rows.append(_Row(name, condition.bias_ih[row], condition.weight_ih[row]))
                recurrent += [*_sum(f"u{name[1:]}", condition.bias_hh[row], terms)]
            else:
                rows.append(_Row(name, condition.bias_ih[row] + condition.bias_hh[row], condition.weight_ih[row]))
                recurrent += _sum(name, None, terms)
        lines = [*self._affine(rows, f"CONDITION_{index}"), *recurrent]
        for unit in range(size):
            lines += _cell(condition.cell, f"{index}_{unit + 1}")
        if condition.cell == "rnn":
            lines += [f"{name} = tanh(new_{name})" for name in hidden]
        if condition.cell == "lstm":
            lines.append(f"self._c{index} = {_tuple(name.replace('h', 'c') for name in hidden)}")
        readout = list(zip(condition.readout, hidden, strict=True))
        return [*lines, f"self._h{index} = {_tuple(hidden)}", *_sum(f"b{index}", condition.readout_bias, readout)]

    def _controller(self, controller: Controller, index: int) -> list[str]:
        action, names = self.program.action, self.outputs
        rows = [_Row(*row) for row in zip(names, controller.bias, controller.weights, strict=True)]
        lines = [f"# Controller {index + 1}", *self._affine(rows, f"CONTROLLER_{index + 1}")]
        if action.kind == "discrete":
            start = f" + {action.start}" if action.start else ""
            return [*lines, f"scores = {_tuple(names)}", f"return scores.index(max(scores)){start}"]
        if action.kind == "multi_binary":
            return [*lines, *_list("return", (f"1 if {name} > 0.0 else 0" for name in names))]
        if action.kind == "box":
            bounds = zip(names, action.low, action.high, strict=True)
            return [
                *lines,
                *_list("return", (f"min(max({n}, {_float(low)}), {_float(high)})" for n, low, high in bounds)),
            ]
        first = 0
        for part, size in enumerate(action.sizes):
            lines.append(f"scores_{part} = {_tuple(names[first : first + size])}")
            first += size
        return [
            *lines,
            *_list("return", (f"scores_{p}.index(max(scores_{p}))" for p in range(self.parts or len(action.sizes)))),
        ]

    def _affine(self, rows: Sequence[_Row], table: str) -> list[str]:
        """Statements that compute all rows, with the terms in the order of X. A one-hot action's come from a table."""
        n, lines, picked = self.program.n_observations, [], []
        first = n
        for part in range(self.parts):
            size = self.program.action.sizes[part]
            columns = [[row.weights[first + choice] for row in rows] for choice in range(size)]
            first += size
            if any(weight for column in columns for weight in column):
                suffix = "" if self.program.action.kind == "discrete" else f"_{part}"
                names = [f"p{suffix}_{number}" for number in range(len(rows))]
                self._table(f"{table}_AFTER_ACTION{suffix}", columns, first - size)
                index = f"action{suffix}"
                lines += _unpack(names, f"{table}_AFTER_ACTION{suffix}[{index}]")
                picked.append(names)
        for number, row in enumerate(rows):
            terms = list(zip(row.weights[:n], self.inputs, strict=True))
            if self.one_hot:
                terms += [(1.0, names[number]) for names in picked]
            elif self.program.interaction:
                terms += list(zip(row.weights[n:-2], self.history, strict=True))
            if self.program.interaction:
                terms += [(row.weights[-2], "reward"), (row.weights[-1], "done")]
            lines += _sum(row.name, row.constant, terms)
        return lines

    def _table(self, name: str, columns: Sequence[Sequence[float]], first: int) -> None:
        """A constant: what each previous action adds to every row. The last line, at index -1, is for no action."""
        self.tables += ["", f"{name} = ("]
        for choice, column in enumerate(columns):
            comment = f"# {_commented(self.program.input_names[first + choice])}"
            self.tables += [f"    {comment}", *pack(_separated(map(_float, column)), "    (", "     ", WIDTH)]
            self.tables[-1] += "),"
        self.tables += ["    # no action yet", f"    (0.0,) * {len(columns[0])},", ")"]


class _Identifiers:
    """Readable and unique variable names of ASCII letters, digits and underscores, made from any text."""

    def __init__(self) -> None:
        self.used: set[str] = set()
        self.versions: dict[str, int] = {}  # the last version of each name that is used more than once

    def new(self, text: str) -> str:
        name = re.sub(r"[^0-9a-zA-Z]+", "_", text).strip("_").lower()[:_MAX_IDENTIFIER]
        if not name or name[0].isdigit() or name in _TAKEN or _OURS.fullmatch(name):
            name = f"x_{name}".rstrip("_")
        unique = name
        while unique in self.used:
            self.versions[name] = self.versions.get(name, 1) + 1
            unique = f"{name}_v{self.versions[name]}"
        self.used.add(unique)
        return unique


def _sum(name: str, constant: float | None, terms: Sequence[tuple[float, str]]) -> list[str]:
    """Statements for ``name = constant + terms``, or ``name + terms`` where the constant is ``None``."""
    kept = [(weight, variable) for weight, variable in terms if weight]
    start, lines = name if constant is None else _float(constant), []
    for first in range(0, max(len(kept), constant is not None), TERMS_PER_STATEMENT):
        tokens = [start, *map(_token, kept[first : first + TERMS_PER_STATEMENT])]
        if len(tokens) > 1 and start in ("0.0", "-0.0"):
            tokens = [tokens[1].replace("- ", "-", 1) if tokens[1][0] == "-" else tokens[1][2:], *tokens[2:]]
        if len(name) + sum(len(token) + 1 for token in tokens) <= WIDTH - 15:
            lines.append(f"{name} = {' '.join(tokens)}")
        else:
            lines += [f"{name} = (", *pack(tokens, "    ", "    ", WIDTH - 12), ")"]
        start = name
    return lines


def _token(term: tuple[float, str]) -> str:
    weight, variable = term
    sign = "-" if weight < 0 else "+"
    return f"{sign} {variable}" if abs(weight) == 1 else f"{sign} {_float(abs(weight))} * {variable}"


def _cell(cell: str, unit: str) -> Iterator[str]:
    """Update one unit of a GRU or an LSTM from its sums, by PyTorch's equations; an RNN's are updated together."""
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


def _condition_words(condition: Condition) -> str:
    if condition.cell == "affine":
        return "affine, no memory"
    words = {"rnn": "h = tanh(...)", "gru": "reset r, update z, candidate n, memory h"}
    how = words.get(condition.cell, "input i, forget f, candidate g, output o, memory c and h")
    return f"{counted(condition.hidden_size, CELL_NAMES[condition.cell] + ' unit')}: {how}"


def _index(name: str, given: str, start: int, size: int) -> list[str]:
    """Statements that turn an action into an index, -1 for none."""
    shift = f" - {start}" if start else ""
    return [
        f"{name} = -1 if {given} is None else int({given}){shift}",
        f"if {name} >= {size} or {name} < 0 and {given} is not None:",
        f'    raise ValueError("previous_action=%r is not accepted; {start} to {start + size - 1} is" % ({given},))',
    ]


def _unpack(names: Sequence[str], source: str) -> list[str]:
    lines = pack(_separated(names), "(", " ", WIDTH - 30)
    lines[-1] += f") = {source}"
    return lines


def _separated(items: Iterable[str]) -> list[str]:
    """The items of a tuple, with commas as Python wants them."""
    *first, last = items
    return [*(f"{item}," for item in first), last if first else f"{last},"]


def _tuple(items: Iterable[str]) -> str:
    return f"({' '.join(_separated(items))})"


def _list(start: str, items: Iterable[str]) -> list[str]:
    return [f"{start} [", *(f"    {item}," for item in items), "]"]


def _strings(name: str, values: Sequence[str]) -> list[str]:
    return [f"{name} = (", *pack([f"{_literal(value)}," for value in values], "        ", "        ", WIDTH), "    )"]


def _literal(text: str) -> str:
    return ascii(str(text))  # str, because NumPy's strings are written with their type


def _commented(text: str) -> str:
    return _literal(text)[1:-1]


def _float(value: float) -> str:
    # The sum of two constants may be infinite, and "inf" would be a variable.
    return repr(float(value)).replace("inf", "1e999")
