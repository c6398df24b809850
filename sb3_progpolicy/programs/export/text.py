"""A program as plain text, for people."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_progpolicy.programs.export.grids import LEGEND, Tables, block_text, blocks_of
from sb3_progpolicy.programs.export.visitor import (
    CELL_NAMES,
    Decimals,
    ProgramVisitor,
    action_rule,
    always_or_never,
    counted,
    gate_names,
    is_switch,
    largest_terms,
    pack,
    simplified_as,
    switch_sums,
    title,
)
from sb3_progpolicy.programs.syntax import Condition, Controller, IfThenElse, ProgramData

WIDTH = 100
INDENT = "    "
_OPERATORS = frozenset(" +-*/=<>()")
_RULES = {
    "rnn": "RNN:  each step, h becomes the value of its line.",
    "gru": "GRU:  each step, h becomes (1 - z)*n + z*h, so z near 1 keeps the memory and z near 0 writes n.",
    "lstm": "LSTM: each step, c becomes f*c + i*g and h becomes o*tanh(c), so f keeps, i writes and o shows.",
    "switch": "Switch: a step turns it on where its first line holds, off where only the second does; else it stays.",
}


def export_text(program: ProgramData, decimals: int = 2, max_terms: int | None = 6) -> str:
    """Print a program as an indented if-then-else that a person can read.

    The terms of every sum stand in order of size. Those that round to zero or come after ``max_terms`` are only
    counted. An affine condition stands in the line of its branch, and several numbers of a Box action in one line,
    where they fit; a min of several sums takes as many lines as it needs. Whole numbers are printed without a point, so
    that ``3`` is exact and ``3.00`` is rounded. :func:`export_python` and the saved file hold all numbers in full.

    :param program: what to print
    :param decimals: digits after the point
    :param max_terms: terms shown of each sum, apart from the constant; ``None`` for all
    :return: lines of text, with a newline at the end
    :raises ValueError: if the program is not well formed
    """
    return _TextPrinter(program, decimals, max_terms).print()


class _TextPrinter(ProgramVisitor[list[str]]):
    def __init__(self, program: ProgramData, decimals: int, max_terms: int | None) -> None:
        super().__init__(program)
        self.number, self.max_terms = Decimals(decimals), max_terms
        self.blocks, self.tables = blocks_of(program), Tables()
        self.inputs = [_set_apart(n) if _OPERATORS & set(n) or n[0].isdigit() else n for n in program.input_names]

    def print(self) -> str:
        lines = [*self._heading(), "", *self.visit(self.program.body)]
        for index, condition in enumerate(self.program.conditions):
            if self._inline(condition, index) is None:
                lines += ["", *self._condition(condition, index)]
        lines += self._legend("\n".join(lines))
        cells = sorted({condition.cell for condition in self.program.conditions} & set(_RULES))
        if cells:
            lines += [
                "",
                *(_RULES[cell] for cell in cells),
                "All memory starts at 0 and is kept until the task changes.",
            ]
        return "\n".join(lines) + "\n"

    def visit_branch(self, branch: IfThenElse, index: int) -> list[str]:
        heading = self._inline(branch.condition, index) or [f"{_word(index)} B{index + 1} >= 0:"]
        return [*heading, *self._lines(branch.then), *self.visit(branch.orelse, index + 1)]

    def visit_controller(self, controller: Controller, index: int) -> list[str]:
        return ["else:" if index else "always:", *self._lines(controller)]

    def _heading(self) -> list[str]:
        program = self.program
        n_conditions = len(program.conditions)
        reads = f"Every step it reads {counted(program.n_inputs, 'number')}: {program.n_observations} observed"
        if program.interaction:
            reads += f", {program.action.history_size} for the previous action, its reward and the done flag"
        return [
            f"{title(program)}: {counted(n_conditions, 'condition')}, {counted(n_conditions + 1, 'controller')}.",
            *simplified_as(program),
            f"{reads}.",
            action_rule(program.action),
            *(
                ["The first B from the top that is not below 0 decides; all are computed at every step."]
                * (n_conditions > 1)
            ),
            *(
                ["A min is the least of its sums: it holds where none of them is below 0."]
                * any(condition.cell == "min" for condition in program.conditions)
            ),
        ]

    def _legend(self, printed: str) -> list[str]:
        used = [block.name for block in self.blocks if f"{block.name}*(" in printed]
        legend = ["", *(LEGEND.format(name=name) for name in used)] if used else []
        tables = self.tables.new_lines()
        return [*legend, *([""] if tables else []), *tables]

    def _lines(self, controller: Controller) -> list[str]:
        names = [_set_apart(name) if "=" in name else name for name in self.program.output_names]
        packed = self.program.action.kind == "box"
        width = 0 if packed else max(len(name) for name in names)
        lines: list[str] = []
        for name, constant, weights in zip(names, controller.bias, controller.weights, strict=True):
            added = self._inputs_sum(f"{INDENT}{name.ljust(width)} = ", constant, weights)
            if packed and lines and len(added) == 1 and len(lines[-1]) + len(added[0]) - len(INDENT) + 3 <= WIDTH:
                lines[-1] += f";  {added[0].lstrip()}"
            else:
                lines += added
        return lines

    def _inline(self, condition: Condition, index: int) -> list[str] | None:
        """Return the lines that begin a branch with its condition written out: a min, or an affine one that fits."""
        if condition.remembers:
            return None
        lines = self._stateless(condition, f"{_word(index)} B{index + 1} = ", " >= 0:")
        fits = len(lines) == 1 and len(lines[0]) <= WIDTH
        return lines if fits or condition.cell == "min" else None

    def _stateless(self, condition: Condition, start: str, close: str = "") -> list[str]:
        """An affine sum, or the least of several."""
        if condition.cell == "affine":
            ((constant, weights),) = condition.sums
            return self._inputs_sum(start, constant, weights, close)
        first = f"{start}min("
        following, ends = " " * len(first), [*[","] * (len(condition.sums) - 1), f"){close}"]
        sums = [
            self._inputs_sum(following, constant, weights, end)
            for (constant, weights), end in zip(condition.sums, ends, strict=True)
        ]
        if all(len(lines) == 1 for lines in sums):
            return pack([lines[0][len(first) :] for lines in sums], first, following, WIDTH)
        lines = [line for of_one in sums for line in of_one]
        return [first + lines[0][len(first) :], *lines[1:]]

    def _inputs_sum(self, start: str, constant: float, weights: Sequence[float], close: str = "") -> list[str]:
        """A sum over X, its grids as functions of row and column or as tables where they are such."""
        left, functions = list(weights), []
        for block in self.blocks:
            text = block_text(block, weights, self.tables)
            if text is not None:
                functions.append(text)
                left[block.start : block.stop] = [0.0] * (block.stop - block.start)
        return self._sum(start, constant, left, self.inputs, close, functions)

    def _condition(self, condition: Condition, index: int) -> list[str]:
        size = condition.hidden_size
        start = f"B{index + 1} = "
        if not condition.remembers:
            return self._stateless(condition, start)
        if is_switch(condition):
            while_on, while_off = condition.readout_bias + condition.readout[0], condition.readout_bias
            lines = [f"{start}{self.number(while_on)} while on, {self.number(while_off)} while off"]
            for name, (constant, weights) in switch_sums(condition):
                often = always_or_never(constant, weights)
                start = f"{INDENT}{name + ' when':<9}"
                lines += [f"{INDENT}{name} {often}"] if often else self._inputs_sum(start, constant, weights, " >= 0")
            return lines
        units = [f"h{unit + 1}" for unit in range(size)]
        lines = self._sum(start, condition.readout_bias, condition.readout, units)
        lines.append(f"{INDENT}its memory: {counted(size, f'{CELL_NAMES[condition.cell]} unit')}")
        rows = list(zip(gate_names(condition), self._gates(condition, units), strict=True))
        for unit in range(size):
            lines += [line for (_, owner), gate in rows if owner == unit for line in gate]
        return lines

    def _gates(self, condition: Condition, units: Sequence[str]) -> list[list[str]]:
        gates, names = [], [*self.inputs, *units]
        for row, (gate, unit) in enumerate(gate_names(condition)):
            squash = {"on": "", "off": ""}.get(gate, "tanh" if gate in ("h", "n", "g") else "sigmoid")
            recurrent, constant = condition.weight_hh[row], condition.bias_ih[row] + condition.bias_hh[row]
            label = f"{INDENT}h{unit + 1} = " if gate == "h" else f"{INDENT}{gate}{unit + 1} = "
            if not squash:
                label = f"{INDENT}h{unit + 1} {gate} when "
                gates.append(self._sum(label, constant, (*condition.weight_ih[row], *recurrent), names, " >= 0"))
                continue
            if gate != "n":
                gates.append(
                    self._sum(f"{label}{squash}(", constant, (*condition.weight_ih[row], *recurrent), names, ")")
                )
                continue
            # r scales the recurrent part of n alone, so that part is a sum of its own.
            inner = " ".join(self._tokens(condition.bias_hh[row], recurrent, units))
            close = ")" if inner in ("0", "-0") else f" + r{unit + 1}*({inner}))"
            gates.append(
                self._sum(f"{label}{squash}(", condition.bias_ih[row], condition.weight_ih[row], self.inputs, close)
            )
        return gates

    def _sum(
        self,
        start: str,
        constant: float,
        weights: Sequence[float],
        names: Sequence[str],
        close: str = "",
        functions: Sequence[str] = (),
    ) -> list[str]:
        tokens = self._tokens(constant, weights, names)
        if functions:
            first = f"- {tokens[0][1:]}" if tokens[0][0] == "-" else f"+ {tokens[0]}"
            rest = [] if tokens == ["0"] else [first, *tokens[1:]]
            tokens = [functions[0], *(f"+ {function}" for function in functions[1:]), *rest]
        tokens[-1] += close
        return pack(tokens, start, " " * min(len(start), WIDTH // 2), WIDTH)

    def _tokens(self, constant: float, weights: Sequence[float], names: Sequence[str]) -> list[str]:
        terms = largest_terms(weights, names, self.number.digits, self.max_terms)
        tokens = [self.number(constant)] if constant else []
        for weight, name in terms.shown:
            sign = "-" if weight < 0 else "+" if tokens else ""
            tokens.append(f"{sign}{' ' if tokens else ''}{self.number.factor(weight, '*')}{name}")
        if terms.n_dropped:
            tokens.append(f"{'+ ' if tokens else ''}({counted(terms.n_dropped, 'smaller term')})")
        return tokens or ["0"]


def _word(index: int) -> str:
    return "else if" if index else "if"


def _set_apart(name: str) -> str:
    """Put a name into brackets, or into quotes where its own brackets could end them early."""
    depth = 0
    for character in name:
        depth += (character == "[") - (character == "]")
        if depth < 0:
            return repr(name)
    return repr(name) if depth else f"[{name}]"
