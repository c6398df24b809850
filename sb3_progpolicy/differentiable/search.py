"""W: which program of the derivation graph to keep (sections 2.2 and 2.3)."""

from __future__ import annotations

import torch as th
from torch import nn

SEARCHING = -1


class DerivationSearch(nn.Module):
    """The vector W: one binary choice per layer, between ``E ::= C`` and ``E ::= if B then C else E``.

    A softmax over each pair of logits gives the probability of a choice; both start at 50 %. The probability of a
    program is the product of its choices. After :meth:`select` one program has probability 1.

    :param depth: layers of the derivation graph; the last layer has no choice
    """

    def __init__(self, depth: int) -> None:
        super().__init__()
        self.logits = nn.Parameter(th.zeros(depth - 1, 2))
        self.selected: th.Tensor
        self.register_buffer("selected", th.tensor(SEARCHING))
        self._indices: th.Tensor
        self.register_buffer("_indices", th.arange(depth), persistent=False)

    @property
    def searching(self) -> bool:
        """Whether no program has been selected yet."""
        return bool(self.selected == SEARCHING)

    @property
    def needs_conditions(self) -> bool:
        """Whether any condition can matter: not once a program without conditions has been selected."""
        return bool(self.selected != 0)

    def select(self, n_conditions: int) -> None:
        """End the search: from now on only the program with ``n_conditions`` conditions is run.

        :param n_conditions: 0 to ``depth - 1``
        """
        self.selected.fill_(n_conditions)

    def most_likely(self) -> int:
        """Return the number of conditions of the selected program, or of the most likely one (line 10)."""
        return int(self.selected) if not self.searching else int(self.probabilities().argmax())

    def at_least(self) -> th.Tensor:
        """Return for k = 1 ... ``depth - 1`` the probability that a program has k conditions or more."""
        if not self.searching:
            return (self._indices[1:] <= self.selected).to(self.logits.dtype)
        return th.cumprod(self.logits.softmax(-1)[:, 1], dim=0)

    def probabilities(self) -> th.Tensor:
        """Return the probability of each program, ``(depth,)``, the shortest first."""
        at_least = th.cat((self.logits.new_ones(1), self.at_least()))
        return at_least - th.cat((at_least[1:], self.logits.new_zeros(1)))

    def expected_conditions(self) -> th.Tensor:
        """Return the expected number of conditions, the price to pay for long programs."""
        return self.at_least().sum()

    def entropy(self) -> th.Tensor:
        """Return the entropy of W in nats: 0 when it has decided, ``log(2)`` per layer at the start."""
        if not self.searching or not len(self.logits):
            return self.logits.new_zeros(())
        log_choice = self.logits.log_softmax(-1)
        return -(log_choice.exp() * log_choice).sum()
