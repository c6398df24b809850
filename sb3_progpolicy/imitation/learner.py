"""The student: all labelled states so far, and the list fitted to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.imitation.actions import ActionCodec
from sb3_progpolicy.imitation.decision_list import Data, DecisionList, Floats, Scaler
from sb3_progpolicy.imitation.fitting import alternate, fit_planes, grow, sparsify
from sb3_progpolicy.imitation.losses import BoxLoss, mean_loss
from sb3_progpolicy.imitation.ordering import Order, Ordering
from sb3_progpolicy.imitation.pieces import PieceFinder, PieceLoss
from sb3_progpolicy.imitation.tuning import fine_tune

_FEW, _MANY = 6_000, 15_000  # states for a fit from nothing, and for one that only improves
_REFIT_EVERY = 3  # rounds
_COMPETES = 1.3  # a list whose loss is so many times the least has its episodes looked at, too
_ORDERED = 10_000  # states that plain lists are fitted to
_RESTARTS = 3  # of the fit by planes
_EXPLAINED = 0.7  # share of the states that pieces have to explain, or the teacher is not made of them
_PRUNED = 3  # branches that are taken out of a plain list, so that others may come
_LOSES = 60.0  # weight of a state in which a student loses an episode, or gets nowhere, for plain lists
_LOSING_SHARE = 0.3  # of all weight that these states may have together: a bad list is in few others


@dataclass(frozen=True)
class Settings:
    """What a student may be.

    :param max_branches: number of controllers at most
    :param seed: of all draws
    :param round_steps: gradient steps in each round
    :param final_steps: gradient steps at the end
    :param max_sums: of a condition of a plain list at most
    """

    max_branches: int
    seed: int
    round_steps: int = 400
    final_steps: int = 1200
    max_sums: int = 1


class Learner:
    """The labelled states and the present list.

    :param codec: of the action space
    :param readable: which inputs may be read, ``(n_inputs,)``
    :param settings: what the list may be
    """

    def __init__(self, codec: ActionCodec, readable: NDArray[np.bool_], settings: Settings) -> None:
        self.loss = codec.loss()
        self.readable, self.settings = readable, settings
        self.rng = np.random.default_rng(settings.seed)
        self.observations = np.zeros((0, len(readable)), dtype=np.float32)
        self.targets = np.zeros((0, codec.spec.n_outputs))
        self.weights = np.zeros(0)
        #: The present list, on raw observations.
        self.raw: DecisionList | None = None

    @property
    def n_states(self) -> int:
        """Number of labelled states."""
        return len(self.observations)

    def add(self, observations: NDArray[np.float32], targets: Floats, weights: Floats) -> None:
        """Take in labelled states."""
        self.observations = np.concatenate([self.observations, observations])
        self.targets = np.concatenate([self.targets, targets])
        self.weights = np.concatenate([self.weights, weights])

    def fit(self, number: int) -> list[DecisionList]:
        """Fit to all states, going on from the present list and now and then from nothing.

        :param number: of the round
        :return: the new present list and those that are nearly as good, on raw observations
        """
        scaler, data = self._prepared()
        candidates, most = [], self.settings.max_branches
        if self.raw is not None:
            present = self._scaled(self.raw, scaler)
            if present.n_branches < most:
                present = grow(self.loss, self._some(data, _FEW), most, self.rng, present, tries=8)
            candidates.append(self._polished(present, data, 0.1))
        # Where plain lists are what is asked for, dense ones do nothing but visit states.
        if self.raw is None or (number % _REFIT_EVERY == 0 and self.settings.max_sums == 1):
            candidates += [self._polished(program, data, 0.3) for program in self._fresh(data, most)]
        return self._chosen(candidates, data, scaler)

    def finish(self) -> list[DecisionList]:
        """Fit the present list for longer; see :meth:`fit`."""
        assert self.raw is not None
        scaler, data = self._prepared()
        present = self._polished(self._scaled(self.raw, scaler), data, 0.1, self.settings.final_steps)
        return self._chosen([present], data, scaler)

    def short(self, n_branches: int) -> DecisionList:
        """Return a list of at most so many branches, fitted from nothing, on raw observations."""
        scaler, data = self._prepared()
        fresh = self._fresh(data, n_branches)
        polished = [self._polished(program, data, 0.3) for program in fresh]
        return _raw(min(polished, key=lambda program: mean_loss(self.loss, program, data)), scaler)

    def loss_of(self, raw: DecisionList) -> float:
        """Return the mean loss of a list in all labelled states.

        :param raw: on raw observations
        """
        scaler, data = self._prepared()
        return mean_loss(self.loss, self._scaled(raw, scaler), data)

    def sparse(self, raw: DecisionList, tolerance: float, always_few: bool) -> DecisionList:
        """Return a list with few inputs, fitted again with these alone.

        :param raw: on raw observations
        :param tolerance: see :func:`~sb3_progpolicy.imitation.fitting.sparsify`
        :param always_few: see there
        """
        scaler, data = self._prepared()
        sparse = sparsify(self.loss, self._scaled(raw, scaler), self._some(data, _MANY), tolerance, always_few)
        return self._refitted(sparse, data, scaler, self.settings.final_steps)

    def rare_branches(self, raw: DecisionList, share: float) -> list[int]:
        """Return the branches that act in fewer states than a share, the rarest first.

        :param raw: on raw observations
        :param share: of all labelled states
        """
        scaler, data = self._prepared()
        acting = self._scaled(raw, scaler).branches(data.inputs)
        shares = np.bincount(acting, minlength=raw.n_branches) / len(data)
        return [int(index) for index in np.argsort(shares, kind="stable") if shares[index] < share]

    def without(self, raw: DecisionList, index: int) -> DecisionList:
        """Return a list without a branch, its numbers that are not 0 fitted again.

        :param raw: on raw observations
        :param index: of the branch
        """
        scaler, data = self._prepared()
        return self._refitted(self._scaled(raw.without(index), scaler), data, scaler, self.settings.round_steps)

    def plain(self, known: Sequence[DecisionList], anew: bool) -> list[DecisionList]:
        """Return plain lists: pieces of what the teacher does, put in an order by conditions of few inputs.

        :param known: plain lists to go on with, on raw observations, the best first: that one as it is, and all without
            some of their branches, in whose places others may come; if there are none, one is made from nothing
        :param anew: whether pieces are looked for as if none was known, beside those of the best list
        :return: on raw observations; none if the teacher is not made of such pieces
        """
        if not isinstance(self.loss, BoxLoss):
            return []
        scaler, data = self._prepared()
        data = _drawn(replace(data, weights=self._losing_weighted()), _ORDERED, self.rng)
        loss = PieceLoss(self.loss.bounded, self.loss.direction)
        finder = PieceFinder(loss, data, self.rng)
        present = [self._scaled(one, scaler) for one in known]
        own = list(np.unique(present[0].controllers, axis=0)) if present else []
        pieces = finder.find([] if anew else own)
        if anew and own:
            pieces = np.concatenate([pieces, own])
        if finder.explained(pieces) < _EXPLAINED:
            return []
        ordering = Ordering(data, loss.matrix(data, pieces), self.settings.max_branches, self.settings.max_sums)
        starts = []
        for one in present:
            distances = np.abs(one.controllers[:, None] - pieces[None]).sum(axis=(2, 3))
            conditions = tuple(map(one.sums_of, range(one.n_branches - 1)))
            starts.append(Order(conditions, tuple(map(int, distances.argmin(axis=1)))))
        starts = [*starts[:1], *map(self._pruned, starts)]
        orders = [ordering.fit(start) for start in starts] or [ordering.fit()]
        return [_raw(order.as_list(pieces), scaler) for order in orders]

    def _losing_weighted(self) -> Floats:
        """Return weights: states in which a student loses count far more, but no more than a share of all."""
        losing = self.weights > 1
        others = float(self.weights[~losing].sum())
        most = _LOSING_SHARE / (1 - _LOSING_SHARE) * others / max(int(losing.sum()), 1)
        return np.where(losing, np.clip(most, 1.0, _LOSES), self.weights)

    def _pruned(self, order: Order) -> Order:
        """Return an order without some of its branches, drawn by chance."""
        for _ in range(min(_PRUNED, len(order.conditions))):
            order = order.without(int(self.rng.integers(len(order.pieces))))
        return order

    def refit_sparse(self) -> DecisionList:
        """Fit the numbers of the present list that are not 0 to all states, and return it."""
        assert self.raw is not None
        scaler, data = self._prepared()
        self.raw = self._refitted(self._scaled(self.raw, scaler), data, scaler, self.settings.final_steps)
        return self.raw

    def _refitted(self, program: DecisionList, data: Data, scaler: Scaler, n_steps: int) -> DecisionList:
        seed = int(self.rng.integers(2**31))
        tuned = fine_tune(self.loss, program, data, n_steps, seed, (0.1, 0.02), keep_zeros=True)
        better = mean_loss(self.loss, tuned, data) < mean_loss(self.loss, program, data)
        return _raw(tuned if better else program, scaler)

    def _prepared(self) -> tuple[Scaler, Data]:
        scaler = Scaler.of(self.observations, self.readable)
        return scaler, Data(scaler(self.observations), self.targets, self.weights)

    def _scaled(self, raw: DecisionList, scaler: Scaler) -> DecisionList:
        return replace(raw, conditions=scaler.from_raw(raw.conditions), controllers=scaler.from_raw(raw.controllers))

    def _some(self, data: Data, size: int) -> Data:
        if len(data) <= size:
            return data
        return data.take(self.rng.choice(len(data), size, replace=False))

    def _fresh(self, data: Data, most: int) -> list[DecisionList]:
        """Return a list of at most so many branches that was grown, and the best of some fits by planes."""
        few = self._some(data, _FEW)
        grown = grow(self.loss, few, most, self.rng)
        if most == 1:
            return [grown]
        planes = [
            fit_planes(self.loss, few, min(int(self.rng.integers(5, 8)), most), most, self.rng)
            for _ in range(_RESTARTS)
        ]
        return [grown, min(planes, key=lambda program: mean_loss(self.loss, program, few))]

    def _polished(self, program: DecisionList, data: Data, temperature: float, n_steps: int = 0) -> DecisionList:
        some = self._some(data, _MANY)
        program = alternate(self.loss, program, some, sweeps=2)
        seed, n_steps = int(self.rng.integers(2**31)), n_steps or self.settings.round_steps
        program = fine_tune(self.loss, program, data, n_steps, seed, (temperature, 0.03))
        return alternate(self.loss, program, some, sweeps=1)

    def _chosen(self, candidates: list[DecisionList], data: Data, scaler: Scaler) -> list[DecisionList]:
        losses = np.array([mean_loss(self.loss, candidate, data) for candidate in candidates])
        order = [int(index) for index in np.argsort(losses) if losses[index] <= _COMPETES * losses.min() + 1e-9]
        chosen = [_raw(candidates[index], scaler) for index in order]
        self.raw = chosen[0]
        return chosen


def _raw(program: DecisionList, scaler: Scaler) -> DecisionList:
    return replace(
        program, conditions=scaler.to_raw(program.conditions), controllers=scaler.to_raw(program.controllers)
    )


def _drawn(data: Data, size: int, rng: np.random.Generator) -> Data:
    """Return about so many states, each with a chance that grows with its weight, and the same sums on average."""
    if len(data) <= size:
        return data
    chances = np.zeros(len(data))
    for _ in range(5):  # those that are sure leave more for the others
        sure = chances >= 1
        left = max(size - int(sure.sum()), 1)
        chances = np.where(sure, 1.0, np.minimum(data.weights / data.weights[~sure].sum() * left, 1.0))
    chosen = np.flatnonzero(rng.random(len(data)) < chances)
    few = data.take(chosen)
    return replace(few, weights=few.weights / chances[chosen])
