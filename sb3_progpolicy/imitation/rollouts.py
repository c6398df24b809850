"""States visited by teacher and student, and episodes to compare them by."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.env_ids import spec_of
from sb3_progpolicy.imitation.augmentation import Augment, Begin
from sb3_progpolicy.imitation.stalls import VISITS, Patience, Stalls
from sb3_progpolicy.imitation.teachers import Observations, PlannerTeacher, Situation, Teacher, join_history
from sb3_progpolicy.programs.interpreter import ProgramRunner, Semantics
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.spaces import action_spec, check_observation_space

Act = Callable[[Observations], NDArray[Any]]
Variations = Sequence[Mapping[str, Any]]
_SEGMENT = (5, 40)  # steps for which teacher or student act in turn
_RESCUE = 10  # steps of the teacher out of a stall
_LAST_STEPS = 25  # steps before an episode is lost, of which some may have lost it
_WRONG = 0.25  # share of half the range of an action that it differs by from the teacher's, and more
STALL_WEIGHT = 3.0
_STEPS_COUNT = 0.1  # a tenth more steps than the teacher's are as bad as one failure in a hundred
_NOISE = 0.15  # of the first round, in which only the teacher acts


class Pool:
    """Environments that are stepped one by one, each with its own variation and the last step's results.

    :param env_id: environment id
    :param n_envs: how many
    :param env_kwargs: constructor arguments
    :param interaction: whether a student reads the previous action, reward and done flag too
    :param begin: begins an episode in another way than ``reset``
    :raises ValueError: if the id is not known or the observations are not accepted
    """

    def __init__(
        self,
        env_id: str,
        n_envs: int,
        env_kwargs: Mapping[str, Any] | None = None,
        interaction: bool = False,
        begin: Begin | None = None,
    ) -> None:
        self.interaction, self._begin = interaction, begin
        spec = spec_of(env_id)
        self.envs: list[Any] = [gym.make(spec.id, **(env_kwargs or {})) for _ in range(n_envs)]
        space = check_observation_space(self.envs[0].observation_space)
        self.spec = action_spec(self.envs[0].action_space)
        self.cap = spec.max_episode_steps or 10_000
        self.observations = np.zeros((n_envs, *space.shape), dtype=np.float32)
        self.rewards, self.dones = np.zeros(n_envs, dtype=np.float32), np.zeros(n_envs, dtype=bool)
        self.actions: NDArray[Any] | None = None

    def __len__(self) -> int:
        return len(self.envs)

    @property
    def inputs(self) -> NDArray[np.float32]:
        """What a student reads now, ``(n_envs, n_inputs)``."""
        if not self.interaction:
            return self.observations.copy()
        return join_history(self.observations, self.actions, self.rewards, self.dones, self.spec)

    def begin(self) -> None:
        """Forget what was done before, as at the start of a task."""
        self.actions, self.dones[:], self.rewards[:] = None, False, 0

    def reset(self, row: int, seed: int, variation: Mapping[str, Any]) -> None:
        """Begin an episode."""
        if self._begin is not None:
            self.observations[row] = self._begin(self.envs[row], seed, variation)
        else:
            self.observations[row] = self.envs[row].reset(seed=seed, options=dict(variation) or None)[0]

    def situation(self, rows: Sequence[int] | None = None) -> Situation:
        """Return what a teacher may look at."""
        envs = self.envs if rows is None else [self.envs[row] for row in rows]
        return Situation(self.observations.copy(), envs, self.actions, self.rewards.copy(), self.dones.copy())

    def step(self, row: int, action: Any) -> tuple[bool, dict[str, Any]]:
        """Take one step; return whether the episode ended, and the infos."""
        observation, reward, terminated, truncated, info = self.envs[row].step(action)
        self.observations[row], self.rewards[row] = observation, float(reward)
        self.dones[row] = terminated or truncated
        return bool(terminated or truncated), info

    def close(self) -> None:
        """Close the environments."""
        for env in self.envs:
            env.close()

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


@dataclass(frozen=True)
class Episodes:
    """Results of some episodes.

    :param returns: sums of rewards
    :param steps: lengths; the cap where a goal was not reached
    :param successes: whether the goal was reached; empty where the environment reports none
    :param distance: mean distance of the actions from the teacher's in the states visited
    """

    returns: NDArray[np.float64]
    steps: NDArray[np.int64]
    successes: NDArray[np.bool_]
    distance: float = float("nan")

    def score(self, steps: float) -> float:
        """Return what is better if larger: the share of successes, less a tenth of the steps taken; or the mean return.

        :param steps: the unit of steps, such as those of a teacher
        """
        if len(self.successes):
            return float(self.successes.mean() - _STEPS_COUNT * self.steps.mean() / max(steps, 1.0))
        return float(self.returns.mean())

    def and_then(self, others: Episodes) -> Episodes:
        """Return these episodes and others, without distances."""
        return Episodes(
            np.concatenate([self.returns, others.returns]),
            np.concatenate([self.steps, others.steps]),
            np.concatenate([self.successes, others.successes]),
        )

    def summary(self) -> dict[str, float]:
        """Return the means by name."""
        means = {"return": float(self.returns.mean()), "steps": float(self.steps.mean())}
        return {"success": float(self.successes.mean()), **means} if len(self.successes) else means


def play(
    pool: Pool,
    variations: Variations,
    n_episodes: int,
    seed: int,
    act: Act | None,
    teacher: Teacher | None = None,
    distance: Callable[[NDArray[Any], NDArray[Any]], NDArray[np.float64]] | None = None,
    patience: Patience | None = None,
) -> Episodes:
    """Play episodes, in turn on each variation.

    :param pool: the environments
    :param variations: to play on
    :param n_episodes: on all of them together
    :param seed: of the first episode; the others follow
    :param act: from observations to actions; ``None`` lets the teacher act
    :param teacher: who acts, or is asked what it would have done
    :param distance: of the actions from the teacher's, if it is to be measured
    :param patience: ends episodes that it gives up, as failures; by default they run to their end
    """
    returns, steps = np.zeros(n_episodes), np.zeros(n_episodes, dtype=np.int64)
    successes: dict[int, bool] = {}
    distances = []
    for first in range(0, n_episodes, len(pool)):
        rows = range(min(len(pool), n_episodes - first))
        if teacher is not None:
            teacher.begin()
        pool.begin()
        if isinstance(act, ProgramAct):
            act.begin()
        for row in rows:
            pool.reset(row, seed + first + row, variations[(first + row) % len(variations)])
        if patience is not None:
            patience.begin()
        live = list(rows)
        while live:
            labels = _labels(pool, teacher, live) if act is None or distance is not None else None
            actions = labels if act is None else act(pool.inputs)
            assert actions is not None
            if distance is not None and act is not None and labels is not None:
                distances.append(distance(actions[live], labels[live]))
            pool.actions = actions
            for row in list(live):
                ended, info = pool.step(row, actions[row])
                episode = first + row
                returns[episode] += pool.rewards[row]
                steps[episode] += 1
                if ended:
                    live.remove(row)
                    if "is_success" in info:
                        successes[episode] = bool(info["is_success"])
                        steps[episode] = steps[episode] if info["is_success"] else pool.cap
                elif _gives_up(patience, pool, row, info, int(steps[episode])):
                    live.remove(row)
                    successes[episode], steps[episode] = False, pool.cap
    known = np.array([successes[key] for key in sorted(successes)], dtype=bool)
    return Episodes(returns, steps, known, float(np.concatenate(distances).mean()) if distances else float("nan"))


def _gives_up(patience: Patience | None, pool: Pool, row: int, info: Mapping[str, Any], n_steps: int) -> bool:
    if patience is None or "is_success" not in info:
        return False
    return patience.ends(row, pool.envs[row], pool.observations[row], n_steps)


def _labels(pool: Pool, teacher: Teacher | None, live: Sequence[int]) -> NDArray[Any]:
    """Return labels of all rows; a planner is not asked about episodes that have ended."""
    assert teacher is not None
    if len(live) == len(pool) or teacher.name != "planner":
        return teacher.label(pool.situation())
    found = teacher.label(pool.situation(live))
    labels = np.zeros((len(pool), *found.shape[1:]), dtype=found.dtype)
    labels[list(live)] = found
    return labels


class ProgramAct:
    """A program as a function from observations to actions, which remembers.

    :param program: the program
    :param n_envs: number of rows of observations
    :param semantics: ``"crisp"`` or ``"soft"``
    """

    def __init__(self, program: ProgramData, n_envs: int, semantics: Semantics = "crisp") -> None:
        self._runner = ProgramRunner(program, n_envs, semantics)

    def begin(self) -> None:
        """Forget everything: other episodes are played from now on."""
        self._runner.reset()

    def __call__(self, observations: Observations) -> NDArray[Any]:
        """Return actions ``(n_envs, *action_shape)``."""
        return self._runner.act(observations)


@dataclass
class Visits:
    """States visited, with labels.

    :param inputs: what a student reads, ``(n, n_inputs)``
    :param actions: the teacher's, ``(n, *action_shape)``
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

    def keep(self, rows: NDArray[np.intp]) -> None:
        """Keep some of the states."""
        self.inputs, self.actions, self.weights = self.inputs[rows], self.actions[rows], self.weights[rows]
        self.good = None if self.good is None else self.good[rows]


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
        self.next_seed = 100_000 * (seed + 1)
        self.limit = pool.cap if limit is None else limit
        self._guided, self._left = np.zeros(len(pool), dtype=bool), np.zeros(len(pool), dtype=np.int64)
        self._elapsed = np.zeros(len(pool), dtype=np.int64)
        self.stalls = Stalls(len(pool))
        self._has_goal = False

    def begin(self) -> None:
        """Begin episodes in all environments."""
        self.teacher.begin()
        self.pool.begin()
        for row in range(len(self.pool)):
            self._reset(row)

    def collect(self, n_steps: int, student: Act | None, share: float, times: int = 1) -> Visits:
        """Visit states.

        :param n_steps: of every environment whose states are returned
        :param student: from observations to actions; ``None`` while there is none
        :param share: of the turns that the teacher has
        :param times: so many times as many steps are taken; of their states those come first that weigh more or in
            which the student does otherwise than the teacher
        """
        pool, rng = self.pool, self.rng
        visits = Visits(np.zeros(0, np.float32), np.zeros(0), np.zeros(0))
        inputs, labels, weights, wrong = [], [], [], []
        first = np.zeros(len(pool), dtype=np.int64)  # step at which the present episode began
        states: list[Mapping[str, Any]] = []
        knows_all = isinstance(self.teacher, PlannerTeacher) and self.teacher.knows_all
        for step in range(n_steps * times):
            seen = pool.inputs
            stalled = self._stalled(seen)
            visits.n_stalls += int(stalled.sum())
            label = self.teacher.label(pool.situation())
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
            wrong.append(self._differ(actions, label))
            pool.actions = actions
            for row in range(len(pool)):
                ended, info = pool.step(row, actions[row])
                self._elapsed[row] += 1
                self._has_goal = self._has_goal or "is_success" in info
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
        if times > 1:
            telling = np.concatenate(wrong) | (visits.weights > 1)
            visits.keep(np.lexsort((rng.random(len(telling)), ~telling))[: len(telling) // times])
        if self.augment is not None:
            chosen = rng.random(len(visits.inputs)) < 0.5
            changed = self.augment(visits.inputs[chosen], rng)
            labels = [visits.actions, self.teacher.label_alone(changed, pool.envs[0])]
            visits.inputs = np.concatenate([visits.inputs, changed])
            visits.actions, visits.weights = np.concatenate(labels), np.append(visits.weights, np.ones(len(changed)))
        return visits

    def _reset(self, row: int) -> None:
        choice = int(self.rng.choice(len(self.variations), p=self.chances))
        self.pool.reset(row, self.next_seed, self.variations[choice])
        self.pool.dones[row] = self.pool.actions is not None
        self.next_seed += 1
        self._elapsed[row] = self._left[row] = 0
        self.stalls.forget(row)

    def _stalled(self, inputs: Observations) -> NDArray[np.bool_]:
        """Return which environments are in a state for the third time, or a later one, in this episode."""
        if not self._has_goal:
            return np.zeros(len(self.pool), dtype=bool)
        return self.stalls.visits(self.pool.envs, inputs) >= VISITS

    def _differ(self, actions: NDArray[Any], labels: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which actions are others than the teacher's, ``(n_envs,)``."""
        if np.issubdtype(actions.dtype, np.floating):
            far = np.abs(actions - labels) > _WRONG * self._half_range
        else:
            far = actions != labels
        return np.asarray(far.reshape(len(actions), -1).any(axis=1))

    @property
    def _half_range(self) -> NDArray[np.float64]:
        """Half the range of each number of an action; 1 where it has no bounds."""
        space: Any = self.pool.envs[0].action_space
        return np.where(np.isfinite(space.high - space.low), (space.high - space.low) / 2, 1.0)

    def _disturbed(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return the teacher's actions with some noise, so that it is seen to correct itself."""
        space: Any = self.pool.envs[0].action_space
        if np.issubdtype(actions.dtype, np.floating):
            noisy = actions + _NOISE * self._half_range * self.rng.normal(size=actions.shape)
            return np.clip(noisy, space.low, space.high).astype(actions.dtype)
        drawn = self.rng.integers(space.start, space.start + space.n, size=actions.shape)
        return np.where(self.rng.random(actions.shape) < _NOISE, drawn, actions)
