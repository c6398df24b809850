"""A program as a matplotlib picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sb3_progpolicy.programs.export.grids import MaxTerms, Tables, beginnings, blocks_of, collapse, terms_to_show
from sb3_progpolicy.programs.export.visitor import (
    CELL_NAMES,
    Decimals,
    ProgramVisitor,
    always_or_never,
    counted,
    input_importance,
    is_switch,
    largest_terms,
    switch_sums,
    title,
)
from sb3_progpolicy.programs.syntax import Condition, Controller, IfThenElse, ProgramData

INK, QUIET, LINE = "#263238", "#78858c", "#b4bec4"
CONDITION_FILL, CONDITION_EDGE = "#fdf3dc", "#e0a526"
LEAF_FILL, LEAF_EDGE = "#ffffff", "#b4bec4"
RAISES, LOWERS = "#12715b", "#b5411f"
MINUS = "\N{MINUS SIGN}"
# In inches, except for the font. The text is monospaced, so that its width is known before it is drawn.
FONT_SIZE, CHARACTER, ROW, PAD, GAP = 9.0, 0.0753, 0.205, 0.14, 0.34
MAX_ROWS, MAX_NAME = 12, 40


@dataclass(frozen=True)
class _Card:
    """A box of text: rows of (text, colour, column in characters)."""

    rows: tuple[tuple[tuple[str, str, int], ...], ...]

    @property
    def width(self) -> float:
        return 2 * PAD + CHARACTER * max(column + len(text) for row in self.rows for text, _, column in row)

    @property
    def height(self) -> float:
        return 2 * PAD + ROW * len(self.rows)


def plot_program(
    program: ProgramData, ax: Any = None, decimals: int = 1, max_terms: MaxTerms = "auto", max_outputs: int = MAX_ROWS
) -> Any:
    """Draw a program: conditions on the left from top to bottom, the controller that each leads to on the right.

    For every output the terms with the largest weights are named, green where they raise it, red where they lower it.
    Long names are shortened. matplotlib draws names as they are; only its ``pgf`` backend takes all text for TeX, so do
    not use that one for a program that you do not trust.

    :param program: what to draw
    :param ax: matplotlib axes to draw into; by default a new figure of the size that the program needs
    :param decimals: digits after the point
    :param max_terms: terms shown of each sum, the constant not counted, ``None`` for all; by default all where no sum
        has more than six, else three
    :param max_outputs: outputs shown of each controller
    :return: the axes
    :raises ValueError: if the program is not well formed
    :raises ImportError: if matplotlib is missing
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError('plot_program needs matplotlib: pip install "sb3-progpolicy[plot]"') from error
    cards = _PlotPrinter(program, decimals, max_terms, max_outputs)
    pairs = cards.visit(program.body)
    left = max((condition.width for condition, _ in pairs if condition), default=0.0)
    arrow = 0.75 if left else 0.0
    reading = _how_to_read(program, cards.max_terms is None)
    texts = max(CHARACTER * len(line) for line in reading)
    right = max(leaf.width for _, leaf in pairs)
    width = max(left + arrow + right, texts) + 2 * GAP
    heights = [max(leaf.height, condition.height if condition else 0) for condition, leaf in pairs]
    heading = ROW * (1.6 + len(reading))
    height = sum(heights) + GAP * (len(pairs) + 1) + heading + 0.5 * GAP
    if ax is None:
        _, ax = plt.subplots(figsize=(width, height), layout="none")
        ax.set_position((0, 0, 1, 1))
        scale = 1.0
    else:
        box = ax.get_window_extent().transformed(ax.figure.dpi_scale_trans.inverted())
        scale = min(box.width / width, box.height / height)
    ax.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    ax.axis("off")
    canvas = _Canvas(ax, scale)
    canvas.text(GAP, height - GAP - 0.3 * ROW, _label(title(program)), INK, weight="bold", size=1.3)
    for number, line in enumerate(reading):
        canvas.text(GAP, height - GAP - ROW * (1.6 + number), line, QUIET, size=0.9)
    y = height - 1.5 * GAP - heading
    above: tuple[float, float] | None = None
    for (condition, leaf), row_height in zip(pairs, heights, strict=True):
        middle = y - row_height / 2
        canvas.card(leaf, GAP + left + arrow, middle, LEAF_FILL, LEAF_EDGE, width=right)
        above = canvas.connect(condition, above, left, arrow, middle)
        y -= row_height + GAP
    return ax


def _how_to_read(program: ProgramData, whole: bool) -> tuple[str, ...]:
    """Two lines for a reader who has never seen a program."""
    what = {
        "discrete": "The score of each action: the highest wins.",
        "multi_discrete": "The score of each choice: in each part of the action the highest wins.",
        "multi_binary": "The score of each switch: above 0 it is on.",
        "box": "The numbers of the action, clipped to their bounds.",
    }[program.action.kind]
    order = "Read from top to bottom: the first condition that holds decides. " if program.conditions else ""
    return (
        f"{order}{what}",
        "Constant first, then the terms, the largest before the others: green raises the value, red lowers it"
        + ("." if whole else ", … counts those left out."),
    )


class _PlotPrinter(ProgramVisitor[list[tuple["_Card | None", _Card]]]):
    """Turns every step of the program into a condition card (none for the last) and a controller card."""

    def __init__(self, program: ProgramData, decimals: int, max_terms: MaxTerms, max_outputs: int) -> None:
        super().__init__(program)
        self.number, self.max_outputs = Decimals(decimals), max_outputs
        self.max_terms, self.blocks = terms_to_show(program, max_terms), blocks_of(program)
        self.tables = Tables()

    def visit_branch(self, branch: IfThenElse, index: int) -> list[tuple[_Card | None, _Card]]:
        pair = (self._condition(branch.condition, index), self._leaf(branch.then))
        return [pair, *self.visit(branch.orelse, index + 1)]

    def visit_controller(self, controller: Controller, index: int) -> list[tuple[_Card | None, _Card]]:
        return [(None, self._leaf(controller))]

    def _condition(self, condition: Condition, index: int) -> _Card:
        inputs = self.program.input_names
        if is_switch(condition):
            return self._switch(condition, index)
        if condition.cell == "min":
            sums = [self._terms(constant, *self._collapsed(weights)) for constant, weights in condition.sums]
            least = ((f"B{index + 1} is the least of", QUIET, 0),)
            rows = (least, *(_in_a_row(*one) for one in sums))
            return _Card((_head(index), *rows, *self._new_tables(), (("no memory", QUIET, 0),)))
        if condition.cell == "affine":
            readout, names = self._collapsed(condition.readout)
            constant, terms = self._terms(condition.readout_bias, readout, names)
            lines = ["no memory"]
        else:
            units = [f"h{unit + 1}" for unit in range(condition.hidden_size)]
            constant, terms = self._terms(condition.readout_bias, condition.readout, units)
            heard = largest_terms(input_importance(condition), inputs, 9, self.max_terms)
            lines = [f"memory h: {counted(condition.hidden_size, f'{CELL_NAMES[condition.cell]} unit')}"]
            lines += ["listens most to", *(f"  {_label(name)}" for _, name in heard.shown)] if heard.shown else []
        formula = _in_a_row(f"B{index + 1} = {constant}", terms)
        return _Card((_head(index), formula, *self._new_tables(), *(((line, QUIET, 0),) for line in lines)))

    def _switch(self, condition: Condition, index: int) -> _Card:
        while_on, while_off = condition.readout_bias + condition.readout[0], condition.readout_bias
        values = f"B{index + 1} = {self.number(while_on)} while on, {self.number(while_off)} while off"
        rows: list[tuple[tuple[str, str, int], ...]] = []
        for name, (constant, weights) in switch_sums(condition):
            if often := always_or_never(constant, weights):
                rows.append(((f"{name} {often}", INK, 0),))
                continue
            shown, terms = self._terms(constant, *self._collapsed(weights))
            rows.append(_in_a_row(f"{name + ' when':<8} {shown}", [*terms, ("≥ 0", INK)]))
        return _Card((_head(index), ((values.replace("-", MINUS), QUIET, 0),), *rows, *self._new_tables()))

    def _leaf(self, controller: Controller) -> _Card:
        names = [_label(name) for name in self.program.output_names]
        shown = min(len(names), self.max_outputs)
        sums = [self._terms(controller.bias[row], *self._collapsed(controller.weights[row])) for row in range(shown)]
        columns = [max(len(name) for name in names[:shown]) + 2]
        columns.append(columns[0] + max(len(constant) for constant, _ in sums) + 2)
        for column in range(max(len(terms) for _, terms in sums)):
            widest = max(len(terms[column][0]) for _, terms in sums if len(terms) > column)
            columns.append(columns[-1] + widest + 2)
        rows = []
        for name, (constant, terms) in zip(names[:shown], sums, strict=True):
            texts = [(name, INK, 0), (constant.rjust(columns[1] - columns[0] - 2), QUIET, columns[0])]
            rows.append((*texts, *((text, colour, columns[k + 1]) for k, (text, colour) in enumerate(terms))))
        if shown < len(names):
            rows.append(((f"... and {len(names) - shown} more outputs", QUIET, 0),))
        return _Card((*rows, *self._new_tables()))

    def _collapsed(self, weights: Sequence[float]) -> tuple[list[float], list[str]]:
        return collapse(self.blocks, weights, self.program.input_names, self.tables)

    def _new_tables(self) -> list[tuple[tuple[str, str, int], ...]]:
        return [((line.replace("-", MINUS), QUIET, 0),) for line in self.tables.new_lines()]

    def _terms(
        self, constant: float, weights: Sequence[float], names: Sequence[str]
    ) -> tuple[str, list[tuple[str, str]]]:
        terms = largest_terms(weights, names, self.number.digits, self.max_terms, beginnings(self.blocks))
        shown = [
            (
                f"{MINUS if weight < 0 else '+'}{self.number.factor(weight, ' ')}{_label(name)}",
                RAISES if weight > 0 else LOWERS,
            )
            for weight, name in terms.shown
        ]
        left_out = [(f"… {terms.n_dropped}", QUIET)] if terms.n_dropped else []
        return self.number(constant).replace("-", MINUS), [*shown, *left_out]


def _head(index: int) -> tuple[tuple[str, str, int], ...]:
    return ((f"{'if' if not index else 'else if'} B{index + 1} ≥ 0", INK, 0),)


def _in_a_row(start: str, terms: Sequence[tuple[str, str]]) -> tuple[tuple[str, str, int], ...]:
    """A row of a card: texts one after the other."""
    row = [(start, INK, 0)]
    for text, colour in terms:
        row.append((text, colour, row[-1][2] + len(row[-1][0]) + 1))
    return tuple(row)


def _label(name: str) -> str:
    name = name.replace("->", "→")
    return name if len(name) <= MAX_NAME else name[: MAX_NAME - 1] + "…"


class _Canvas:
    """Draws cards and arrows in inches on axes that may be scaled."""

    def __init__(self, ax: Any, scale: float) -> None:
        self.ax, self.scale = ax, scale

    def text(
        self, x: float, y: float, text: str, colour: str, weight: str = "normal", size: float = 1.0, **options: Any
    ) -> None:
        # Names are data: a dollar sign in one starts no formula, and TeX is never given one to run.
        options = {"va": "center", "family": "DejaVu Sans Mono", "parse_math": False, "usetex": False, **options}
        self.ax.text(x, y, text, color=colour, weight=weight, size=FONT_SIZE * size * self.scale, **options)

    def card(self, card: _Card, x: float, middle: float, fill: str, edge: str, width: float | None = None) -> None:
        from matplotlib.patches import FancyBboxPatch

        corner = (x, middle - card.height / 2)
        style = "round,pad=0,rounding_size=0.08"
        self.ax.add_patch(
            FancyBboxPatch(
                corner,
                width or card.width,
                card.height,
                boxstyle=style,
                facecolor=fill,
                edgecolor=edge,
                lw=1.1 * self.scale,
            )
        )
        for number, row in enumerate(card.rows):
            y = middle + card.height / 2 - PAD - ROW * (number + 0.5)
            for column_number, (text, colour, column) in enumerate(row):
                head = column_number == 0 and (colour == INK)
                self.text(x + PAD + CHARACTER * column, y, text, colour, weight="bold" if head else "normal")

    def connect(
        self, condition: _Card | None, above: tuple[float, float] | None, left: float, arrow: float, middle: float
    ) -> tuple[float, float] | None:
        """Draw a condition with the arrows into and out of it; return where its "no" arrow starts."""
        trunk = GAP + left / 2
        leaf = GAP + left + arrow
        if condition is None:
            if above is not None:
                self._arrow([above, (trunk, middle), (leaf, middle)])
                self.text(trunk + 0.12, above[1] - GAP / 2, "no", QUIET)
                self.text(leaf - arrow / 2 - 0.06, middle + 0.11, "else", QUIET, ha="center")
            return None
        if above is not None:
            self._arrow([above, (trunk, middle + condition.height / 2)])
            self.text(trunk + 0.12, above[1] - GAP / 2, "no", QUIET)
        self.card(condition, GAP, middle, CONDITION_FILL, CONDITION_EDGE, width=left)
        right = GAP + left
        self._arrow([(right, middle), (leaf, middle)])
        self.text((right + leaf) / 2 - 0.06, middle + 0.11, "yes", QUIET, ha="center")
        return trunk, middle - condition.height / 2

    def _arrow(self, points: Sequence[tuple[float, float]]) -> None:
        xs, ys = zip(*points, strict=True)
        self.ax.plot(xs[:-1], ys[:-1], color=LINE, lw=1.6 * self.scale, solid_capstyle="round", zorder=0)
        self.ax.annotate(
            "",
            points[-1],
            points[-2],
            zorder=0,
            arrowprops={"arrowstyle": "-|>", "color": LINE, "lw": 1.6 * self.scale, "shrinkA": 0, "shrinkB": 0},
        )
