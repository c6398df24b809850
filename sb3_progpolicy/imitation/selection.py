"""Which list to go on with: the one of the best episodes, then the smallest whose episodes are as good."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sb3_progpolicy.imitation.actions import ActionCodec
from sb3_progpolicy.imitation.augmentation import Augment
from sb3_progpolicy.imitation.candidates import Plain, Scored, n_numbers
from sb3_progpolicy.imitation.decision_list import DecisionList
from sb3_progpolicy.imitation.judge import Judge, within
from sb3_progpolicy.imitation.learner import Learner
from sb3_progpolicy.imitation.rollouts import Variations
from sb3_progpolicy.imitation.visits import Witness

# Of the mean loss, and whether few inputs matter more; the sparsest program first.
_TOLERANCES = ((0.012, True), (0.004, True), (0.003, False), (0.001, False))
_FINALISTS = 3
_RARE, _DROPS = 0.03, 5  # share of the states in which a rare branch acts; how many are tried without
_NEAR, _LOSS = 1.3, 0.01  # a list whose loss is so many times the best one's, and more, is not looked at
_AGAIN = 2  # of the best plain lists play new episodes in each round, and have lists made of them
_TRIES = 3  # rounds in which pieces are looked for, if none explain the states
_SHORT = (1, 2, 4, 7)  # numbers of branches that are tried at the end, the first that suffices is taken


class Selection:
    """The best list so far, and the search for a smaller one that is as good.

    :param learner: fits lists to the labelled states
    :param judge: plays episodes on training variations
    :param beyond: the domain's validation variations, by which a plain list is taken or not; none if empty
    :param codec: of the actions
    :param augment: makes changed copies of states, which are labelled although no episode comes to them
    :param plain_tolerance: share of the score that a plain list may cost
    """

    def __init__(
        self,
        learner: Learner,
        judge: Judge,
        beyond: Variations,
        codec: ActionCodec,
        augment: Augment | None,
        plain_tolerance: float,
    ) -> None:
        self.learner, self.judge, self.beyond, self.codec = learner, judge, beyond, codec
        self.augment, self.plain_tolerance = augment, plain_tolerance
        self.best: Scored | None = None
        self.runners_up: list[Scored] = []
        #: Value of the best list of all, before it was made smaller: what smaller ones are held to.
        self.reference = -np.inf
        self.result: Mapping[str, float] = {}
        #: The best plain lists.
        self.plain: list[Plain] = []
        #: Whether a plain list was taken over.
        self.is_plain = False
        self._witness: Witness | None = None  # of what the plain lists saw in the present round

    def offer(self, candidate: DecisionList, sparse: bool = False) -> None:
        """Keep a candidate if its episodes are better than the best so far.

        :param candidate: on raw observations
        :param sparse: whether it need only be as good as the best list was before it was made smaller
        """
        offered = self.score(candidate), candidate
        ranked = sorted([*self.runners_up, offered], key=self._value, reverse=True)
        self.runners_up = ranked[:_FINALISTS]
        value, least = self._value(offered), -np.inf if self.best is None else self._value(self.best)
        if value >= least or (sparse and self.judge.as_good(value, self.reference)):
            self.best, self.result = offered, self.judge.last_result

    def choose_finally(self) -> None:
        """Let the best few play more episodes, which none of them was chosen by."""
        self.judge.final = True
        self.best = None
        for _, candidate in list(self.runners_up):
            self.offer(candidate)
        assert self.best is not None
        self.learner.raw, self.reference = self.best[1], self._value(self.best)

    def make_short(self) -> None:
        """Go on with the shortest of some lists of few branches whose episodes are as good as the best ones.

        Each is fitted from nothing, so that a shorter one may do where a longer one does not.
        """
        assert self.best is not None
        most = self.best[1].n_branches
        for n_branches in (number for number in _SHORT if number < most):
            if self._take_over(self.learner.short(n_branches)) is None:
                return

    def make_plain(self, series: int) -> None:
        """Keep the plain lists of the best episodes.

        :param series: number of these episodes, which are others each time: what is best of many on the same ones would
            soon be best there alone
        """
        if series > _TRIES and not self.plain:
            return
        candidates = self.learner.plain([plain.candidate for plain in self.plain[:_AGAIN]], anew=series % 2 == 0)
        if not candidates:
            return
        self._witness = witness = Witness(self.judge.pool.envs[0].action_space)
        kept: list[Plain] = []
        found: list[Plain] = []
        for plain in [*self.plain[:_AGAIN], *(Plain(candidate, ()) for candidate in candidates)]:
            best = max((one.last for one in (*kept, *found)), default=None)
            score = self.judge.score(self.codec.act_of(plain.candidate), best, series, witness)
            (kept if plain.scores else found).append(plain.and_then(score, self.judge.last_lost))
            if self.best is None and (best is None or score >= best):
                self.result = self.judge.last_result
        # Of equal ones the later: it has seen more.
        self.plain = sorted([*reversed(found), *kept, *self.plain[_AGAIN:]], key=Plain.value, reverse=True)[:_FINALISTS]
        self.learner.raw = max([*found, *kept], key=Plain.value).candidate

    def label_seen(self, n_states: int) -> None:
        """Label states of the episodes that the plain lists have just played, if there are any.

        :param n_states: to label
        """
        if self._witness is None:
            return
        visits = self._witness.visits(n_states, self.learner.rng)
        visits = visits.with_changed(self.augment, self.judge.teacher, self.judge.pool, self.learner.rng)
        self.learner.add(visits.inputs, self.codec.encode(visits.actions), visits.weights)
        self._witness = None

    def choose_plain(self) -> None:
        """Go on with the smallest of the best plain lists if its episodes are nearly as good as those of the best list.

        Episodes beyond training count as much as those of training.
        """
        if not self.plain:
            return
        self.judge.final = True
        candidates = [plain.candidate for plain in self.plain]
        parts: list[list[float]] = []
        for candidate in candidates:
            parts.append(self._merits(candidate, max(parts, key=np.mean, default=[])))
        merits = [float(np.mean(part)) for part in parts]
        as_good = [index for index, merit in enumerate(merits) if self.judge.as_good(merit, max(merits), share=0.5)]
        index = min(as_good, key=lambda one: n_numbers(candidates[one]))
        chosen = candidates[index]
        if self.best is None or self._costs_little(chosen, merits[index], max(parts, key=np.mean)):
            self.best, self.is_plain = (self.score(chosen), chosen), True
            self.learner.raw, self.reference = self.best[1], self.best[0]
            self.result = self.judge.last_result
        else:
            self.plain = [replace(plain, refused=True) for plain in self.plain]

    def _costs_little(self, chosen: DecisionList, merit: float, needed: Sequence[float]) -> bool:
        """Return whether a plain list of a merit is nearly as good as the best list."""
        assert self.best is not None
        dense = float(np.mean(self._merits(self.best[1], needed)))
        loss = self.learner.loss_of if self.augment is not None else lambda _: 0.0
        return within(merit - loss(chosen), dense - loss(self.best[1]), self.plain_tolerance)

    @property
    def is_sure(self) -> bool:
        """Whether one of the best plain lists has lost no episode of many, and was not compared in vain before."""
        return any(plain.is_sure for plain in self.plain)

    def make_sparse(self) -> None:
        """Go on with the program of fewest inputs whose episodes are as good as the best ones.

        If there is none, the rounds that follow are those of the best one of few inputs, whose mistakes they visit.
        """
        assert self.best is not None
        dense, few = self.best[1], []
        for tolerance, always_few in _TOLERANCES:
            sparse = self.learner.sparse(dense, tolerance, always_few)
            reached = self._take_over(sparse)
            if reached is None:
                return
            if always_few:
                few.append((reached, sparse))
        self.learner.raw = max(few, key=lambda scored: scored[0])[1]

    def drop_rare_branches(self) -> None:
        """Leave out branches that hardly ever act, one after another, as long as the episodes stay as good."""
        assert self.best is not None
        tries = 0
        while self.best[1].n_branches > 1:
            for index in self.learner.rare_branches(self.best[1], _RARE):
                if tries == _DROPS:
                    return
                tries += 1
                if self._take_over(self.learner.without(self.best[1], index)) is None:
                    break
            else:
                return

    def score(self, raw: DecisionList, needed: float | None = None) -> float:
        """Return the score of a list's episodes; see :meth:`~sb3_progpolicy.imitation.judge.Judge.score`."""
        return self.judge.score(self.codec.act_of(raw), needed)

    def _merits(self, candidate: DecisionList, needed: Sequence[float]) -> list[float]:
        """Return the scores of many episodes on training and, where there are these, on validation variations.

        :param candidate: on raw observations
        :param needed: scores to compare with, if there are any; what is far below one of them plays fewer episodes
        """
        act = self.codec.act_of(candidate)
        places: list[Variations] = [(), self.beyond] if self.beyond else [()]
        wanted: Sequence[float | None] = needed or [None] * len(places)
        return [self.judge.score_at_length(act, place, least) for place, least in zip(places, wanted, strict=True)]

    def _take_over(self, candidate: DecisionList) -> float | None:
        """Go on with a smaller list if its loss is not far from the best one's and its episodes are as good.

        :return: ``None``, or, if it is not so, its value
        """
        assert self.best is not None
        if self.learner.loss_of(candidate) > _NEAR * self.learner.loss_of(self.best[1]) + _LOSS:
            return -np.inf
        reached = self.score(candidate, self.best[0])
        value = self._value((reached, candidate))
        if not self.judge.as_good(value, self.reference):
            return value
        self.best, self.learner.raw, self.result = (reached, candidate), candidate, self.judge.last_result
        return None

    def _value(self, scored: Scored) -> float:
        """Return the score less the loss where states were labelled that no episode comes to, else the score."""
        score, candidate = scored
        return score - self.learner.loss_of(candidate) if self.augment is not None else score
