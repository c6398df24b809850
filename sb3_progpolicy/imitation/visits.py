"""States that are visited and labelled: by teacher and student in turns, or by candidates that are judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.imitation.augmentation import Augment
from sb3_progpolicy.imitation.rollouts import VALIDATION_SEED, Act, Pool, Variations
from sb3_progpolicy.imitation.stalls import VISITS, Stalls
from sb3_progpolicy.imitation.teachers import Observations, PlannerTeacher, Teacher

_SEGMENT = (5, 40)  # steps for which teacher or student act in turn
_RESCUE = 10  # steps of the teacher out of a stall
_LAST_STEPS = 25  # steps before an episode is lost, of which some may have lost it
_WRONG = 0.25  # share of half the range of an action that it differs by from the teacher's, and more
STALL_WEIGHT = 3.0
_SEEDS = 100_000  # of the episodes of a seed; those of the validations are left out
_NOISE = 0.15  # of the first round, in which only the teacher acts
_TELLING = 0.5  # share of the states of judged episodes that are those in which the candidate does otherwise


def differ(space: Any, actions: NDArray[Any], labels: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which actions are others than the teacher's, ``(n_envs,)``.

    :param space: of the actions
    :param actions: ``(n_envs, *action_shape)``
    :param labels: the teacher's
    """
    if np.issubdtype(actions.dtype, np.floating):
        far = np.abs(actions - labels) > _WRONG * _half_range(space)
    else:
        far = actions != labels
    return np.asarray(far.reshape(len(actions), -1).any(axis=1))


def _half_range(space: Any) -> NDArray[np.float64]:
    """Return half the range of each number of an action, ``(n_numbers,)``."""
    return np.asarray((space.high - space.low) / 2, dtype=np.float64).ravel()


@dataclass
class Visits:
    """States visited, with labels.

    :param inputs: what a student reads, ``(n, n_inputs)``
    :param actions: the teacher's, ``(n,)`` if Discrete, else ``(n, n_numbers)``
    :param weights: ``(n,)``; more where the student gets nowhere or loses an episode
    :param n_stalls: how often it got nowhere
    :param ended: success and steps of the episodes that ended
    :param good: all actions that are as good as the teacher's, ``(n, n_actions)``; ``None`` if that is not known
    """

    inputs: NDArray[np.float32]
    actions: NDArray[Any]
    weights: NDArray[np.float64]
    n_stalls: int = 0
    ended: list[tuple[bool, int]] = field(default_factory=list)
    good: NDArray[np.bool_] | None = None

    def with_changed(self, augment: Augment | None, teacher: Teacher, pool: Pool, rng: np.random.Generator) -> Visits:
        """Return these states with changed copies of half of them, which the teacher labels too.

        :param augment: changes observations; ``None`` changes nothing
        :param teacher: labels the copies
        :param pool: environments that they are of
        :param rng: source of the draws
        """
        if augment is None:
            return self
        changed = augment(self.inputs[rng.random(len(self.inputs)) < 0.5], rng)
        return replace(
            self,
            inputs=np.concatenate([self.inputs, changed]),
            actions=np.concatenate([self.actions, pool.labels_alone(teacher, changed)]),
            weights=np.append(self.weights, np.ones(len(changed))),
        )


class Collector:
    """Environments in which teacher and student take turns (Ross et al. 2011).

    Larger variations are drawn more often, since their ends are states of the smaller ones: each size twice as often as
    the one before. In an environment with a goal, a student that comes to the same state for the third time in an
    episode gets nowhere: its states weigh more, and the teacher takes over for some steps. So do those in which it did
    otherwise than the teacher in the last steps of an episode that ended without success.

    :param pool: the environments
    :param teacher: labels every state
    :param variations: to draw from, the easiest first
    :param ranks: size of each variation as a number from 0 on
    :param seed: of the draws and of the episodes
    :param augment: makes changed copies of half of the states, which are labelled too
    :param limit: steps after which an episode is ended; by default the environment's own
    """

    def __init__(
        self,
        pool: Pool,
        teacher: Teacher,
        variations: Variations,
        ranks: Sequence[int],
        seed: int,
        augment: Augment | None = None,
        limit: int | None = None,
    ) -> None:
        self.augment = augment
        self.pool, self.teacher, self.variations = pool, teacher, variations
        chances = np.array([2.0 ** min(rank, 6) / ranks.count(rank) for rank in ranks])
        self.chances = chances / chances.sum()
        self.rng = np.random.default_rng(seed)
        self.next_seed = _SEEDS * (seed + 1 if _SEEDS * (seed + 1) < VALIDATION_SEED else seed + 2)
        self.limit = pool.cap if limit is None else limit
        self._guided, self._left = np.zeros(len(pool), dtype=bool), np.zeros(len(pool), dtype=np.int64)
        self._elapsed = np.zeros(len(pool), dtype=np.int64)
        self.stalls = Stalls(len(pool))
        #: Whether an episode has told of success.
        self.has_goal = False

    def begin(self) -> None:
        """Begin episodes in all environments."""
        self.teacher.begin()
        self.pool.begin()
        for row in range(len(self.pool)):
            self._reset(row)

    def collect(self, n_steps: int, student: Act | None, share: float) -> Visits:
        """Visit states.

        :param n_steps: of every environment
        :param student: from observations to actions; ``None`` while there is none
        :param share: of the turns that the teacher has
        """
        pool, rng = self.pool, self.rng
        visits = Visits(np.zeros(0, np.float32), np.zeros(0), np.zeros(0))
        inputs, labels, weights, wrong = [], [], [], []
        first = np.zeros(len(pool), dtype=np.int64)  # step at which the present episode began
        states: list[Mapping[str, Any]] = []
        knows_all = isinstance(self.teacher, PlannerTeacher) and self.teacher.knows_all
        for step in range(n_steps):
            seen = pool.inputs
            stalled = self._stalled(seen)
            visits.n_stalls += int(stalled.sum())
            label = pool.labels(self.teacher)
            inputs.append(seen)
            labels.append(label)
            if knows_all:
                states += [env.unwrapped.state for env in pool.envs]
            weights.append(np.where(stalled, STALL_WEIGHT, 1.0))
            for row in np.flatnonzero(self._left <= 0).tolist():
                self._left[row], self._guided[row] = rng.integers(*_SEGMENT), rng.random() < share
            self._guided[stalled], self._left[stalled] = True, _RESCUE
            self._left -= 1
            actions = label if student is None else np.array(student(seen))
            actions = np.where(self._guided.reshape(-1, *[1] * (label.ndim - 1)), label, actions)
            if student is None:
                actions = self._disturbed(actions)
            wrong.append(differ(pool.envs[0].action_space, actions, label))
            pool.actions = actions
            for row in range(len(pool)):
                ended, info = pool.step(row, actions[row])
                self._elapsed[row] += 1
                self.has_goal = self.has_goal or "is_success" in info
                if ended or self._elapsed[row] >= self.limit:
                    if ended and student is not None and not info.get("is_success", True):
                        for earlier in range(max(first[row], step + 1 - _LAST_STEPS), step + 1):
                            if wrong[earlier][row]:
                                weights[earlier][row] = STALL_WEIGHT
                    first[row] = step + 1
                    visits.ended.append((bool(info.get("is_success", False)), int(self._elapsed[row])))
                    self._reset(row)
        visits.inputs, visits.actions = np.concatenate(inputs), np.concatenate(labels)
        visits.weights = np.concatenate(weights)
        if isinstance(self.teacher, PlannerTeacher) and knows_all:
            visits.good = self.teacher.good_actions(states)
        return visits.with_changed(self.augment, self.teacher, pool, rng)

    def _reset(self, row: int) -> None:
        choice = int(self.rng.choice(len(self.variations), p=self.chances))
        self.pool.reset(row, self.next_seed, self.variations[choice])
        self.pool.dones[row] = self.pool.actions is not None
        self.next_seed += 1
        self._elapsed[row] = self._left[row] = 0
        self.stalls.forget(row)

    def _stalled(self, inputs: Observations) -> NDArray[np.bool_]:
        """Return which environments are in a state for the third time, or a later one, in this episode."""
        if not self.has_goal:
            return np.zeros(len(self.pool), dtype=bool)
        return self.stalls.visits(self.pool.envs, inputs) >= VISITS

    def _disturbed(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return the teacher's actions with some noise, so that it is seen to correct itself."""
        space: Any = self.pool.envs[0].action_space
        if np.issubdtype(actions.dtype, np.floating):
            noisy = actions + _NOISE * _half_range(space) * self.rng.normal(size=actions.shape)
            return np.clip(noisy, space.low.ravel(), space.high.ravel()).astype(actions.dtype)
        drawn = self.rng.integers(space.start, space.start + space.n, size=actions.shape)
        return np.where(self.rng.random(actions.shape) < _NOISE, drawn, actions)


class Witness:
    """Remembers the states of episodes that are judged, with the teacher's actions.

    :param space: of the actions
    """

    def __init__(self, space: Any) -> None:
        self._space = space
        self._steps: list[tuple[NDArray[np.float32], NDArray[Any], bool]] = []
        self._lost: set[int] = set()
        self._episodes: dict[int, list[int]] = {}

    def see(self, rows: Sequence[int], inputs: Observations, actions: NDArray[Any], labels: NDArray[Any]) -> None:
        """See a step; see :class:`~sb3_progpolicy.imitation.rollouts.Watcher`."""
        wrong = differ(self._space, actions, labels)
        for row in rows:
            self._episodes.setdefault(row, []).append(len(self._steps))
            self._steps.append((inputs[row], labels[row], bool(wrong[row])))

    def ended(self, row: int, success: bool) -> None:
        """See the end of an episode; see :class:`~sb3_progpolicy.imitation.rollouts.Watcher`."""
        steps = self._episodes.pop(row)
        if not success:
            self._lost.update(step for step in steps[-_LAST_STEPS:] if self._steps[step][2])

    def visits(self, n_states: int, rng: np.random.Generator) -> Visits:
        """Return some of the states and forget all.

        Half of them, if there are so many, are states in which a candidate did otherwise than the teacher, those in
        which it lost an episode first; the others are drawn from the rest.

        :param n_states: how many at most
        :param rng: source of the draws
        """
        wrong = np.array([step[2] for step in self._steps], dtype=bool)
        lost = np.isin(np.arange(len(wrong)), list(self._lost))
        order = np.lexsort((rng.random(len(wrong)), ~lost, ~wrong))
        n_telling = min(int(wrong.sum()), int(_TELLING * n_states))
        n_others = min(int((~wrong).sum()), n_states - n_telling)
        chosen = np.concatenate([order[:n_telling], order[len(wrong) - n_others :]])
        steps = [self._steps[index] for index in chosen]
        self._steps, self._lost, self._episodes = [], set(), {}
        return Visits(
            np.array([step[0] for step in steps]),
            np.array([step[1] for step in steps]),
            np.where(lost[chosen], STALL_WEIGHT, 1.0),
        )
