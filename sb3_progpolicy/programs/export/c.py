"""A program as one C99 header that needs nothing but math.h and allocates nothing."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from itertools import groupby
from typing import Any

from sb3_progpolicy.programs.export.visitor import CELL_NAMES, ProgramVisitor, counted, deliver, gate_names, pack, title
from sb3_progpolicy.programs.syntax import GATES, Cell, Condition, Controller, IfThenElse, ProgramData

WIDTH = 98  # of a line before it is indented by up to three steps
_Term = tuple[float, str]  # weight and variable
TERMS_PER_STATEMENT = 50  # so that a compiler's stack does not grow with the length of a sum
# Longer sums are loops over a table: compilers take minutes for a function of a hundred thousand terms.
LONG_SUM, LONG_SUM_OF_A_LARGE_PROGRAM, LARGE_PROGRAM = 200, 8, 20_000
_MAX_PREFIX = 40
# What would end a comment or begin another, be a trigraph or continue a line, and all that is not printable ASCII.
_UNSAFE = re.compile(r"[^ -~]|\\|\?(?=\?)|\*(?=/)|/(?=\*)")
# One step of each cell for unit k, from the sums of its gates; `u` is what the reset gate of a GRU scales.
_STEPS: dict[Cell, tuple[str, ...]] = {
    "affine": (),
    "min": (),
    "rnn": ("h[k] = tanh(a[k]);",),
    "gru": (
        "r[k] = 0.5 + 0.5 * tanh(0.5 * r[k]);",
        "z[k] = 0.5 + 0.5 * tanh(0.5 * z[k]);",
        "n[k] = tanh(n[k] + r[k] * u[k]);",
        "h[k] = n[k] + z[k] * (h[k] - n[k]);",
    ),
    "lstm": (
        "i[k] = 0.5 + 0.5 * tanh(0.5 * i[k]);",
        "f[k] = 0.5 + 0.5 * tanh(0.5 * f[k]);",
        "o[k] = 0.5 + 0.5 * tanh(0.5 * o[k]);",
        "c[k] = f[k] * c[k] + i[k] * tanh(g[k]);",
        "h[k] = o[k] * tanh(c[k]);",
    ),
    "switch": ("if (on[k] >= 0.0) h[k] = 1.0;", "else if (off[k] >= 0.0) h[k] = 0.0;"),
}


def export_c(program: ProgramData, out_file: str | os.PathLike[str] | Any | None = None) -> str | None:
    """Write a program as one C99 header for small machines: no allocation, no library but ``math.h``.

    For the environment ``Hanoi-v0`` it defines ``hanoi_v0_state``, ``hanoi_v0_reset(state)`` and
    ``hanoi_v0_act(state, observation, previous_action, reward, done, action)``, which chooses the same actions as
    :class:`~sb3_progpolicy.programs.interpreter.ProgramRunner` with crisp semantics: doubles, and sums in the same
    order. The numbers of a Box action are doubles; cast to float they are the runner's. Terms with the weight 0 are
    not written.

    No text of a program becomes code, whoever made it: names stand in comments, in ASCII and with all that could end
    one escaped. Functions are named after the environment with letters, digits and underscores only.

    :param program: what to write
    :param out_file: a path or an open text file to write to
    :return: the source code if ``out_file`` is ``None``, else ``None``
    :raises ValueError: if the program is not well formed
    """
    return deliver(_CPrinter(program).print(), out_file)


class _CPrinter(ProgramVisitor[list[str]]):
    def __init__(self, program: ProgramData) -> None:
        super().__init__(program)
        self.prefix = _prefix(program)
        self.action_type = "double" if program.action.kind == "box" else "long long"
        inputs = [f"x[{index}]" for index in range(program.n_observations)]
        if program.interaction:
            inputs += [f"p[{index}]" for index in range(program.action.history_size)] + ["reward", "done"]
        self.inputs = inputs
        large = len(program.controllers) * program.action.n_outputs * program.n_inputs + sum(
            len(condition.bias_ih) * program.n_inputs for condition in program.conditions
        )
        self.long_sum = LONG_SUM_OF_A_LARGE_PROGRAM if large > LARGE_PROGRAM else LONG_SUM

    def print(self) -> str:
        guard = f"{self.prefix.upper()}_PROGRAM_H"
        return (
            "\n".join(
                [
                    *self._head(),
                    f"#ifndef {guard}",
                    f"#define {guard}",
                    "",
                    "#include <math.h>",
                    "",
                    *_EXACT_SUMS,
                    "",
                    *self._state(),
                    "",
                    *self._act(),
                    "",
                    *_RESTORE_OPTIONS,
                    "",
                    f"#endif /* {guard} */",
                ]
            )
            + "\n"
        )

    def visit_branch(self, branch: IfThenElse, index: int) -> list[str]:
        return [
            f"{'} else ' if index else ''}if (b{index + 1} >= 0.0) {{",
            *_indented(self._controller(branch.then)),
            *self.visit(branch.orelse, index + 1),
        ]

    def visit_controller(self, controller: Controller, index: int) -> list[str]:
        lines = self._controller(controller)
        return ["} else {", *_indented(lines), "}"] if index else lines

    def _head(self) -> list[str]:
        program, name, n = self.program, self.prefix, len(self.program.conditions)
        lines = [
            f"/* {_commented(title(program))}: {counted(n, 'condition')}, {counted(n + 1, 'controller')}.",
            " * Written by sb3-progpolicy. C99, no library but math.h, no allocation.",
            " *",
            f" *     {name}_state state;",
            f" *     {self.action_type} action[{self._n_actions()}];",
            f" *     {name}_reset(&state);                                          when the task changes",
            f" *     {name}_act(&state, observation, NULL, 0.0, 0.0, action);        the first step",
            f" *     {name}_act(&state, observation, action, reward, done, action);  every later step",
            " *",
            f" * observation, x in the sums: {counted(program.n_observations, 'finite number')}.",
            f" * action: {self._action_words()}.",
            " */",
        ]
        lines += [f"/* x[{k}]: {_commented(text)} */" for k, text in enumerate(self._observed())]
        return lines

    def _observed(self) -> tuple[str, ...]:
        return self.program.input_names[: self.program.n_observations]

    def _n_actions(self) -> int:
        action = self.program.action
        return {"discrete": 1, "multi_discrete": len(action.sizes)}.get(action.kind, action.n_outputs)

    def _action_words(self) -> str:
        action = self.program.action
        return {
            "discrete": f"one whole number from {action.start} to {action.start + action.n_outputs - 1}",
            "multi_discrete": f"{counted(len(action.sizes), 'whole number')}, each from 0",
            "multi_binary": f"{counted(action.n_outputs, 'number')}, each 0 or 1",
            "box": f"{counted(action.n_outputs, 'number')} inside the bounds",
        }[action.kind]

    def _state(self) -> list[str]:
        name = self.prefix
        members = [
            (f"{kind}{index}", condition.hidden_size)
            for index, condition in enumerate(self.program.conditions, start=1)
            for kind in ("hc" if condition.cell == "lstm" else "h" * condition.remembers)
        ]
        fields = [f"double {member}[{size}];" for member, size in members]
        zeros = [f"for (int k = 0; k < {size}; k++) state->{member}[k] = 0.0;" for member, size in members]
        return [
            "typedef struct {",
            *_indented(fields or ["char unused; /* this program has no memory, and C wants a member */"]),
            f"}} {name}_state;",
            "",
            "/* Forget everything. Call it when the task changes, not when an episode ends. */",
            f"static inline void {name}_reset({name}_state *state)",
            "{",
            *_indented(zeros or ["state->unused = 0;"]),
            "}",
        ]

    def _act(self) -> list[str]:
        name, n_outputs, history = self.prefix, self.program.action.n_outputs, self.program.interaction
        body = [
            f"double y[{n_outputs}];",
            *self._read_history(),
            # A program need not read all that it is given.
            f"(void)state, (void)x, (void)y, (void)previous_action, (void)reward, (void)done{', (void)p' * history};",
        ]
        for index, condition in enumerate(self.program.conditions, start=1):
            body += ["", f"/* Condition {index}: {_condition_words(condition)} */", *self._condition(condition, index)]
        body += ["", *self.visit(self.program.body), "", *self._choose(), "return 0;"]
        return [
            "/* Choose an action; `previous_action` is NULL before the first, and may be the same array as `action`.",
            " * Return 0, or -1, with nothing changed, if the previous action is not in the action space. */",
            f"static inline int {name}_act(",
            f"    {name}_state *state, const double *x, const {self.action_type} *previous_action,",
            f"    double reward, double done, {self.action_type} *action)",
            "{",
            *_indented(body),
            "}",
        ]

    def _read_history(self) -> list[str]:
        """Statements for p, the previous action as X holds it: one-hot for discrete spaces."""
        if not self.program.interaction:
            return []
        action = self.program.action
        lines = [
            # GCC 12 leaves out a conversion to float and back in a loop that it turns into vectors.
            "volatile float rounded = (float)reward; /* as in training */",
            "reward = (double)rounded;",
            f"double p[{action.history_size}] = {{0.0}}; /* the previous action */",
        ]
        if action.kind in ("box", "multi_binary"):
            lines += [
                f"for (int k = 0; previous_action && k < {action.n_outputs}; k++) {{",
                "    rounded = (float)previous_action[k];",
                "    p[k] = (double)rounded;",
                "}",
            ]
        else:
            lines += ["if (previous_action) {"]
            first = 0
            for part, size in enumerate(action.sizes):
                given = f"previous_action[{part}]"
                lines += [
                    f"    if ({given} < {action.start} || {given} > {action.start + size - 1}) return -1;",
                    f"    p[{_plus(given, first - action.start)}] = 1.0;",
                ]
                first += size
            lines.append("}")
        names = self.program.input_names[self.program.n_observations : -2]
        lines += [f"/* p[{k}]: {_commented(text)} */" for k, text in enumerate(names)]
        return lines

    def _condition(self, condition: Condition, index: int) -> list[str]:
        if condition.cell == "affine":
            return self._sum(f"double b{index}", condition.readout_bias, condition.readout, self.inputs)
        if condition.cell == "min":
            lines = [f"double m[{len(condition.sums)}];"]
            for place, (bias, weights) in enumerate(condition.sums):
                lines += self._sum(f"m[{place}]", bias, weights, self.inputs)
            lines.append(f"b{index} = m[0];")
            if (n_sums := len(condition.sums)) > 1:
                # What is not a number stays, and is then not at least 0.
                lines.append(
                    f"for (int k = 1; k < {n_sums}; k++) if (m[k] < b{index} || m[k] != m[k]) b{index} = m[k];"
                )
            return [f"double b{index};", "{", *_indented(lines), "}"]
        size = condition.hidden_size
        gates = ("a",) if condition.cell == "rnn" else GATES[condition.cell]
        locals_ = ", ".join(f"{gate}[{size}]" for gate in (*gates, *("u" * (condition.cell == "gru"))))
        lines = [f"double *h = state->h{index};"]
        lines += [f"double *c = state->c{index};"] * (condition.cell == "lstm")
        lines.append(f"double {locals_};")
        hidden = [f"h[{unit}]" for unit in range(size)]
        for row, (gate, unit) in enumerate(gate_names(condition)):
            name = f"{'a' if condition.cell == 'rnn' else gate}[{unit}]"
            inputs, recurrent = condition.weight_ih[row], condition.weight_hh[row]
            if gate == "n":
                # The reset gate scales this sum before it joins the rest.
                lines += self._sum(name, condition.bias_ih[row], inputs, self.inputs)
                lines += self._sum(f"u[{unit}]", condition.bias_hh[row], recurrent, hidden)
            else:
                constant = condition.bias_ih[row] + condition.bias_hh[row]
                lines += self._sum(name, constant, (*inputs, *recurrent), (*self.inputs, *hidden))
        lines += [f"for (int k = 0; k < {size}; k++) {{", *_indented(_STEPS[condition.cell]), "}"]
        lines += self._sum(f"b{index}", condition.readout_bias, condition.readout, hidden)
        return [f"double b{index};", "{", *_indented(lines), "}"]

    def _controller(self, controller: Controller) -> list[str]:
        lines = []
        rows = zip(self.program.output_names, controller.bias, controller.weights, strict=True)
        for row, (name, constant, weights) in enumerate(rows):
            lines += self._sum(f"y[{row}]", constant, weights, self.inputs)
            lines[-1] += f" /* {_commented(name)} */"
        return lines

    def _sum(self, name: str, constant: float, weights: Sequence[float], variables: Sequence[str]) -> list[str]:
        """Statements for ``name = constant + weights · variables``, added from left to right."""
        terms = [(weight, variable) for weight, variable in zip(weights, variables, strict=True) if weight]
        short, lines = list[_Term](), list[str]()
        for array, run in groupby(terms, lambda term: term[1].partition("[")[0]):
            run_terms = list(run)
            if len(run_terms) <= self.long_sum:
                short += run_terms
                continue
            if short or not lines:
                lines += _statements(name, constant if not lines else None, short)
            lines += _loop(name.removeprefix("double "), array, run_terms)
            short = []
        if short or not lines:
            lines += _statements(name, constant if not lines else None, short)
        return lines

    def _choose(self) -> list[str]:
        """Statements that turn y into the action; nothing is written before all has been read."""
        action = self.program.action
        if action.kind == "multi_binary":
            return [f"for (int k = 0; k < {action.n_outputs}; k++) action[k] = y[k] > 0.0;"]
        if action.kind == "box":
            lines = []
            for k, (low, high) in enumerate(zip(action.low, action.high, strict=True)):
                lower, upper = _double(low), _double(high)
                lines.append(f"action[{k}] = y[{k}] < {lower} ? {lower} : y[{k}] > {upper} ? {upper} : y[{k}];")
            return lines
        lines, first = ["long long best; /* the first of the highest scores */"], 0
        for part, size in enumerate(action.sizes):
            lines += [
                f"best = {first};",
                *([f"for (int k = {first + 1}; k < {first + size}; k++) if (y[k] > y[best]) best = k;"] * (size > 1)),
                f"action[{part}] = {_plus('best', action.start - first)};",
            ]
            first += size
        return lines


# GCC does not know the pragma of C99, warns of it, and contracts by itself unless it is told -std=c99.
_EXACT_SUMS = [
    "/* a * b + c in one rounding, or sums in another order, would be another program in the last bit. */",
    "#if defined(__FAST_MATH__)",
    '#error "compile without -ffast-math"',
    "#elif defined(__GNUC__) && !defined(__clang__)",
    "#pragma GCC push_options",
    '#pragma GCC optimize ("fp-contract=off")',
    "#else",
    "#pragma STDC FP_CONTRACT OFF",
    "#endif",
]
_RESTORE_OPTIONS = ["#if defined(__GNUC__) && !defined(__clang__)", "#pragma GCC pop_options", "#endif"]


def _prefix(program: ProgramData) -> str:
    """Return the environment's name in lower-case letters, digits and underscores, ``program`` where it has none."""
    environment = program.metadata.get("env")
    name = environment.rpartition(":")[2] if isinstance(environment, str) else ""
    name = re.sub(r"[^0-9a-z]+", "_", name.lower()).strip("_")[:_MAX_PREFIX].rstrip("_")
    return name if name and name[0].isalpha() else f"program_{name}".rstrip("_")


def _statements(name: str, constant: float | None, terms: Sequence[_Term]) -> list[str]:
    """Statements for ``name = constant + terms``, or ``name + terms`` where the constant is ``None``."""
    bare = name.removeprefix("double ")
    start, lines = bare if constant is None else _double(constant), list[str]()
    for first in range(0, max(len(terms), 1), TERMS_PER_STATEMENT):
        tokens = [start, *map(_token, terms[first : first + TERMS_PER_STATEMENT])]
        if len(tokens) > 1 and start in ("0.0", "-0.0"):
            tokens = [tokens[1].replace("- ", "-", 1) if tokens[1][0] == "-" else tokens[1][2:], *tokens[2:]]
        lines += pack(
            [*tokens[:-1], f"{tokens[-1]};"], f"{bare if lines or constant is None else name} = ", "    ", WIDTH
        )
        start = bare
    return lines


def _loop(name: str, array: str, terms: Sequence[_Term]) -> list[str]:
    """Statements that add terms over one array to ``name`` from left to right."""
    weights = [f"{_double(weight)}," for weight, _ in terms]
    places = [int(variable[len(array) + 1 : -1]) for _, variable in terms]
    lines = ["{", *pack(weights, "    static const double w[] = { ", "        ", WIDTH)]
    if places == list(range(places[0], places[0] + len(places))):
        index = _plus("k", places[0])
    else:
        lines[-1] += " };"
        lines += pack([f"{place}," for place in places], "    static const int at[] = { ", "        ", WIDTH)
        index = "at[k]"
    lines[-1] += " };"
    return [*lines, f"    for (int k = 0; k < {len(terms)}; k++) {name} += w[k] * {array}[{index}];", "}"]


def _token(term: _Term) -> str:
    weight, variable = term
    sign = "-" if weight < 0 else "+"
    return f"{sign} {variable}" if abs(weight) == 1 else f"{sign} {_double(abs(weight))} * {variable}"


def _double(value: float) -> str:
    # The sum of two constants may be infinite.
    value = float(value)
    return repr(value) if math.isfinite(value) else "HUGE_VAL" if value > 0 else "-HUGE_VAL"


def _plus(name: str, number: int) -> str:
    return f"{name} {'-' if number < 0 else '+'} {abs(number)}" if number else name


def _condition_words(condition: Condition) -> str:
    if not condition.remembers:
        return "affine, no memory" if condition.cell == "affine" else "the least of affine sums, no memory"
    return counted(condition.hidden_size, f"{CELL_NAMES[condition.cell]} unit")


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"    {line}" if line else line for line in lines]


def _commented(text: str) -> str:
    return _UNSAFE.sub(lambda match: f"<U+{ord(match[0]):04X}>", str(text))
