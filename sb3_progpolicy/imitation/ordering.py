"""A decision list of given pieces, with conditions of few inputs: inserted one by one, each where it pays most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.imitation.conditions import fit_condition
from sb3_progpolicy.imitation.conjunctions import FEWEST, ConditionFitter, holds
from sb3_progpolicy.imitation.decision_list import Data, DecisionList, Floats, rest_losses

PRICE = 0.001  # of an input of a condition, in mean loss
_WORTH = 0.001  # mean loss that a branch has to take away beyond the price of its condition
_MATTERS = 1e-3  # a gain, as a share of the largest weight, below which a state does not matter
_CLOSER = 6  # insertions that are looked at with few inputs, the best of those with all inputs


@dataclass(frozen=True)
class Order:
    """Conditions, and which piece acts where each is the first to hold.

    :param conditions: ``(n_sums, width)`` each; one holds where none of its sums is below 0
    :param pieces: indices, one more than conditions; the last piece acts where none holds
    """

    conditions: tuple[Floats, ...]
    pieces: tuple[int, ...]

    def as_list(self, pieces: Floats) -> DecisionList:
        """Return the list that it stands for.

        :param pieces: ``(n_pieces, n_outputs, width)``
        """
        sums = np.concatenate([np.zeros((0, pieces.shape[2])), *self.conditions])
        owners = np.repeat(np.arange(len(self.conditions)), list(map(len, self.conditions)))
        return DecisionList(sums, pieces[list(self.pieces)], owners)

    def insert(self, position: int, condition: Floats, piece: int) -> Order:
        """Return the order with one more branch."""
        conditions, pieces = list(self.conditions), list(self.pieces)
        conditions.insert(position, condition)
        pieces.insert(position, piece)
        return Order(tuple(conditions), tuple(pieces))

    def without(self, branch: int) -> Order:
        """Return the order without a branch; without the last one, the last condition's piece is the else."""
        conditions, pieces = list(self.conditions), list(self.pieces)
        del conditions[min(branch, len(conditions) - 1)], pieces[branch]
        return Order(tuple(conditions), tuple(pieces))


class Ordering:
    """Puts pieces in an order.

    :param data: labelled states
    :param losses: of every piece in every state, ``(n, n_pieces)``; more than 1 counts as 1
    :param most: number of branches at most
    :param most_sums: of a condition at most
    """

    def __init__(self, data: Data, losses: Floats, most: int, most_sums: int = 1) -> None:
        self.inputs, self.losses, self.most = data.inputs, np.minimum(losses, 1.0), most
        self.fitter = ConditionFitter(PRICE, _WORTH, most_sums)
        self.shares = data.weights / data.weights.sum()

    def fit(self, start: Order | None = None) -> Order:
        """Return an order of small loss and few inputs.

        :param start: to go on with; by default the one piece of the least loss
        """
        alone = Order((), (int((self.shares @ self.losses).argmin()),))
        order = alone if start is None else self._swept(start)
        while len(order.pieces) < self.most:
            longer = self._with_one_more(order)
            if longer is None:
                break
            order = self._swept(longer, same_inputs=True)
        return self._shortened(self._swept(order))

    def cost(self, order: Order) -> float:
        """Return the mean loss and the price of the conditions."""
        return float(self.shares @ self._rest(order)[0]) + sum(map(self.fitter.price_of, order.conditions))

    def _holds(self, order: Order) -> NDArray[np.bool_]:
        columns = [holds(self.inputs, sums) for sums in order.conditions]
        return np.array(columns, dtype=bool).reshape(-1, len(self.inputs)).T

    def _rest(self, order: Order) -> list[Floats]:
        return rest_losses(self.losses[:, list(order.pieces)], self._holds(order))

    def _with_one_more(self, order: Order) -> Order | None:
        """Return the order with the branch of the largest gain, whatever piece and position, if there is one."""
        rest, holding = self._rest(order), self._holds(order)
        reached = [_none(holding[:, :position]) for position in range(len(order.pieces))]
        bounds = []  # of what each piece can gain at each position
        for position in range(len(order.pieces)):
            gains = self.shares[:, None] * (rest[position][:, None] - self.losses)
            most_gained = np.maximum(gains[reached[position]], 0).sum(axis=0)
            bounds += [(float(bound), position, piece) for piece, bound in enumerate(most_gained)]
        bounds.sort(key=lambda one: -one[0])
        candidates: list[tuple[float, int, int, Floats]] = []
        for bound, position, piece in bounds:
            least = candidates[_CLOSER - 1][0] if len(candidates) >= _CLOSER else 2 * _WORTH
            if bound < least:
                break
            gains = self.shares * (rest[position] - self.losses[:, piece])
            here = self._matters(gains, reached[position])
            condition, gain = fit_condition(self.inputs[here], gains[here], ridges=(1e-3,), cautions=(1.0,))
            if condition is not None:
                candidates.append((gain, position, piece, condition))
                candidates.sort(key=lambda candidate: -candidate[0])
        best, most = None, _WORTH
        for _, position, piece, condition in candidates[:_CLOSER]:
            gains = self.shares * (rest[position] - self.losses[:, piece])
            here = self._matters(gains, reached[position])
            sums, gain = self.fitter.first(self.inputs[here], gains[here], condition)
            if sums is not None and gain > most:
                best, most = order.insert(position, sums, piece), gain
        return best

    def _swept(self, order: Order, same_inputs: bool = False) -> Order:
        """Return the order with each condition fitted again, given all others, then the best piece for each branch.

        :param same_inputs: whether each condition keeps its inputs, which is far quicker
        """
        conditions = list(order.conditions)
        for index in reversed(range(len(conditions))):
            present = Order(tuple(conditions), order.pieces)
            gains = self.shares * (self._rest(present)[index + 1] - self.losses[:, order.pieces[index]])
            here = self._matters(gains, _none(self._holds(present)[:, :index]))
            if here.sum() >= FEWEST:
                conditions[index] = self.fitter.again(self.inputs[here], gains[here], conditions[index], same_inputs)
        order = Order(tuple(conditions), order.pieces)
        acting = np.column_stack([self._holds(order), np.ones(len(self.inputs), dtype=bool)]).argmax(axis=1)
        pieces = [
            int((self.shares[here] @ self.losses[here]).argmin()) if (here := acting == branch).any() else piece
            for branch, piece in enumerate(order.pieces)
        ]
        return Order(order.conditions, tuple(pieces))

    def _shortened(self, order: Order) -> Order:
        """Leave out branches that are not worth more than what each has to be."""
        cost = self.cost(order)
        while order.conditions:
            shorter = min((order.without(branch) for branch in range(len(order.pieces))), key=self.cost)
            if self.cost(shorter) > cost + _WORTH:
                break
            order, cost = shorter, min(cost, self.cost(shorter))
        return order

    def _matters(self, gains: Floats, reached: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.asarray(reached & (np.abs(gains) > _MATTERS * self.shares.max()))


def _none(holds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return in which states none of some conditions holds."""
    return np.asarray(~holds.any(axis=1))
