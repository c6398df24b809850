"""The grammar of figure 1 as data, and the complete programs that a derivation graph of a given depth holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Symbol = Literal["E", "B", "C"]


@dataclass(frozen=True)
class Production:
    """One rule of the grammar.

    :param symbol: the nonterminal that is rewritten
    :param form: its right-hand side, as printed in figure 1
    """

    symbol: Symbol
    form: str


#: Figure 1 of the paper.
GRAMMAR: tuple[Production, ...] = (
    Production("E", "C"),
    Production("E", "if B then C else E"),
    Production("B", "RNN(X) >= 0"),
    Production("C", "c + T·X"),
)


@dataclass(frozen=True)
class Derivation:
    """A complete program of a derivation graph: how often ``E`` was rewritten to a branch before ``E ::= C``.

    :param n_conditions: number of conditions, 0 or more
    """

    n_conditions: int

    def __str__(self) -> str:
        branches = (f"if B{k} then C{k}' else " for k in range(1, self.n_conditions + 1))
        return "".join(branches) + f"C{self.n_conditions + 1}"


def derivations(depth: int) -> tuple[Derivation, ...]:
    """Return the complete programs of a derivation graph, the shortest first.

    Layer k of the graph chooses between the controller ``C_k`` and ``if B_k then C'_k else E_{k+1}``; the last layer
    is a controller. There are as many programs as layers, and they share conditions and then-controllers.

    :param depth: number of layers, at least 1
    :raises ValueError: if ``depth`` is below 1
    """
    if depth < 1:
        raise ValueError(f"depth={depth} is not accepted; a derivation graph has at least 1 layer")
    return tuple(Derivation(n_conditions) for n_conditions in range(depth))
