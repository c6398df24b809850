"""Reptile as a callback: inner PPO updates on one task, then a step of the initial parameters towards the result."""

from __future__ import annotations

from collections import defaultdict
from typing import Literal

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_progpolicy.tasks import TaskDistribution

MetaOptimizer = Literal["sgd", "adam"]
_META_OPTIMIZERS: dict[MetaOptimizer, type[th.optim.Optimizer]] = {"sgd": th.optim.SGD, "adam": th.optim.Adam}


class ReptileWrapper(BaseCallback):
    """Trains a stock on-policy algorithm across tasks with Reptile (Nichol and Schulman, 2018; algorithm 1, lines 3-9).

    Each meta-iteration draws a task, puts its variation in force, resets the environments and any recurrent state, and
    lets the algorithm make ``inner_updates`` updates, which lead from theta to theta_hat. Then
    ``theta <- theta + beta (theta_hat - theta)``, or a step of Adam on the pseudo-gradient ``theta - theta_hat``. (The
    paper prints line 8 with the opposite sign; its text calls the difference a gradient, which is descended.)

    Works with SB3's ``PPO``, sb3-contrib's ``RecurrentPPO`` and ``ReptilePPO``:

    .. code-block:: python

        tasks = TaskDistribution({"n_discs": [1, 2, 3, 4]})
        PPO("MlpPolicy", "Hanoi-v0").learn(100_000, callback=ReptileWrapper(tasks))

    Logs ``reptile/meta_iteration``, ``reptile/meta_step_norm``, ``reptile/meta_learning_rate`` and, for the variations
    of the current tasks, ``success/<variation>`` and ``steps/<variation>``.

    :param tasks: what to train on
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
        tasks: TaskDistribution,
        inner_updates: int = 4,
        tasks_per_iteration: int = 1,
        meta_learning_rate: float | Schedule = 0.5,
        meta_optimizer: MetaOptimizer = "sgd",
        meta_update: bool = True,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if inner_updates < 1:
            raise ValueError(f"inner_updates={inner_updates} is not accepted; it is at least 1")
        if tasks_per_iteration < 1:
            raise ValueError(f"tasks_per_iteration={tasks_per_iteration} is not accepted; it is at least 1")
        if meta_optimizer not in _META_OPTIMIZERS:
            raise ValueError(f"meta_optimizer={meta_optimizer!r} is not accepted; known: {', '.join(_META_OPTIMIZERS)}")
        self.tasks, self.inner_updates, self.meta_update = tasks, inner_updates, meta_update
        self.tasks_per_iteration = tasks_per_iteration
        self.meta_learning_rate = FloatSchedule(meta_learning_rate)
        self.meta_optimizer_class = _META_OPTIMIZERS[meta_optimizer]
        self.meta_optimizer: th.optim.Optimizer | None = None
        self.meta_iteration = 0
        self._inner_update = 0
        self._theta: list[th.Tensor] = []
        self._row_tasks: list[int] = []
        self.rng = np.random.default_rng()
        self._successes: dict[int, list[float]] = defaultdict(list)
        self._lengths: dict[int, list[float]] = defaultdict(list)

    @property
    def at_task_start(self) -> bool:
        """Whether the rollout that starts is a task's first, so that the parameters are theta."""
        return self._inner_update == 1

    def set_up(self, model: OnPolicyAlgorithm) -> None:
        """Make the meta-optimizer for the parameters of ``model``, unless there is one."""
        if self.meta_optimizer is None:
            self.meta_optimizer = self.meta_optimizer_class(list(model.policy.parameters()), lr=1.0)  # type: ignore[call-arg]

    def _init_callback(self) -> None:
        if not isinstance(self.model, OnPolicyAlgorithm):
            raise TypeError(
                f"{type(self.model).__name__} is not accepted; ReptileWrapper runs with on-policy algorithms"
            )
        self.set_up(self.model)

    def _on_training_start(self) -> None:
        # SB3 does so after the first rollout only; until then a model trained before would still be at its end.
        self.model._update_current_progress_remaining(self.model.num_timesteps, max(1, self.model._total_timesteps))

    def _on_rollout_start(self) -> None:
        if self._inner_update == self.inner_updates:
            self._finish_task()
        if self._inner_update == 0:
            self._begin_task()
        self._inner_update += 1

    def _on_training_end(self) -> None:
        if self._inner_update:
            self._finish_task()

    def _on_step(self) -> bool:
        dones = self.locals["dones"]
        if dones.any():
            infos = self.locals["infos"]
            for row in np.flatnonzero(dones):
                task = self._row_tasks[row]
                if "is_success" in infos[row]:
                    self._successes[task].append(float(infos[row]["is_success"]))
                if "episode" in infos[row]:
                    self._lengths[task].append(float(infos[row]["episode"]["l"]))
        return True

    def _on_rollout_end(self) -> None:
        for task, successes in self._successes.items():
            self.tasks.record(task, float(np.mean(successes)))
            self.logger.record(f"success/{self.tasks.label(task)}", float(np.mean(successes)))
        for task, lengths in self._lengths.items():
            self.logger.record(f"steps/{self.tasks.label(task)}", float(np.mean(lengths)))
        self._successes.clear()
        self._lengths.clear()

    def _begin_task(self) -> None:
        """Line 4: draw a task and start it afresh; what is random in it follows from the seed and its number."""
        model = self.model
        env = model.get_env()
        assert env is not None
        if model.seed is not None:
            seeds = np.random.SeedSequence([model.seed, self.meta_iteration]).generate_state(2)
            model.set_random_seed(int(seeds[0] >> 1))
            self.rng = np.random.default_rng(int(seeds[1]))
        n_tasks = min(self.tasks_per_iteration, env.num_envs)
        tasks = self.tasks.sample(self.rng, 1 - model._current_progress_remaining, n_tasks)
        dealt = [tasks[row % n_tasks] for row in range(env.num_envs)]
        self._row_tasks = [index for index, _ in dealt]
        self.tasks.put_in_force(env, [variation for _, variation in dealt])
        model._last_obs = env.reset()  # type: ignore[assignment]
        model._last_episode_starts = np.ones((env.num_envs,), dtype=bool)
        self._zero_states()
        with th.no_grad():
            self._theta = [parameter.clone() for parameter in model.policy.parameters()]

    def _zero_states(self) -> None:
        """The hidden state is not carried over between tasks (section 2.4)."""
        states = getattr(self.model, "_last_lstm_states", None)
        if states is not None:
            self.model._last_lstm_states = type(states)(  # type: ignore[attr-defined]
                *(tuple(th.zeros_like(tensor) for tensor in pair) for pair in states)
            )

    def _finish_task(self) -> None:
        """Line 8: step the initial parameters, on which the next task starts."""
        self._inner_update = 0
        self.meta_iteration += 1
        self.logger.record("reptile/meta_iteration", self.meta_iteration)
        if self.meta_update:
            beta = self.meta_learning_rate(self.model._current_progress_remaining)
            self.logger.record("reptile/meta_learning_rate", beta)
            self.logger.record("reptile/meta_step_norm", self._meta_step(beta))

    @th.no_grad()
    def _meta_step(self, beta: float) -> float:
        assert self.meta_optimizer is not None
        parameters = list(self.model.policy.parameters())
        for parameter, theta in zip(parameters, self._theta, strict=True):
            theta_hat = parameter.clone()
            parameter.copy_(theta)
            parameter.grad = theta - theta_hat
        for group in self.meta_optimizer.param_groups:
            group["lr"] = beta
        self.meta_optimizer.step()
        self.meta_optimizer.zero_grad()
        moved = th.stack([(now - was).norm() for now, was in zip(parameters, self._theta, strict=True)])
        return float(moved.norm())
