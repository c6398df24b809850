"""A program as one Python file that needs nothing but the standard library."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sb3_progpolicy.programs.export.python_source import (
    WIDTH,
    Identifiers,
    cell_statements,
    commented,
    condition_words,
    float_number,
    index_statements,
    list_lines,
    number,
    separated,
    strings_lines,
    sum_statements,
    sum_tokens,
    tuple_of,
    unpack,
)
from sb3_progpolicy.programs.export.visitor import ProgramVisitor, counted, deliver, gate_names, pack, title
from sb3_progpolicy.programs.syntax import Condition, Controller, IfThenElse, ProgramData

FEW_TERMS = 6  # a program none of whose sums has more is written as a person would write it
# Python looks for a file's encoding in its first two lines. With this one first, no text of a program can set it.
# Of the exported class. Numbers too small for it stay as they are.
_FLOAT32 = (
    "    @staticmethod",
    "    def _float32(value):",
    '        """Round to 24 bits, as rewards and actions are in training."""',
    "        mantissa, exponent = frexp(value)",
    "        return ldexp(round(ldexp(mantissa, 24)), exponent - 24)",
    "",
)
_CODING = "# -*- coding: utf-8 -*-"


def export_python(program: ProgramData, out_file: str | os.PathLike[str] | Any | None = None) -> str | None:
    """Write a program as one standalone Python file (Python 3.8 or newer, standard library only).

    Its class ``ProgramPolicy`` has ``reset()`` and ``act(observation, previous_action, previous_reward,
    previous_done)`` and chooses the same actions as :class:`~sb3_progpolicy.programs.interpreter.ProgramRunner` with
    crisp semantics, to the last bit of every number: sums are taken in the same order. Terms with the weight 0 are not
    written, and whole numbers without a point. A program none of whose sums has more than six terms is written as a
    person would: it reads only the inputs that it needs, by their names, tests conditions without memory where they
    decide, and returns an action that does not depend on them as it is.

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
        self.names = Identifiers()
        observed = program.n_observations
        self.inputs = [self.names.new(name) for name in program.input_names[:observed]]
        history = program.input_names[observed:-2] if program.interaction else ()
        weights = _weights_of_inputs(program)
        self.used = [any(column) for column in zip(*weights, strict=True)] or [False] * program.n_inputs
        self.by_hand = max(sum(map(bool, row)) for row in weights) <= FEW_TERMS
        # Of a larger program the one-hot code is never built: its index picks a row of a table instead.
        tables = self.one_hot and not self.by_hand
        self.history = [""] * len(history) if tables else [self.names.new(name) for name in history]
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
            *self._test(word, branch.condition, index + 1),
            *(f"    {line}" for line in self._controller(branch.then, index)),
            *self.visit(branch.orelse, index + 1),
        ]

    def _test(self, word: str, condition: Condition, index: int) -> list[str]:
        if condition.remembers or (condition.cell == "affine" and not self.by_hand):
            return [f"{word} b{index} >= 0.0:"]
        # Each sum of a min is tested by itself: Python's min() may pass over what is not a number.
        sums, zero = [[name] for name in _sum_names(condition, index)], "0.0"
        if self.by_hand:
            sums, zero = [self._tokens(*one) for one in condition.sums], "0"
        line = f"{word} {' and '.join(' '.join([*tokens, f'>= {zero}']) for tokens in sums)}:"
        if len(line) <= WIDTH - 10:
            return [line]
        if len(sums) == 1:
            return [f"{word} (", *pack(sums[0], "    ", "    ", WIDTH - 12), ") >= 0:"]
        tests = [pack([*tokens, f">= {zero}"], "    and ", "        ", WIDTH - 12) for tokens in sums]
        tests[0][0] = tests[0][0].replace("and ", "    ", 1)
        return [f"{word} (", *(part for test in tests for part in test), "):"]

    def _tokens(self, constant: float, weights: Sequence[float]) -> list[str]:
        """A sum over X, of a program that is written as by hand."""
        terms = zip(weights, self._variables(), strict=True)
        return sum_tokens(number(constant), [term for term in terms if term[0]])

    def visit_controller(self, controller: Controller, index: int) -> list[str]:
        lines = self._controller(controller, index)
        return ["else:", *(f"    {line}" for line in lines)] if index else lines

    def _head(self) -> list[str]:
        n = len(self.program.conditions)
        return [
            _CODING,
            f"# {commented(title(self.program))}: {counted(n, 'condition')}, {counted(n + 1, 'controller')}.",
            "# Written by sb3-progpolicy. Needs Python 3.8 or newer and nothing else.",
            "#",
            "#     policy = ProgramPolicy()",
            "#     action = policy.act(observation, None, 0.0, False)      # the first step",
            "#     action = policy.act(observation, action, reward, done)  # every later step",
            *self._imports(),
            "",
        ]

    def _imports(self) -> list[str]:
        names = ["frexp", "ldexp"] if self._rounds else []
        if any(c.remembers and c.cell != "switch" for c in self.program.conditions):
            names.append("tanh")
        return ["", f"from math import {', '.join(names)}"] if names else []

    @property
    def _rounds(self) -> bool:
        """Whether a previous reward or action that is not whole is read, which training rounds to 24 bits."""
        program = self.program
        history = not self.by_hand or any(self.used[program.n_observations : -2])
        return program.interaction and bool(self.used[-2] or (program.action.kind == "box" and history))

    def _class(self) -> list[str]:
        program, states = self.program, self._states()
        memory = " whose conditions remember what they have read" if states else ""
        reset = [f"self._{name} = {tuple_of('0.0' for _ in locals_)}" for name, locals_ in states]
        return [
            "",
            "class ProgramPolicy:",
            f'    """An if-then-else over affine controllers{memory}."""',
            "",
            f"    n_observations = {program.n_observations}",
            *strings_lines("    input_names", program.input_names),
            *strings_lines("    output_names", program.output_names),
            "",
            "    def __init__(self):",
            "        self.reset()",
            "",
            "    def reset(self):",
            '        """Forget everything. Call it when the task changes, not when an episode ends."""',
            *(f"        {line}" for line in reset),
            "",
            *(_FLOAT32 if self._rounds else ()),
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
            kinds = "hc" if condition.cell == "lstm" else "h" * condition.remembers
            states += [
                (f"{kind}{index}", [f"{kind}{index}_{u + 1}" for u in range(condition.hidden_size)]) for kind in kinds
            ]
        return states

    def _read_inputs(self) -> list[str]:
        program, n = self.program, self.program.n_observations
        lines = [
            f"if len(observation) != {n}:",
            f'    raise ValueError("observation holds %d numbers; {n} are accepted" % len(observation))',
        ]
        if self.by_hand:
            lines += [
                _named(self.inputs[k], f"float(observation[{k}])", program.input_names[k])
                for k in range(n)
                if self.used[k]
            ]
        elif n:
            lines += unpack(self.inputs, "map(float, observation)")
            named = zip(self.inputs, program.input_names[:n], strict=True)
            lines += [f"# {variable}: {commented(name)}" for variable, name in named if variable != name]
        if not program.interaction:
            return lines
        lines += self._read_history() if not self.by_hand or any(self.used[n:-2]) else []
        lines += ["reward = self._float32(previous_reward)"] * self.used[-2]
        return [*lines, *["done = float(previous_done)"] * self.used[-1]]

    def _read_history(self) -> list[str]:
        """Statements for the previous action, as an index into tables or by the names of what X holds of it."""
        action, n, lines = self.program.action, self.program.n_observations, list[str]()
        if self.one_hot and not self.by_hand:
            lines.append(
                "# Actions pick rows of the tables at the end of the file; -1, the last row, is for no action."
            )
        if action.kind == "discrete":
            lines += index_statements("action", "previous_action", action.start, action.sizes[0])
        elif action.kind == "multi_discrete":
            source = f"[None] * {self.parts} if previous_action is None else previous_action"
            lines += unpack([f"given_{part}" for part in range(self.parts)], source)
            for part, size in enumerate(action.sizes):
                lines += index_statements(f"action_{part}", f"given_{part}", 0, size)
        elif not self.by_hand:
            zeros = f"[0.0] * {len(self.history)} if previous_action is None else previous_action"
            rounded = "self._float32" if action.kind == "box" else "float"
            return [*lines, *unpack(self.history, f"map({rounded}, {zeros})")]
        if not self.by_hand:
            return lines
        rounded = "self._float32" if action.kind == "box" else "float"
        sources = [
            f"0.0 if previous_action is None else {rounded}(previous_action[{k}])" for k in range(action.history_size)
        ]
        if self.one_hot:
            single = action.kind == "discrete"
            parts = enumerate(action.sizes)
            sources = [f"action{'' if single else f'_{part}'} == {k}" for part, size in parts for k in range(size)]
        names = self.program.input_names[n:-2]
        chosen = zip(self.history, sources, names, self.used[n:-2], strict=True)
        return [*lines, *(_named(variable, source, name) for variable, source, name, used in chosen if used)]

    def _variables(self) -> list[str]:
        """The variable of every number of X, of a program that is written as by hand."""
        return [*self.inputs, *self.history, *["reward", "done"] * self.program.interaction]

    def _advance_conditions(self) -> list[str]:
        lines = [f"{tuple_of(names)} = self._{name}" for name, names in self._states()]
        for index, condition in enumerate(self.program.conditions, start=1):
            if self.by_hand and not condition.remembers:
                continue
            lines += ["", f"# Condition {index}: {condition_words(condition)}", *self._condition(condition, index)]
        return [*lines, ""]

    def _condition(self, condition: Condition, index: int) -> list[str]:
        if condition.cell == "affine":
            return self._affine([_Row(f"b{index}", condition.readout_bias, condition.readout)], f"CONDITION_{index}")
        if condition.cell == "min":
            sums = [_Row(name, *one) for name, one in zip(_sum_names(condition, index), condition.sums, strict=True)]
            return self._affine(sums, f"CONDITION_{index}")
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
                recurrent += [*sum_statements(f"u{name[1:]}", condition.bias_hh[row], terms)]
            else:
                rows.append(_Row(name, condition.bias_ih[row] + condition.bias_hh[row], condition.weight_ih[row]))
                recurrent += sum_statements(name, None, terms)
        lines = [*self._affine(rows, f"CONDITION_{index}"), *recurrent]
        for unit in range(size):
            lines += cell_statements(condition.cell, f"{index}_{unit + 1}")
        if condition.cell == "rnn":
            lines += [f"{name} = tanh(new_{name})" for name in hidden]
        if condition.cell == "lstm":
            lines.append(f"self._c{index} = {tuple_of(name.replace('h', 'c') for name in hidden)}")
        readout = list(zip(condition.readout, hidden, strict=True))
        return [
            *lines,
            f"self._h{index} = {tuple_of(hidden)}",
            *sum_statements(f"b{index}", condition.readout_bias, readout),
        ]

    def _controller(self, controller: Controller, index: int) -> list[str]:
        action, names = self.program.action, self.outputs
        if self.by_hand and not any(map(any, controller.weights)):
            return self._constant_action(controller.bias)
        rows = [_Row(*row) for row in zip(names, controller.bias, controller.weights, strict=True)]
        lines = [f"# Controller {index + 1}", *self._affine(rows, f"CONTROLLER_{index + 1}")]
        if action.kind == "discrete":
            start = f" + {action.start}" if action.start else ""
            return [*lines, f"scores = {tuple_of(names)}", f"return scores.index(max(scores)){start}"]
        if action.kind == "multi_binary":
            return [*lines, *list_lines("return", (f"1 if {name} > 0.0 else 0" for name in names))]
        if action.kind == "box":
            bounds = zip(names, action.low, action.high, strict=True)
            return [
                *lines,
                *list_lines(
                    "return", (f"min(max({n}, {float_number(low)}), {float_number(high)})" for n, low, high in bounds)
                ),
            ]
        first = 0
        for part, size in enumerate(action.sizes):
            lines.append(f"scores_{part} = {tuple_of(names[first : first + size])}")
            first += size
        return [
            *lines,
            *list_lines(
                "return", (f"scores_{p}.index(max(scores_{p}))" for p in range(self.parts or len(action.sizes)))
            ),
        ]

    def _constant_action(self, scores: Sequence[float]) -> list[str]:
        """The statement that returns the action of a controller that reads nothing."""
        action = self.program.action
        if action.kind == "box":
            clipped = [min(max(s, low), high) for s, low, high in zip(scores, action.low, action.high, strict=True)]
            items = [float_number(value) for value in clipped]
        elif action.kind == "multi_binary":
            items = [str(int(score > 0)) for score in scores]
        else:
            best, first = [], 0
            for size in action.sizes:
                part = scores[first : first + size]
                best.append(part.index(max(part)))
                first += size
            if action.kind == "discrete":
                return [f"return {best[0] + action.start}  # {commented(self.program.output_names[best[0]])}"]
            items = [str(choice) for choice in best]
        line = f"return [{', '.join(items)}]"
        return [line] if len(line) <= WIDTH - 15 else list_lines("return", items)

    def _affine(self, rows: Sequence[_Row], table: str) -> list[str]:
        """Statements that compute all rows, with the terms in the order of X. A one-hot action's come from a table."""
        n, lines, picked = self.program.n_observations, list[str](), []
        if self.by_hand:
            return [line for row in rows for line in self._sum(row, zip(row.weights, self._variables(), strict=True))]
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
                lines += unpack(names, f"{table}_AFTER_ACTION{suffix}[{index}]")
                picked.append(names)
        for place, row in enumerate(rows):
            terms = list(zip(row.weights[:n], self.inputs, strict=True))
            if self.one_hot:
                terms += [(1.0, names[place]) for names in picked]
            elif self.program.interaction:
                terms += list(zip(row.weights[n:-2], self.history, strict=True))
            if self.program.interaction:
                terms += [(row.weights[-2], "reward"), (row.weights[-1], "done")]
            lines += self._sum(row, terms)
        return lines

    def _sum(self, row: _Row, terms: Iterable[tuple[float, str]]) -> list[str]:
        if self.program.action.kind == "box" and not any(row.weights):
            # A whole number among the actions would make an array of them one of whole numbers.
            return [f"{row.name} = {float_number(row.constant)}"]
        return sum_statements(row.name, row.constant, list(terms))

    def _table(self, name: str, columns: Sequence[Sequence[float]], first: int) -> None:
        """A constant: what each previous action adds to every row. The last line, at index -1, is for no action."""
        self.tables += ["", f"{name} = ("]
        for choice, column in enumerate(columns):
            comment = f"# {commented(self.program.input_names[first + choice])}"
            self.tables += [f"    {comment}", *pack(separated(map(number, column)), "    (", "     ", WIDTH)]
            self.tables[-1] += "),"
        self.tables += ["    # no action yet", f"    (0.0,) * {len(columns[0])},", ")"]


def _weights_of_inputs(program: ProgramData) -> list[Sequence[float]]:
    """The weights of X in every sum of a program."""
    rows: list[Sequence[float]] = [row for controller in program.controllers for row in controller.weights]
    for condition in program.conditions:
        rows += condition.rows
    return rows


def _sum_names(condition: Condition, index: int) -> list[str]:
    """The variables of the sums of a condition."""
    return [f"m{index}_{place}" for place in range(1, len(condition.sums) + 1)]


def _named(variable: str, source: str, name: str) -> str:
    return f"{variable} = {source}" + ("" if variable == name else f"  # {commented(name)}")
