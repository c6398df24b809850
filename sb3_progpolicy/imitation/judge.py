"""How good a candidate is: its episodes on training variations, which the states of the training are not from."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs import find_domain
from sb3_progpolicy.imitation.rollouts import VALIDATION_SEED, Act, Episodes, Pool, Variations, Watcher, play
from sb3_progpolicy.imitation.stalls import Patience
from sb3_progpolicy.imitation.teachers import Observations, Teacher

_DIGEST_STEPS = 50  # of the teacher, by which it is known again
_FEW_OF, _HOPELESS = 3, 14.0  # of so many episodes one comes first; times the tolerance that these may be below
_FEW, _MANY = 24, 96  # episodes of a validation; few where each step is a simulation
_BEFORE_SERIES = 7  # times the number of episodes: those of all other scores


class _Digest:
    """A digest of the actions in the first steps that are watched, to two digits."""

    def __init__(self) -> None:
        self._hash, self._n_steps = hashlib.sha256(), 0

    def see(self, rows: Sequence[int], inputs: Observations, actions: NDArray[Any], labels: NDArray[Any]) -> None:
        """See a step; see :class:`~sb3_progpolicy.imitation.rollouts.Watcher`."""
        if self._n_steps < _DIGEST_STEPS:
            self._hash.update((np.round(labels[list(rows)].astype(np.float64), 2) + 0.0).tobytes())
            self._n_steps += 1

    def ended(self, row: int, success: bool) -> None:
        """See the end of an episode; see :class:`~sb3_progpolicy.imitation.rollouts.Watcher`."""

    @property
    def hexadecimal(self) -> str:
        """The digest."""
        return self._hash.hexdigest()


class Judge:
    """Plays episodes with candidates.

    :param pool: environments to play in
    :param variations: to play on, in turn
    :param n_episodes: of each validation; the last ones have twice as many. ``None`` for 96, or 24 in a simulation
    :param tolerance: share of the score within which another one is as good
    :param teacher: whose steps are the unit of steps
    """

    def __init__(
        self, pool: Pool, variations: Variations, n_episodes: int | None, tolerance: float, teacher: Teacher
    ) -> None:
        self.pool, self.variations, self.tolerance = pool, variations, tolerance
        self.teacher = teacher
        digest = _Digest()
        domain = find_domain(getattr(pool.envs[0].spec, "id", None))
        self.n_episodes = n_episodes or (_FEW if domain is not None and domain.simulation else _MANY)
        self.teacher_episodes = play(pool, variations, self.n_episodes, VALIDATION_SEED, None, teacher, watcher=digest)
        #: Of what the teacher does in its first steps.
        self.teacher_digest = digest.hexadecimal
        #: Whether episodes are those of the last validations, which nothing was chosen by before.
        self.final = False
        #: What ends an episode that is lost; ``None`` if all run to their end.
        self.patience: Patience | None = Patience(len(pool), self.limit)
        #: Means of the episodes played last.
        self.last_result: dict[str, float] = {}
        #: How many of them did not reach their goal; where there is none, all.
        self.last_lost = 0

    @property
    def limit(self) -> int:
        """Steps after which an episode is ended: what takes far longer than the teacher's has failed."""
        if not len(self.teacher_episodes.successes):
            return self.pool.cap
        return min(self.pool.cap, int(2 * self.teacher_episodes.steps.max() + 50))

    def score(self, act: Act, needed: float | None = None, series: int = 0, watcher: Watcher | None = None) -> float:
        """Return the score of episodes; of the first few alone, if these are far from what is needed.

        :param act: the candidate
        :param needed: a score to compare with
        :param series: number of a series of episodes of its own; 0 for those that the best lists are compared by
        :param watcher: sees the episodes, with what the teacher would have done
        """
        seed, n_episodes = VALIDATION_SEED, self.n_episodes
        if series:
            seed += (_BEFORE_SERIES + series) * self.n_episodes
        elif self.final:
            seed, n_episodes = seed + self.n_episodes, 2 * self.n_episodes
        score, self.last_result = self._staged(act, self.variations, n_episodes, seed, needed, watcher)
        return score

    def _staged(
        self,
        act: Act,
        variations: Variations,
        n_episodes: int,
        seed: int,
        needed: float | None,
        watcher: Watcher | None = None,
    ) -> tuple[float, dict[str, float]]:
        """Return score and means of episodes, of a third of them if these are far below what is needed."""
        steps = float(self.teacher_episodes.steps.mean())
        n_first = n_episodes if needed is None else -(-n_episodes // _FEW_OF)
        episodes = self._play(act, variations, n_first, seed, watcher)
        if needed is not None and self.as_good(episodes.score(steps), needed, share=_HOPELESS):
            rest = self._play(act, variations, n_episodes - n_first, seed + n_first, watcher)
            episodes = episodes.and_then(rest)
        self.last_lost = len(episodes.returns) - int(episodes.successes.sum())
        return episodes.score(steps), episodes.summary()

    def score_at_length(self, act: Act, variations: Variations = (), needed: float | None = None) -> float:
        """Return the score of twice as many episodes, which nothing else is chosen by.

        :param act: the candidate
        :param variations: to play on instead of those of this judge; steps are in the same unit
        :param needed: a score to compare with; see :meth:`score`
        """
        seed, n_episodes = VALIDATION_SEED + 3 * self.n_episodes, 2 * self.n_episodes
        return self._staged(act, variations or self.variations, n_episodes, seed, needed)[0]

    def _play(
        self, act: Act, variations: Variations, n_episodes: int, seed: int, watcher: Watcher | None = None
    ) -> Episodes:
        if self.patience is not None:
            # Other variations may take longer than those of which the teacher's steps are known.
            self.patience.limit = self.limit if variations is self.variations else self.pool.cap
        teacher = None if watcher is None else self.teacher
        return play(self.pool, variations, n_episodes, seed, act, teacher, patience=self.patience, watcher=watcher)

    def as_good(self, reached: float, score: float, share: float = 1.0) -> bool:
        """Return whether a score is as good as another, within a share of the tolerance."""
        return within(reached, score, share * self.tolerance)


def within(reached: float, score: float, tolerance: float) -> bool:
    """Return whether a score is as good as another, within a share of it (of 1, if it is smaller)."""
    return reached >= score - tolerance * max(1.0, abs(score))
