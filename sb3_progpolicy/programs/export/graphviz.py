"""A program as a Graphviz drawing."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from sb3_progpolicy.programs.export.grids import MaxTerms, Tables, beginnings, blocks_of, collapse, terms_to_show
from sb3_progpolicy.programs.export.visitor import (
    CELL_NAMES,
    Decimals,
    ProgramVisitor,
    always_or_never,
    counted,
    deliver,
    input_importance,
    is_switch,
    largest_terms,
    switch_sums,
    title,
)
from sb3_progpolicy.programs.syntax import Condition, Controller, IfThenElse, ProgramData


def export_graphviz(
    program: ProgramData,
    out_file: str | os.PathLike[str] | Any | None = None,
    decimals: int = 2,
    max_terms: MaxTerms = "auto",
) -> str | None:
    """Draw a program in the DOT language.

    Conditions are boxes, controllers are leaves with their largest terms; the others are counted. Render the source
    with ``dot -Tsvg`` or ``graphviz.Source(source)``.

    :param program: what to draw
    :param out_file: a path or an open text file to write to
    :param decimals: digits after the point
    :param max_terms: terms shown of each sum, ``None`` for all; by default all where no sum has more than six, else
        three
    :return: the DOT source if ``out_file`` is ``None``, else ``None``
    :raises ValueError: if the program is not well formed
    """
    printer = _DotPrinter(program, decimals, max_terms)
    lines = [
        "digraph Program {",
        f"  label={_quote(title(program))}; labelloc=t; fontname=Helvetica;",
        '  node [shape=box, style="rounded,filled", fontname=Helvetica, fontsize=11, color="#44546a"];',
        '  edge [fontname=Helvetica, fontsize=11, color="#44546a"];',
        *printer.visit(program.body),
        "}",
    ]
    return deliver("\n".join(lines) + "\n", out_file)


class _DotPrinter(ProgramVisitor[list[str]]):
    def __init__(self, program: ProgramData, decimals: int, max_terms: MaxTerms) -> None:
        super().__init__(program)
        self.number = Decimals(decimals)
        self.max_terms, self.blocks = terms_to_show(program, max_terms), blocks_of(program)
        self.tables = Tables()

    def visit_branch(self, branch: IfThenElse, index: int) -> list[str]:
        following = f"B{index + 2}" if isinstance(branch.orelse, IfThenElse) else f"C{index + 2}"
        return [
            f'  B{index + 1} [fillcolor="#fdf0d5", label={_quote(*self._condition(branch.condition, index))}];',
            *self.visit_controller(branch.then, index),
            f'  B{index + 1} -> C{index + 1} [label="yes"];',
            f'  B{index + 1} -> {following} [label="no"];',
            *self.visit(branch.orelse, index + 1),
        ]

    def visit_controller(self, controller: Controller, index: int) -> list[str]:
        lines = [
            f"{name} = {self._inputs_sum(constant, weights)}"
            for name, constant, weights in zip(
                self.program.output_names, controller.bias, controller.weights, strict=True
            )
        ]
        lines += map(_apart, self.tables.new_lines())
        # \l ends a line that is set flush left.
        return [f'  C{index + 1} [fillcolor="#e3f0f7", label={_quote(*lines, end="l")}];']

    def _condition(self, condition: Condition, index: int) -> list[str]:
        if not condition.remembers:
            return [
                f"B{index + 1} >= 0 ?",
                *([f"B{index + 1} is the least of"] * (condition.cell == "min")),
                *(self._inputs_sum(constant, weights) for constant, weights in condition.sums),
                *map(_apart, self.tables.new_lines()),
            ]
        if is_switch(condition):
            while_on, while_off = condition.readout_bias + condition.readout[0], condition.readout_bias
            return [
                f"B{index + 1} >= 0 ?",
                f"B{index + 1} = {self.number(while_on)} while on, {self.number(while_off)} while off",
                *(
                    f"{name} {always_or_never(*of_x) or f'when  {self._inputs_sum(*of_x)}  >= 0'}"
                    for name, of_x in switch_sums(condition)
                ),
                *map(_apart, self.tables.new_lines()),
            ]
        units = [f"h{unit + 1}" for unit in range(condition.hidden_size)]
        heard = largest_terms(input_importance(condition), self.program.input_names, 9, self.max_terms)
        return [
            f"B{index + 1} >= 0 ?",
            f"B{index + 1} = {self._sum(condition.readout_bias, condition.readout, units)}",
            f"memory: {counted(condition.hidden_size, f'{CELL_NAMES[condition.cell]} unit')}",
            f"listens most to {', '.join(name for _, name in heard.shown) or 'nothing'}",
        ]

    def _inputs_sum(self, constant: float, weights: Sequence[float]) -> str:
        return self._sum(constant, *collapse(self.blocks, weights, self.program.input_names, self.tables))

    def _sum(self, constant: float, weights: Sequence[float], names: Sequence[str]) -> str:
        terms = largest_terms(weights, names, self.number.digits, self.max_terms, beginnings(self.blocks))
        tokens = [
            self.number(constant),
            *(f"{'-' if weight < 0 else '+'}{self.number.factor(weight, ' ')}{name}" for weight, name in terms.shown),
            *([f"({counted(terms.n_dropped, 'smaller term')})"] if terms.n_dropped else []),
        ]
        return "  ".join(tokens)


def _apart(line: str) -> str:
    """A row of a table, with spaces that Graphviz keeps."""
    return line.replace(" ", "\N{NO-BREAK SPACE}")


def _quote(*lines: str, end: str = "n") -> str:
    # To Graphviz a backslash starts an escape, such as \G for the graph's name, and & an entity of HTML.
    escaped = (line.replace("&", "&amp;").replace("\\", "\\\\").replace('"', '\\"') for line in lines)
    joined = f"\\{end}".join(escaped)
    return f'"{joined}\\l"' if end == "l" else f'"{joined}"'
