"""How good a candidate is: its episodes on training variations, which the states of the training are not from."""

from __future__ import annotations

from sb3_progpolicy.imitation.rollouts import Act, Episodes, Pool, Variations, play
from sb3_progpolicy.imitation.stalls import Patience
from sb3_progpolicy.imitation.teachers import Teacher

#: Of the first episode; no episode of the training has a seed near it.
VALIDATION_SEED = 50_000_000
_FEW_OF, _HOPELESS = 3, 14.0  # of so many episodes one comes first; times the tolerance that these may be below
_BEFORE_SERIES = 7  # times the number of episodes: those of all other scores


class Judge:
    """Plays episodes with candidates.

    :param pool: environments to play in
    :param variations: to play on, in turn
    :param n_episodes: of each validation; the last ones have twice as many
    :param tolerance: share of the score within which another one is as good
    :param teacher: whose steps are the unit of steps
    """

    def __init__(self, pool: Pool, variations: Variations, n_episodes: int, tolerance: float, teacher: Teacher) -> None:
        self.pool, self.variations, self.n_episodes, self.tolerance = pool, variations, n_episodes, tolerance
        self.teacher_episodes = play(pool, variations, n_episodes, VALIDATION_SEED, None, teacher)
        #: Whether episodes are those of the last validations, which nothing was chosen by before.
        self.final = False
        #: What ends an episode that is lost; ``None`` if all run to their end.
        self.patience: Patience | None = Patience(len(pool), self.limit)
        #: Means of the episodes played last.
        self.last_result: dict[str, float] = {}

    @property
    def limit(self) -> int:
        """Steps after which an episode is ended: what takes far longer than the teacher's has failed."""
        if not len(self.teacher_episodes.successes):
            return self.pool.cap
        return min(self.pool.cap, int(2 * self.teacher_episodes.steps.max() + 50))

    def score(self, act: Act, needed: float | None = None, series: int = 0) -> float:
        """Return the score of episodes; of the first few alone, if these are far from what is needed.

        :param act: the candidate
        :param needed: a score to compare with
        :param series: number of a series of episodes of its own; 0 for those that the best lists are compared by
        """
        steps, seed = float(self.teacher_episodes.steps.mean()), VALIDATION_SEED
        n_episodes, n_first = self.n_episodes, -(-self.n_episodes // _FEW_OF)
        if series:
            seed += (_BEFORE_SERIES + series) * self.n_episodes
        elif self.final:
            seed, n_episodes = seed + self.n_episodes, 2 * self.n_episodes
        episodes = self._play(act, self.variations, n_episodes if needed is None else n_first, seed)
        if needed is not None and self.as_good(episodes.score(steps), needed, share=_HOPELESS):
            episodes = episodes.and_then(self._play(act, self.variations, n_episodes - n_first, seed + n_first))
        self.last_result = episodes.summary()
        return episodes.score(steps)

    def score_at_length(self, act: Act, variations: Variations = ()) -> float:
        """Return the score of four times as many episodes, which nothing else is chosen by.

        :param act: the candidate
        :param variations: to play on instead of those of this judge; steps are in the same unit
        """
        seed, n_episodes = VALIDATION_SEED + 3 * self.n_episodes, 4 * self.n_episodes
        played = self._play(act, variations or self.variations, n_episodes, seed)
        return played.score(float(self.teacher_episodes.steps.mean()))

    def _play(self, act: Act, variations: Variations, n_episodes: int, seed: int) -> Episodes:
        if self.patience is not None:
            # Other variations may take longer than those of which the teacher's steps are known.
            self.patience.limit = self.limit if variations is self.variations else self.pool.cap
        return play(self.pool, variations, n_episodes, seed, act, patience=self.patience)

    def as_good(self, reached: float, score: float, share: float = 1.0) -> bool:
        """Return whether a score is as good as another, within a share of the tolerance."""
        return reached >= score - share * self.tolerance * max(1.0, abs(score))
