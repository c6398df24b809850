"""A program as LaTeX."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from sb3_progpolicy.programs.export.grids import as_function, as_table, blocks_of
from sb3_progpolicy.programs.export.visitor import Decimals, ProgramVisitor, deliver
from sb3_progpolicy.programs.syntax import GATES, Condition, Controller, IfThenElse, Matrix, ProgramData
from sb3_progpolicy.spaces import ActionSpec

# All that TeX, or a package such as babel, may read as a command or as part of one.
_ESCAPES = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",
    "`": r"\symbol{96}",
    **{character: f"\\{character}" for character in "#$%&_{}"},
}
# Characters beyond ASCII that pass, because LaTeX's standard fonts have them. With many others it would stop.
_LETTERS = frozenset(map(chr, range(0xC0, 0x100))) - frozenset("ÐÞðþ")
# W, b, U and d hold the gates from top to bottom, in the order in which they are named here.
_CELLS = {
    "rnn": (r"h_{%d} &\leftarrow \tanh(W x + b + U h_{%d} + d)",),
    "gru": (
        r"(r, z) &= \sigma(W_{r,z} x + b_{r,z} + U_{r,z} h_{%d} + d_{r,z})",
        r"n &= \tanh(W_n x + b_n + r \odot (U_n h_{%d} + d_n))",
        r"h_{%d} &\leftarrow (1 - z) \odot n + z \odot h_{%d}",
    ),
    "switch": (
        r"(p, q) &= W x + b + U h_{%d} + d",
        r"h_{%d} &\leftarrow \begin{cases} 1 & \text{if } p \ge 0 \\ 0 & \text{else if } q \ge 0 \\"
        r" h_{%d} & \text{otherwise} \end{cases}",
    ),
    "lstm": (
        r"(i, f, o) &= \sigma(W_{i,f,o} x + b_{i,f,o} + U_{i,f,o} h_{%d} + d_{i,f,o})",
        r"g &= \tanh(W_g x + b_g + U_g h_{%d} + d_g)",
        r"c_{%d} &\leftarrow f \odot c_{%d} + i \odot g",
        r"h_{%d} &\leftarrow o \odot \tanh(c_{%d})",
    ),
}


def export_latex(
    program: ProgramData, out_file: str | os.PathLike[str] | Any | None = None, decimals: int = 2
) -> str | None:
    r"""Typeset a program: the case distinction, the conditions' recurrences and all matrices, in the paper's notation.

    The result is a fragment for a document that loads ``amsmath``. All weights are given, none is dropped: 0 is
    zero, and 0.00 a number that rounds to it. Whole numbers on a grid of the metadata that are no function of row and
    column are given once more, in its shape. No name becomes a command. A character beyond ASCII is printed as its
    code, such as ``\u2192``, unless it is a letter of a Western European language.

    :param program: what to typeset
    :param out_file: a path or an open text file to write to
    :param decimals: digits after the point
    :return: the LaTeX source if ``out_file`` is ``None``, else ``None``
    :raises ValueError: if the program is not well formed
    """
    return deliver(_LatexPrinter(program, decimals).print(), out_file)


class _LatexPrinter(ProgramVisitor[list[str]]):
    def __init__(self, program: ProgramData, decimals: int) -> None:
        super().__init__(program)
        self.number = Decimals(decimals)

    def print(self) -> str:
        program = self.program
        blocks = [
            [
                r"\[",
                r"y(x) = \begin{cases}",
                *self.visit(program.body),
                r"\end{cases}",
                rf"\qquad {_rule(program.action)}",
                r"\]",
            ],
            [r"\[", rf"x = {self._names(program.input_names)} \qquad y = {self._names(program.output_names)}", r"\]"],
        ]
        for index, condition in enumerate(program.conditions, start=1):
            blocks.append([r"\[", r"\begin{aligned}", *self._condition(condition, index), r"\end{aligned}", r"\]"])
        for index, controller in enumerate(program.controllers, start=1):
            constant = rf"c_{{{index}}} = {self._vector(controller.bias)}"
            blocks.append([r"\[", rf"{constant} \quad T_{{{index}}} = {self._matrix(controller.weights)}", r"\]"])
        blocks += self._tables()
        body = "\n".join(line for block in blocks for line in block)
        return f"{{\\scriptsize\\setlength{{\\arraycolsep}}{{2pt}}\n{body}\n}}\n"

    def _tables(self) -> list[list[str]]:
        """Whole numbers on each grid in its shape, for every sum in which they are no function of row and column."""
        program, found = self.program, []
        sums = [
            (rf"T_{{{index}}}, \text{{{_escape(name)}}}", row)
            for index, controller in enumerate(program.controllers, start=1)
            for name, row in zip(program.output_names, controller.weights, strict=True)
        ]
        for index, condition in enumerate(program.conditions, start=1):
            rows = condition.weight_ih if condition.cell == "switch" else [weights for _, weights in condition.sums]
            for number, row in enumerate(rows, start=1):
                sums.append((f"B_{{{index}{f',{number}' if len(rows) > 1 else ''}}}", row))
        for block in blocks_of(program):
            for where, weights in sums:
                table = as_table(block, weights)
                if table is not None and as_function(block, weights) is None:
                    name = rf"\text{{{_escape(block.name)}}}"
                    found.append([r"\[", rf"{where}, {name} = {self._matrix(table)}", r"\]"])
        return found

    def visit_branch(self, branch: IfThenElse, index: int) -> list[str]:
        word = "else if" if index else "if"
        case = rf"{_affine(index)} & \text{{{word} }} B_{{{index + 1}}}(x) \ge 0 \\"
        return [case, *self.visit(branch.orelse, index + 1)]

    def visit_controller(self, controller: Controller, index: int) -> list[str]:
        return [rf"{_affine(index)} & \text{{{'otherwise' if index else 'always'}}}"]

    def _condition(self, condition: Condition, index: int) -> list[str]:
        if condition.cell == "min":
            weights, constants = self._matrix(condition.weight_ih), self._vector(condition.bias_ih)
            return [rf"B_{{{index}}}(x) &= \min \left[ {constants} + {weights} x \right]"]
        readout = self._matrix((condition.readout,))
        constant = self.number(condition.readout_bias)
        if condition.cell == "affine":
            return [rf"B_{{{index}}}(x) &= {constant} + {readout} x"]
        recurrence = [f"{line.replace('%d', str(index))} \\\\" for line in _CELLS[condition.cell]]
        rows = ", ".join(GATES[condition.cell])
        weights = rf"W = {self._matrix(condition.weight_ih)} \quad b = {self._vector(condition.bias_ih)}"
        recurrent = rf"U = {self._matrix(condition.weight_hh)} \quad d = {self._vector(condition.bias_hh)}"
        return [
            rf"B_{{{index}}}(x) &= {constant} + {readout} h_{{{index}}} \\",
            *recurrence,
            rf"& {weights} \\",
            rf"& {recurrent} \quad \text{{(rows: {rows})}}",
        ]

    def _names(self, names: Sequence[str]) -> str:
        rows = r" \\ ".join(rf"\text{{{_escape(name)}}}" for name in names)
        return rf"\left(\begin{{array}}{{l}} {rows} \end{{array}}\right)"

    def _vector(self, vector: Sequence[float]) -> str:
        return self._matrix(tuple((value,) for value in vector))

    def _matrix(self, matrix: Matrix) -> str:
        # array, because pmatrix stops at ten columns
        rows = " \\\\\n  ".join(" & ".join(self.number(value) for value in row) for row in matrix)
        return rf"\left(\begin{{array}}{{{'r' * len(matrix[0])}}} {rows} \end{{array}}\right)"


def _affine(index: int) -> str:
    return rf"c_{{{index + 1}}} + T_{{{index + 1}}} x"


def _rule(action: ActionSpec) -> str:
    return {
        "discrete": r"\text{action} = \operatorname{arg\,max}_a y_a",
        "multi_discrete": r"\text{action part} = \operatorname{arg\,max} \text{ over its own } y_a",
        "multi_binary": r"\text{action}_a = [y_a > 0]",
        "box": r"\text{action} = \min(\max(y, \text{low}), \text{high})",
    }[action.kind]


def _escape(text: str) -> str:
    coded = (
        character if character.isascii() or character in _LETTERS else ascii(character)[1:-1] for character in text
    )
    return "".join(_ESCAPES.get(character, character) for character in "".join(coded))
