"""Environments, and episodes that are played in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.env_ids import spec_of
from sb3_progpolicy.imitation.augmentation import Begin
from sb3_progpolicy.imitation.stalls import Patience
from sb3_progpolicy.imitation.teachers import Observations, Situation, Teacher, checked_labels, join_history
from sb3_progpolicy.programs.interpreter import ProgramRunner, Semantics
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.reptile.options import ReadOptions, refuse_unread
from sb3_progpolicy.spaces import action_spec, check_observation_space

Act = Callable[[Observations], NDArray[Any]]
Variations = Sequence[Mapping[str, Any]]
#: Of the first episode of a validation; no episode of the training has a seed near it.
VALIDATION_SEED = 50_000_000
_STEPS_COUNT = 0.1  # a tenth more steps than the teacher's are as bad as one failure in a hundred


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
        self.interaction, self._begin, self.env_kwargs = interaction, begin, dict(env_kwargs or {})
        spec = spec_of(env_id)
        self.envs: list[Any] = [gym.make(spec.id, **(env_kwargs or {})) for _ in range(n_envs)]
        space = check_observation_space(self.envs[0].observation_space)
        self.spec = action_spec(self.envs[0].action_space)
        shape = self.envs[0].action_space.shape
        #: Of actions that are not flat by themselves.
        self._shape = shape if self.spec.kind == "box" and len(shape) != 1 else None
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
        """Begin an episode.

        :raises ValueError: if the environment does not read what the variation says
        """
        if self._begin is not None:
            self.observations[row] = self._begin(self.envs[row], seed, variation)
            return
        options = ReadOptions(variation)
        self.observations[row] = self.envs[row].reset(seed=seed, options=options if variation else None)[0]
        if variation:
            refuse_unread([options], self.envs[row].spec.id)

    def situation(self, rows: Sequence[int] | None = None) -> Situation:
        """Return what a teacher may look at."""
        envs = self.envs if rows is None else [self.envs[row] for row in rows]
        return Situation(self.observations.copy(), envs, self.actions, self.rewards.copy(), self.dones.copy())

    def labels(self, teacher: Teacher, rows: Sequence[int] | None = None) -> NDArray[Any]:
        """Return what a teacher would do now, ``(n_envs,)`` if Discrete, else ``(n_envs, n_numbers)``.

        :param teacher: is asked
        :param rows: to ask about; by default all
        """
        situation = self.situation(rows)
        return checked_labels(teacher.label(situation), self.spec, len(situation.envs), teacher.name)

    def labels_alone(self, teacher: Teacher, observations: Observations) -> NDArray[Any]:
        """Return what a teacher would do where no environment is; see :meth:`labels`."""
        return checked_labels(
            teacher.label_alone(observations, self.envs[0]), self.spec, len(observations), teacher.name
        )

    def step(self, row: int, action: Any) -> tuple[bool, dict[str, Any]]:
        """Take one step; return whether the episode ended, and the infos."""
        if self._shape is not None:
            action = np.reshape(action, self._shape)
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


class Watcher(Protocol):
    """Sees the steps of episodes that are played."""

    def see(self, rows: Sequence[int], inputs: Observations, actions: NDArray[Any], labels: NDArray[Any]) -> None:
        """See a step.

        :param rows: of the pool in which an episode goes on
        :param inputs: what is acted on, of all rows, ``(n_envs, n_inputs)``
        :param actions: what is done, of all rows, ``(n_envs, *action_shape)``
        :param labels: what the teacher would have done, of all rows, of the same shape
        """

    def ended(self, row: int, success: bool) -> None:
        """See the end of an episode.

        :param row: of the pool
        :param success: whether the goal was reached; ``True`` where the environment reports none
        """


def play(
    pool: Pool,
    variations: Variations,
    n_episodes: int,
    seed: int,
    act: Act | None,
    teacher: Teacher | None = None,
    distance: Callable[[NDArray[Any], NDArray[Any]], NDArray[np.float64]] | None = None,
    patience: Patience | None = None,
    watcher: Watcher | None = None,
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
    :param watcher: sees each step with what the teacher would have done, which therefore has to be given
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
            asked = act is None or distance is not None or watcher is not None
            labels = _labels(pool, teacher, live) if asked else None
            inputs = pool.inputs
            actions = labels if act is None else act(inputs)
            assert actions is not None
            if watcher is not None and labels is not None:
                watcher.see(live, inputs, actions, labels)
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
                else:
                    continue
                if watcher is not None:
                    watcher.ended(row, successes.get(episode, True))
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
        return pool.labels(teacher)
    found = pool.labels(teacher, live)
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
