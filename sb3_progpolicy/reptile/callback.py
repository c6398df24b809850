"""Reptile as a callback: inner PPO updates on one task, then a step of the initial parameters towards the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_progpolicy.bounds import check_whole
from sb3_progpolicy.finite import check_parameters, check_step
from sb3_progpolicy.reptile.checks import check_variations
from sb3_progpolicy.reptile.statistics import EpisodeStatistics
from sb3_progpolicy.reptile.steps import MetaOptimizer, MetaOptimizerName, Task, begin_task
from sb3_progpolicy.reptile.tasks import TaskDistribution


class ReptileWrapper(BaseCallback):
    """Trains a stock on-policy algorithm across tasks with Reptile (Nichol and Schulman, 2018; algorithm 1, lines 3-9).

    Each meta-iteration draws a task, puts its variation in force, resets the environments and any recurrent state, and
    lets the algorithm make ``inner_updates`` updates, which lead from theta to theta_hat. Then
    ``theta <- theta + beta (theta_hat - theta)``, or a step of Adam on the pseudo-gradient ``theta - theta_hat``. (The
    paper prints line 8 with the opposite sign; its text calls the difference a gradient, which is descended.)

    Works with SB3's ``PPO``, ``A2C`` and sb3-contrib's ``RecurrentPPO``; ``ReptilePPO`` has Reptile built in:

    .. code-block:: python

        tasks = TaskDistribution({"n_discs": [1, 2, 3, 4]})
        PPO("MlpPolicy", "Hanoi-v0").learn(100_000, callback=ReptileWrapper(tasks))

    Logs ``reptile/meta_iteration``, ``reptile/meta_step_norm``, ``reptile/meta_learning_rate`` and, for the variations
    of the current tasks, ``success/<variation>`` and ``steps/<variation>``.

    :param tasks: what to train on, a :class:`TaskDistribution` or what makes one
    :param inner_updates: k, rollouts (each followed by an update) per task, at least 1
    :param tasks_per_iteration: tasks drawn for a meta-iteration, dealt out over the environments. 1 is algorithm 1 as
        printed; with more, each inner update follows the mean gradient over several tasks, so that it cannot specialise
        on one of them. At most one task per environment
    :param meta_learning_rate: beta, a number or a schedule of the remaining progress (1 to 0); with plain SGD, 1 takes
        over theta_hat as it is and is no different from leaving the meta-step out
    :param meta_optimizer: ``"sgd"`` for the plain step, ``"adam"``
    :param meta_update: ``False`` leaves the meta-step out, so that training just goes on from task to task (PPO-N)
    :param verbose: 0 or 1
    :raises ValueError: if a value is not accepted
    """

    model: OnPolicyAlgorithm

    def __init__(
        self,
        tasks: TaskDistribution | Mapping[str, Any] | Sequence[Mapping[str, Any]],
        inner_updates: int = 4,
        tasks_per_iteration: int = 1,
        meta_learning_rate: float | Schedule = 0.5,
        meta_optimizer: MetaOptimizerName = "sgd",
        meta_update: bool = True,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        check_reptile_arguments(inner_updates, tasks_per_iteration)
        self.tasks = tasks if isinstance(tasks, TaskDistribution) else TaskDistribution(tasks)
        self.inner_updates, self.meta_update = inner_updates, meta_update
        self.tasks_per_iteration = tasks_per_iteration
        self.meta_learning_rate = FloatSchedule(meta_learning_rate)
        self.meta_optimizer = MetaOptimizer(meta_optimizer)
        self.meta_iteration = 0
        self.rng = np.random.default_rng()
        self._updates_of_task = 0
        self._task: Task
        self._statistics = EpisodeStatistics(self.tasks)
        self._trained: OnPolicyAlgorithm | None = None

    def _init_callback(self) -> None:
        if not isinstance(self.model, OnPolicyAlgorithm):
            raise TypeError(
                f"{type(self.model).__name__} is not accepted; ReptileWrapper runs with on-policy algorithms"
            )
        if hasattr(self.model, "inner_loop"):
            raise TypeError(f"{type(self.model).__name__} is not accepted; it has Reptile built in")
        if self._trained is not self.model:  # nothing of another model's training is carried over
            self.meta_optimizer, self.meta_iteration = MetaOptimizer(self.meta_optimizer.name), 0
        self._trained, self._updates_of_task = self.model, 0

    def _on_training_start(self) -> None:
        # SB3 does so after the first rollout only; until then a model trained before would still be at its end.
        self.model._update_current_progress_remaining(self.model.num_timesteps, max(1, self.model._total_timesteps))
        check_variations(self.tasks, self.training_env)

    def _on_rollout_start(self) -> None:
        if self._updates_of_task == self.inner_updates:
            self._meta_step()
        if self._updates_of_task == 0:
            self._begin_task()
        self._updates_of_task += 1

    def _on_step(self) -> bool:
        check_step("the reward", self.locals["rewards"], self.num_timesteps)
        check_step("the observation", self.locals["new_obs"], self.num_timesteps)
        self._statistics.add(self._task.indices, self.locals["dones"], self.locals["infos"])
        return True

    def _on_rollout_end(self) -> None:
        self._statistics.flush(self.logger)

    def _on_training_end(self) -> None:
        if self._updates_of_task:
            self._meta_step()

    def _begin_task(self) -> None:
        """Line 4: draw a task and start it afresh."""
        model, env = self.model, self.training_env
        self._theta, self._task, self.rng = begin_task(
            model.policy.parameters(),
            self.tasks,
            env.num_envs,
            n_tasks=self.tasks_per_iteration,
            number=self.meta_iteration,
            progress=1 - model._current_progress_remaining,
            seed=model.seed,
            rng=self.rng,
        )
        start_task(model, self.tasks, self._task)

    def _meta_step(self) -> None:
        """Line 8: step the initial parameters, on which the next task starts."""
        check_parameters(self.model.policy.named_parameters(), self.num_timesteps)
        self._updates_of_task = 0
        self.meta_iteration += 1
        self.logger.record("reptile/meta_iteration", self.meta_iteration)
        if self.meta_update:
            beta = self.meta_learning_rate(self.model._current_progress_remaining)
            self.logger.record("reptile/meta_learning_rate", beta)
            norm = self.meta_optimizer.step(self.model.policy.parameters(), self._theta, beta)
            self.logger.record("reptile/meta_step_norm", norm)


def check_reptile_arguments(inner_updates: int, tasks_per_iteration: int) -> None:
    """Raise ``ValueError`` for what is not a whole number of at least 1."""
    check_whole("inner_updates", inner_updates, 1)
    check_whole("tasks_per_iteration", tasks_per_iteration, 1)


def start_task(model: OnPolicyAlgorithm, tasks: TaskDistribution, task: Task) -> None:
    """Put a task's variations in force, reset the environments, and zero the recurrent state (section 2.4).

    :param model: whose environments and state these are
    :param tasks: says how a variation is put in force
    :param task: from :func:`~sb3_progpolicy.reptile.steps.begin_task`
    """
    env = model.get_env()
    assert env is not None
    if task.seed is not None:
        model.set_random_seed(task.seed)
    model._last_obs = tasks.reset(env, task.variations)
    model._last_episode_starts = np.ones((env.num_envs,), dtype=bool)
    states = getattr(model, "_last_lstm_states", None)
    if states is not None:
        zeros = (tuple(th.zeros_like(tensor) for tensor in pair) for pair in states)
        model._last_lstm_states = type(states)(*zeros)  # type: ignore[attr-defined]
