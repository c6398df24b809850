"""What a teacher does, piece by piece: controllers of few inputs, each exact where the teacher does the same.

Scripted controllers are made of such pieces: "straight to the object, fingers open". A piece is found from a state and
its nearest neighbours, then fitted again to all states in which it is exact (as RANSAC does, Fischler and Bolles 1981).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sb3_progpolicy.imitation.decision_list import Data, Floats
from sb3_progpolicy.imitation.losses import DELTA, SATURATED, BoxLoss, eliminate, huber

EXACT = 0.02  # loss of a piece in a state in which it is what the teacher does
_WIDENING = (0.06, 0.03, EXACT, EXACT)  # losses up to which states belong to a piece that is being found
_NEIGHBOURS, _STATES = 80, 2_500
_INPUTS = (0, 1, 2, 3, 4)  # of an output
_BEYOND = 2  # so many more inputs than pay are tried
_PRICE = 0.002  # of an input, in the mean loss of its output
_SHARE = 0.001  # of the states that each input of a piece has to be worth
_FEWEST = 30  # states that a piece is fitted again to
_TRIES, _PROMISING = 16, 4  # states that a piece is looked for from; how many are then fitted to all states
_NEW = 4  # pieces that are looked for beyond those that are known, or are one too many in the end
_LEAST, _MOST = 0.003, 12  # share of the states that a piece adds; number of pieces
_UNEXPLAINED = 0.01  # share of the states that are left over


@dataclass(frozen=True)
class PieceLoss:
    """Huber's loss of what a controller gives once it is fitted into the bounds as the teacher does it.

    Outputs that are one vector are shortened together, which keeps its direction; others are clipped.

    :param bounded: which outputs have bounds, -1 and 1, ``(n_outputs,)``
    :param direction: outputs that are one vector; none if empty
    """

    bounded: np.ndarray
    direction: tuple[int, ...] = ()

    @property
    def _columns(self) -> list[int]:
        return list(self.direction)

    @property
    def _free(self) -> BoxLoss:
        """The loss of outputs before they are shortened."""
        bounded = self.bounded.copy()
        bounded[self._columns] = False
        return BoxLoss(bounded)

    def matrix(self, data: Data, controllers: Floats) -> Floats:
        """Return the loss of every controller in every state, ``(n, n_controllers)``."""
        n_controllers, n_outputs, width = controllers.shape
        outputs = (data.inputs @ controllers.reshape(-1, width).T).reshape(-1, n_controllers, n_outputs)
        vector = outputs[..., self._columns]
        if self.direction:
            outputs[..., self._columns] = vector / np.maximum(np.abs(vector).max(axis=-1, keepdims=True), 1.0)
        outputs = np.where(self.bounded, np.clip(outputs, -1, 1), outputs)
        return np.asarray(huber(np.abs(outputs - data.targets[:, None])).sum(axis=2))

    def lengthened(self, data: Data, controller: Floats) -> Data:
        """Return states with labels as they were before the teacher shortened them, if this is what it computes.

        :param data: labelled states
        :param controller: ``(n_outputs, n_inputs + 1)``
        """
        if not self.direction:
            return data
        vector = np.abs(data.inputs @ controller[self._columns].T).max(axis=1)
        shortened = (np.abs(data.targets[:, self._columns]) >= SATURATED).any(axis=1)
        factors = np.where(shortened, np.maximum(vector, 1.0), 1.0)
        targets = data.targets.copy()
        targets[:, self._columns] *= factors[:, None]
        return Data(data.inputs, targets, data.weights / factors**2)

    def fit(self, data: Data) -> Floats:
        """Return the controller nearest to the labels, ``(n_outputs, n_inputs + 1)``, with all inputs."""
        controller = BoxLoss(self.bounded, self.direction).fit(data, iterations=2, ridge=1e-3)
        for _ in range(4):
            controller = self._free.fit(self.lengthened(data, controller), controller, iterations=1, ridge=1e-3)
        return controller

    def fit_few(self, data: Data, controller: Floats, refit: bool = True) -> Floats:
        """Return the controller whose outputs each have the few inputs that are worth their price.

        :param data: labelled states
        :param controller: to begin with
        :param refit: whether it is fitted with all inputs first
        """
        data = self.lengthened(data, controller)
        full = self._free.fit(data, controller, iterations=2, ridge=1e-5) if refit else controller
        slack = np.ones_like(data.targets)
        few = np.zeros_like(full)
        for output, row in enumerate(full):
            weights = data.weights * np.maximum(self._free.reweighted(data, row, output, slack), 0.02)
            hessian = (data.inputs * weights[:, None]).T @ data.inputs / DELTA
            path = eliminate(hessian + 1e-5 * len(data) * np.eye(len(row)), row)
            least, most_paid = np.inf, 0
            for size in _INPUTS:
                if size > most_paid + _BEYOND:
                    break
                support = next(kept for kept, _ in path if kept.sum() <= size + 1)
                fitted = self._free.fit_support(data, output, support, slack)
                price = self._free.of_output(data, fitted, output, slack) + _PRICE * size
                if price < least:
                    few[output], least, most_paid = fitted, price, size
        return few


class PieceFinder:
    """Finds the pieces of labelled states.

    :param loss: of pieces
    :param data: labelled states
    :param rng: source of the draws
    """

    def __init__(self, loss: PieceLoss, data: Data, rng: np.random.Generator) -> None:
        self.loss, self.data, self.rng = loss, data, rng
        self.shares = data.weights / data.weights.sum()
        self._places = np.column_stack([data.inputs[:, :-1], 3.0 * data.targets])

    def find(self, known: Sequence[Floats] = ()) -> Floats:
        """Return pieces ``(n_pieces, n_outputs, n_inputs + 1)`` that explain nearly all states, each needed for some.

        :param known: pieces to begin with; then at most four others are looked for
        """
        pieces, unexplained = [], np.ones(len(self.data), dtype=bool)
        for piece in known:
            pieces.append(self._widened(piece, _WIDENING[1:3]))
            unexplained &= ~self._exact(pieces[-1])
        limit = (len(pieces) or _MOST) + _NEW
        while len(pieces) < limit and unexplained.mean() >= _UNEXPLAINED:
            best, most = None, _LEAST
            states = self.rng.choice(np.flatnonzero(unexplained), _TRIES)
            first = [self._around(int(state), trimmed=index % 2 == 1) for index, state in enumerate(states)]
            nearly = self.loss.matrix(self.data, np.array(first))[unexplained] < _WIDENING[0]
            for index in np.argsort(-(self.shares[unexplained] @ nearly))[:_PROMISING]:
                piece = self._widened(first[index], _WIDENING)
                exact = self._exact(piece)
                gain = float(self.shares[exact & unexplained].sum()) - _price(piece)
                if gain > most:
                    best, most = (piece, exact), gain
            if best is None:
                break
            pieces.append(best[0])
            unexplained &= ~best[1]
        return self._needed(np.array(pieces).reshape(-1, self.data.targets.shape[1], self.data.inputs.shape[1]))

    def explained(self, pieces: Floats) -> float:
        """Return the share of the states in which one of the pieces is exact."""
        if not len(pieces):
            return 0.0
        return float(self.shares[(self.loss.matrix(self.data, pieces) < EXACT).any(axis=1)].sum())

    def _exact(self, piece: Floats) -> np.ndarray:
        return np.asarray(self.loss.matrix(self.data, piece[None])[:, 0] < EXACT)

    def _around(self, state: int, trimmed: bool) -> Floats:
        """Return the piece that explains a state and its neighbours, fitted to these alone.

        :param state: index
        :param trimmed: whether only the half of the neighbours that fits best is kept, since others may be of another
            piece; the fewer that are left say less
        """
        distances = ((self._places - self._places[state]) ** 2).sum(axis=1)
        size = min(_NEIGHBOURS, len(distances))
        near = self.data.take(np.argpartition(distances, size - 1)[:size])
        if trimmed:
            losses = self.loss.matrix(near, self.loss.fit(near)[None])[:, 0]
            near = near.take(losses <= np.median(losses))
        return self.loss.fit_few(near, self.loss.fit(near), refit=False)

    def _widened(self, piece: Floats, limits: Sequence[float]) -> Floats:
        """Return the piece fitted to all states in which it is exact, or nearly so at first."""
        for limit in limits:
            rows = np.flatnonzero(self.loss.matrix(self.data, piece[None])[:, 0] < limit)
            if len(rows) < _FEWEST:
                return piece
            if len(rows) > _STATES:
                rows = self.rng.choice(rows, _STATES, replace=False)
            piece = self.loss.fit_few(self.data.take(rows), piece)
        return piece

    def _needed(self, pieces: Floats) -> Floats:
        """Leave out pieces whose states others explain, too, the least needed first, and those beyond the most."""
        if not len(pieces):
            return pieces
        exact = self.loss.matrix(self.data, pieces) < EXACT
        kept = list(range(len(pieces)))
        while len(kept) > 1:
            explained = self.shares @ exact[:, kept].any(axis=1)
            costs = [
                explained
                - self.shares @ exact[:, [other for other in kept if other != one]].any(axis=1)
                - 0.5 * _price(pieces[one])
                for one in kept
            ]
            if min(costs) > _LEAST and len(kept) <= _MOST:
                break
            kept.pop(int(np.argmin(costs)))
        return pieces[kept]


def _price(piece: Floats) -> float:
    """Return the share of the states that the inputs of a piece have to be worth."""
    return _SHARE * float(np.count_nonzero(piece[:, :-1]))
