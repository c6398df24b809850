"""The program as plain data: a tree of frozen dataclasses that knows nothing of torch, training or printing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from sb3_progpolicy.spaces import ActionSpec

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]
Cell = Literal["affine", "min", "rnn", "gru", "lstm", "switch"]
BoxSemantics = Literal["means", "branches"]
BOX_SEMANTICS: tuple[BoxSemantics, ...] = ("means", "branches")

#: Cells whose B is a function of X alone.
STATELESS: tuple[Cell, ...] = ("affine", "min")

#: Gates stacked in the rows of a recurrent cell's weights, in PyTorch's order.
GATES: dict[Cell, tuple[str, ...]] = {
    "affine": (),
    "min": (),
    "rnn": ("h",),
    "gru": ("r", "z", "n"),
    "lstm": ("i", "f", "g", "o"),
    "switch": ("on", "off"),
}


@dataclass(frozen=True)
class Controller:
    """The affine map ``C ::= c + T·X`` (figure 1 of the paper).

    :param weights: ``(n_outputs, n_inputs)``
    :param bias: ``(n_outputs,)``
    """

    weights: Matrix
    bias: Vector


@dataclass(frozen=True)
class Condition:
    """The test ``B ::= RNN(X) >= 0`` (figure 1): a recurrent cell with a state of its own and an affine readout.

    One step is ``h = cell(x, h)``, then ``B = readout · h + readout_bias``. Two cells have no state: for ``"affine"``,
    ``B = readout · x + readout_bias``; for ``"min"``, B is the least of the sums ``weight_ih · x + bias_ih``, so that
    it holds where each of them is not below 0. A unit of the cell ``"switch"`` is 1 from the step on in which its sum
    *on* is not below 0, and 0 from the step on in which *off* is not and *on* is; else it stays as it was. It is not
    trained by gradient but found (:func:`~sb3_progpolicy.simplify`) or written by hand.

    :param cell: ``"rnn"`` (tanh), ``"gru"``, ``"lstm"`` with PyTorch's equations, ``"switch"``, ``"affine"``, ``"min"``
    :param weight_ih: ``(n_gates * hidden_size, n_inputs)``, gates stacked in PyTorch's order; empty for ``"affine"``, a
        row for each sum of ``"min"``
    :param weight_hh: ``(n_gates * hidden_size, hidden_size)``; empty without a state
    :param bias_ih: ``(n_gates * hidden_size,)``, or one for each sum of ``"min"``
    :param bias_hh: ``(n_gates * hidden_size,)``
    :param readout: ``(hidden_size,)``, or ``(n_inputs,)`` for ``"affine"``; empty for ``"min"``
    :param readout_bias: one number; 0 for ``"min"``
    """

    cell: Cell
    weight_ih: Matrix
    weight_hh: Matrix
    bias_ih: Vector
    bias_hh: Vector
    readout: Vector
    readout_bias: float

    @property
    def hidden_size(self) -> int:
        """Number of hidden units; 0 for a condition without a state."""
        return 0 if self.cell == "affine" else len(self.readout)

    @property
    def remembers(self) -> bool:
        """Whether the condition has a state, so that B depends on earlier steps."""
        return self.cell not in STATELESS

    @property
    def rows(self) -> Matrix:
        """The weights of X in each sum, ``(n_sums, n_inputs)``: of B, of the sums of a min, or of a cell's gates."""
        return tuple(weights for _, weights in self.sums) or self.weight_ih

    @property
    def sums(self) -> tuple[tuple[float, Vector], ...]:
        """Constant and weights of each affine sum over X whose least one is B; none of a condition with a state."""
        if self.cell == "affine":
            return ((self.readout_bias, self.readout),)
        return tuple(zip(self.bias_ih, self.weight_ih, strict=True)) if self.cell == "min" else ()


@dataclass(frozen=True)
class IfThenElse:
    """The branch ``if B then C else E``."""

    condition: Condition
    then: Controller
    orelse: Expression


Expression = Controller | IfThenElse


@dataclass(frozen=True)
class ProgramData:
    """A whole program. :class:`~sb3_progpolicy.programs.Program` explains its fields, and prints and saves it."""

    body: Expression
    n_observations: int
    action: ActionSpec
    interaction: bool
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    temperature: float = 1.0
    metadata: Mapping[str, Any] = field(default_factory=dict)
    semantics: BoxSemantics = "means"

    @property
    def n_inputs(self) -> int:
        """Length of X."""
        return len(self.input_names)

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The conditions from the outermost inwards."""
        return tuple(branch.condition for branch in self._branches())

    @property
    def controllers(self) -> tuple[Controller, ...]:
        """The then-controllers from the outermost inwards, then the last else."""
        branches = tuple(self._branches())
        last = branches[-1].orelse if branches else self.body
        if isinstance(last, IfThenElse):
            raise TypeError("a program ends in a controller")
        return (*(branch.then for branch in branches), last)

    def _branches(self) -> Iterator[IfThenElse]:
        expression = self.body
        while isinstance(expression, IfThenElse):
            yield expression
            expression = expression.orelse


def inputs_read(program: ProgramData) -> set[int]:
    """Return the indices of the inputs that a program reads: those with a weight that is not zero."""
    rows = [row for controller in program.controllers for row in controller.weights]
    for condition in program.conditions:
        rows += condition.rows
    return {index for row in rows for index, weight in enumerate(row) if weight}
