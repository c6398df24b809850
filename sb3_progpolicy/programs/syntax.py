"""The program as plain data: a tree of frozen dataclasses that knows nothing of torch, training or printing."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]
Cell = Literal["affine", "rnn", "gru", "lstm"]

#: Gates stacked in the rows of a recurrent cell's weights, in PyTorch's order.
GATES: dict[Cell, tuple[str, ...]] = {
    "affine": (),
    "rnn": ("h",),
    "gru": ("r", "z", "n"),
    "lstm": ("i", "f", "g", "o"),
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

    One step is ``h = cell(x, h)``, then ``B = readout · h + readout_bias``. For the cell ``"affine"`` there is no
    state and ``B = readout · x + readout_bias``.

    :param cell: ``"rnn"`` (tanh), ``"gru"``, ``"lstm"`` with PyTorch's equations, or ``"affine"``
    :param weight_ih: ``(n_gates * hidden_size, n_inputs)``, gates stacked in PyTorch's order; empty for ``"affine"``
    :param weight_hh: ``(n_gates * hidden_size, hidden_size)``
    :param bias_ih: ``(n_gates * hidden_size,)``
    :param bias_hh: ``(n_gates * hidden_size,)``
    :param readout: ``(hidden_size,)``, or ``(n_inputs,)`` for ``"affine"``
    :param readout_bias: one number
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
        """Number of hidden units; 0 for an affine condition."""
        return 0 if self.cell == "affine" else len(self.readout)


@dataclass(frozen=True)
class IfThenElse:
    """The branch ``if B then C else E``."""

    condition: Condition
    then: Controller
    orelse: Expression


Expression = Controller | IfThenElse

ActionKind = Literal["discrete", "box", "multi_discrete", "multi_binary"]


@dataclass(frozen=True)
class ActionSpec:
    """The action space that a program acts in.

    :param kind: which Gymnasium space
    :param sizes: ``(n,)`` for Discrete, the ``nvec`` of a MultiDiscrete, ``(n,)`` for MultiBinary, the flat size of a
        Box; a controller has ``sum(sizes)`` outputs
    :param low: lower bounds of a Box, one per number; empty otherwise
    :param high: upper bounds of a Box; empty otherwise
    :param start: first action of a Discrete space
    """

    kind: ActionKind
    sizes: tuple[int, ...]
    low: Vector = ()
    high: Vector = ()
    start: int = 0

    @property
    def n_outputs(self) -> int:
        """Number of outputs of every controller."""
        return sum(self.sizes)

    @property
    def history_size(self) -> int:
        """Width of the previous action in the input: one-hot for discrete spaces, the numbers themselves otherwise."""
        return sum(self.sizes)


@dataclass(frozen=True)
class Program:
    """A whole program, ready to be read, exported, saved or run.

    The input vector X is the observation (``n_observations`` numbers) and, where ``interaction`` is set, the previous
    action (``action.history_size`` numbers), the previous reward and the previous done flag (section 2.4).

    :param body: the tree
    :param n_observations: length of the observation
    :param action: the action space
    :param interaction: whether X goes on with the previous action, reward and done flag
    :param input_names: one readable name per number of X
    :param output_names: one readable name per controller output
    :param temperature: temperature of the sigmoid in the soft semantics, above 0
    :param metadata: where the program comes from (environment id, seed, steps ...); JSON values only
    """

    body: Expression
    n_observations: int
    action: ActionSpec
    interaction: bool
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    temperature: float = 1.0
    metadata: Mapping[str, Any] = field(default_factory=dict)

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

    def __str__(self) -> str:
        """The program as :func:`~sb3_progpolicy.programs.export.export_text` prints it."""
        from sb3_progpolicy.programs.export import export_text

        return export_text(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the program to a JSON file, see :func:`~sb3_progpolicy.programs.io.save_program`."""
        from sb3_progpolicy.programs.io import save_program

        save_program(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Program:
        """Read a program from a JSON file, see :func:`~sb3_progpolicy.programs.io.load_program`."""
        from sb3_progpolicy.programs.io import load_program

        return load_program(path)

    def _branches(self) -> Iterator[IfThenElse]:
        expression = self.body
        while isinstance(expression, IfThenElse):
            yield expression
            expression = expression.orelse
