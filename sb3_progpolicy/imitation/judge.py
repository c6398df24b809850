"""How good a candidate is: its episodes on training variations, which the states of the training are not from."""

from __future__ import annotations

from sb3_progpolicy.imitation.rollouts import Act, Pool, Variations, play
from sb3_progpolicy.imitation.teachers import Teacher

#: Of the first episode; no episode of the training has a seed near it.
VALIDATION_SEED = 50_000_000
_HOPELESS = 6.0  # times the tolerance below what is needed


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
        #: Means of the episodes played last.
        self.last_result: dict[str, float] = {}

    @property
    def limit(self) -> int:
        """Steps after which an episode is ended: what takes far longer than the teacher's has failed."""
        if not len(self.teacher_episodes.successes):
            return self.pool.cap
        return min(self.pool.cap, int(2 * self.teacher_episodes.steps.max() + 50))

    def score(self, act: Act, needed: float | None = None) -> float:
        """Return the score of episodes; in the last validations of half of them, if these are far from what is needed.

        :param act: the candidate
        :param needed: a score to compare with
        """
        steps, seed = float(self.teacher_episodes.steps.mean()), VALIDATION_SEED
        if self.final:
            seed += self.n_episodes
        episodes = play(self.pool, self.variations, self.n_episodes, seed, act)
        score = episodes.score(steps)
        if self.final and (needed is None or self.as_good(score, needed, share=_HOPELESS)):
            episodes = play(self.pool, self.variations, 2 * self.n_episodes, seed, act)
            score = episodes.score(steps)
        self.last_result = episodes.summary()
        return score

    def score_at_length(self, act: Act, variations: Variations = ()) -> float:
        """Return the score of four times as many episodes, which nothing else is chosen by.

        :param act: the candidate
        :param variations: to play on instead of those of this judge; steps are in the same unit
        """
        seed, n_episodes = VALIDATION_SEED + 3 * self.n_episodes, 4 * self.n_episodes
        played = play(self.pool, variations or self.variations, n_episodes, seed, act)
        return played.score(float(self.teacher_episodes.steps.mean()))

    def as_good(self, reached: float, score: float, share: float = 1.0) -> bool:
        """Return whether a score is as good as another, within a share of the tolerance."""
        return reached >= score - share * self.tolerance * max(1.0, abs(score))
