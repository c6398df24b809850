"""Lists that compete, with what their episodes gave."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sb3_progpolicy.imitation.decision_list import DecisionList

Scored = tuple[float, DecisionList]
_SURE = 5  # series without a lost episode
_DOUBT = 0.05  # deviation of a score from the mean of many
_PRICE = 3e-4  # of a number of a plain list, in its score


@dataclass(frozen=True)
class Plain:
    """A plain list with its scores in series of episodes.

    :param candidate: on raw observations
    :param scores: of each series that it has played, the last one last
    :param n_lost: episodes that it lost in them all
    :param refused: whether it was compared with the best list in vain
    """

    candidate: DecisionList
    scores: tuple[float, ...]
    n_lost: int = 0
    refused: bool = False

    @property
    def last(self) -> float:
        """The score in the last series."""
        return self.scores[-1]

    @property
    def is_sure(self) -> bool:
        """Whether it has lost no episode of many, and is worth a comparison."""
        return len(self.scores) >= _SURE and not self.n_lost and not self.refused

    def and_then(self, score: float, n_lost: int) -> Plain:
        """Return the list with one more score."""
        return replace(self, scores=(*self.scores, score), n_lost=self.n_lost + n_lost)

    def value(self) -> float:
        """Return the mean score, less a deviation of it, and the price of the numbers."""
        doubt = _DOUBT * max(1.0, abs(self.last)) / np.sqrt(len(self.scores))
        return float(np.mean(self.scores) - doubt - _PRICE * n_numbers(self.candidate))


def n_numbers(raw: DecisionList) -> int:
    """Return how many numbers of a list are not 0."""
    return int(np.count_nonzero(raw.conditions) + np.count_nonzero(raw.controllers))
