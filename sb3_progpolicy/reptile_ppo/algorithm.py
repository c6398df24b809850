"""ReptilePPO: algorithm 1 of the paper, Reptile around PPO, with search for a program."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from sb3_contrib.ppo_recurrent import MlpLstmPolicy
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

from sb3_progpolicy.extraction import env_id_of, extract_program, wrappers_of
from sb3_progpolicy.interaction import program_names
from sb3_progpolicy.policies import ProgrammaticActorCritic, ProgrammaticPolicy, RecurrentProgrammaticPolicy
from sb3_progpolicy.programs.program import LEARNED_BY, Program
from sb3_progpolicy.reptile.callback import start_task
from sb3_progpolicy.reptile.checks import check_variations
from sb3_progpolicy.reptile.samplers import Sampler
from sb3_progpolicy.reptile.statistics import EpisodeStatistics
from sb3_progpolicy.reptile.steps import MetaOptimizer, MetaOptimizerName, Task, begin_task
from sb3_progpolicy.reptile.tasks import TaskDistribution, make_tasks
from sb3_progpolicy.reptile_ppo.arguments import check_arguments, whole_timesteps
from sb3_progpolicy.reptile_ppo.environments import make_venv, symmetries_of, with_history, with_limit
from sb3_progpolicy.reptile_ppo.growth import SearchMethod, begin_growth
from sb3_progpolicy.reptile_ppo.initial import complete_policy_kwargs, read_initial_program, start_from_program
from sb3_progpolicy.reptile_ppo.inner_loops import Begun, EngineName, Learning, inner_updates_of_batch, open_inner_loops
from sb3_progpolicy.reptile_ppo.sequence_ppo import Timeouts, default_batch_size
from sb3_progpolicy.reptile_ppo.stored_ppo import StoredPPO
from sb3_progpolicy.reptile_ppo.theta import Theta

SelfReptilePPO = TypeVar("SelfReptilePPO", bound="ReptilePPO")


class ReptilePPO(StoredPPO):
    """Reptile + PPO across the variations of a task domain, learning a program (algorithm 1).

    .. code-block:: python

        model = ReptilePPO("ProgPolicy", "Hanoi-v0", verbose=1)
        model.learn(1_000_000, progress_bar=True)
        print(model.program())

    What differs from SB3's ``PPO``:

    * tasks are drawn, and after each the initial parameters take a step of Reptile;
    * the policy also sees its previous action, reward and done flag, and recurrent states survive the end of an
      episode; they are zeroed at a task switch only (section 2.4);
    * recurrent policies train on whole rollouts, one unpadded sequence per environment;
    * while the search goes on, updates alternate between phi, with W frozen, and W, with phi frozen (section 2.3). When
      ``search_fraction`` of the steps is over the most likely program is extracted (line 10) and phi alone is trained
      on (lines 11-17).

    :param policy: ``"ProgPolicy"``, ``"PRLPolicy"``, ``"MlpPolicy"``, ``"MlpLstmPolicy"`` or a policy class
    :param env: an environment id (the fastest vectorised form is built), an environment or a ``VecEnv``
    :param learning_rate: of the inner updates (Adam), a number or a schedule of the remaining progress. By default it
        falls from 0.02 to 0 for a program, which is nearly linear and takes large steps, and is 0.0003 for a network
    :param n_steps: steps of a rollout, per environment
    :param batch_size: transitions per gradient step; recurrent policies take ``batch_size / n_steps`` whole sequences,
        or, where ``batch_size`` is smaller, sequences of ``batch_size`` steps, or, with a warning, of the next smaller
        divisor of ``n_steps``. By default the rollout, up to 2048, for a program, and an eighth of it for a network
    :param n_epochs: passes over a rollout
    :param gamma: discount factor
    :param gae_lambda: of generalised advantage estimation
    :param clip_range: of the policy ratio, a number or a schedule
    :param clip_range_vf: of the values, or ``None``
    :param normalize_advantage: per minibatch
    :param ent_coef: weight of the action entropy
    :param vf_coef: weight of the value loss
    :param max_grad_norm: gradients are clipped to this norm
    :param target_kl: stop the epochs of an update beyond 1.5 times this divergence; ``None`` for no limit
    :param tasks: a :class:`TaskDistribution`, or what makes one; by default the domain's training variations
    :param sampler: how they are drawn, as in :class:`TaskDistribution`; by default as ``tasks`` says, or uniformly
    :param n_envs: number of environments to build for an id; 32 by default
    :param env_kwargs: constructor arguments for an id
    :param max_episode_steps: limit of an id's training episodes, in place of the registered one
    :param inner_updates: k, PPO updates per meta-iteration
    :param tasks_per_iteration: tasks of a meta-iteration, dealt out over the environments; see :class:`ReptileWrapper`
    :param meta_learning_rate: beta, a number or a schedule
    :param meta_optimizer: ``"sgd"`` or ``"adam"``
    :param meta_batch_size: inner loops of a meta-iteration. Each has tasks of its own and starts from the same theta,
        which then takes a step towards the mean of their results (Reptile's batched form; Nichol and Schulman, 2018,
        section 3). Callbacks then hear of a meta-iteration's steps when it is over, and not of single rewards or infos
    :param engine: where the inner loops of a meta-batch are made, with the same outcome: ``"local"``, in processes of
        this machine; ``"ray"``, on a cluster; ``"serial"``, one after another in this process. The first two need an
        environment id
    :param meta_update: ``False`` for PPO-N: tasks change, the meta-step is left out
    :param search_method: how the number of conditions is found: ``"gradient"``, by W, as in the paper, or ``"growth"``,
        from none on, one at a time, keeping what raises the return (:mod:`sb3_progpolicy.reptile_ppo.growth`)
    :param search_fraction: share of the steps, 0 to 1, after which the program is extracted, or no condition is tried
    :param growth_iterations: of growth, meta-iterations before a condition is tried, and for which it is
    :param init_program: start from this program, without a search: a ``Program``, its ``.json`` file, a run folder or
        the name of a shipped one. Soft and crisp program are equal then but close to where a condition changes, and Box
        actions have a deviation of a tenth of half their range, unless ``temperature`` and ``action_std`` say otherwise
    :param length_coef: price on the expected number of conditions, at least 0; the higher, the shorter the programs. In
        growth the price of a condition, in standard deviations of the episodes' returns
    :param temperature: of the sigmoid in the soft semantics, a number or a schedule of the remaining progress; ``None``
        leaves it as the policy has it
    :param action_temperature: what discrete actions' logits are divided by, a number or a schedule; 1 by default. An
        action that is drawn need not be the likeliest one, which the crisp program takes: a schedule towards 0 makes
        the two agree, as ``temperature`` does for conditions and ``action_std`` for Box actions
    :param symmetric: tie the program's weights over the symmetries that the environment declares, such as Hanoi's pegs
    :param action_std: standard deviation of Box actions, a number or a schedule of the remaining progress; by default
        PPO learns it. Programs are read and run without noise, but what is learnt under much noise may rely on it: a
        schedule towards 0 makes the two agree
    :param interaction_history: append previous action, reward and done to the observation
    :param normalize_observations: shift and scale observations by running statistics, which are folded into the program
        that is extracted; by default for a program, and not for a network
    :param ignore: names of inputs that neither actor nor critic reads, such as one that has other values in the
        variations that are never seen; needs normalised observations
    :param scale_rewards: divide rewards by the running deviation of the return
    :param timeouts: where a limit of steps cuts an episode short, ``"bootstrap"`` adds the value of its last state, as
        PPO does; ``"terminal"`` adds nothing, so that not to reach a goal in time is to fail (Pardo et al., 2018)
    :param stats_window_size: episodes averaged in the logs
    :param tensorboard_log: folder of the TensorBoard logs
    :param policy_kwargs: arguments of the policy, such as ``depth``, ``cell`` and ``condition_size``
    :param verbose: 0, 1 or 2
    :param seed: of everything random; equal seeds give equal runs
    :param device: ``"cpu"``, ``"cuda"`` or ``"auto"``; small programs are fastest on the CPU
    :raises ValueError: if a value, a space or a name is not accepted
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "ProgPolicy": RecurrentProgrammaticPolicy,
        "PRLPolicy": ProgrammaticPolicy,
        "MlpPolicy": ActorCriticPolicy,
        "MlpLstmPolicy": MlpLstmPolicy,
    }

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule | None = None,
        n_steps: int = 32,
        batch_size: int | None = None,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.01,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        *,
        target_kl: float | None = None,
        tasks: TaskDistribution | Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
        sampler: str | Mapping[str, Any] | Sampler | None = None,
        n_envs: int | None = None,
        env_kwargs: Mapping[str, Any] | None = None,
        max_episode_steps: int | None = None,
        inner_updates: int = 4,
        tasks_per_iteration: int = 4,
        meta_learning_rate: float | Schedule = 0.5,
        meta_optimizer: MetaOptimizerName = "sgd",
        meta_batch_size: int = 1,
        engine: EngineName = "local",
        meta_update: bool = True,
        search_method: SearchMethod = "gradient",
        search_fraction: float = 0.5,
        growth_iterations: int = 10,
        init_program: Program | str | os.PathLike[str] | None = None,
        length_coef: float = 0.005,
        temperature: float | Schedule | None = None,
        action_temperature: float | Schedule | None = None,
        action_std: float | Schedule | None = None,
        symmetric: bool = False,
        interaction_history: bool = True,
        normalize_observations: bool | None = None,
        ignore: Sequence[str] = (),
        scale_rewards: bool = False,
        timeouts: Timeouts = "bootstrap",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        check_arguments(locals())
        self.meta_batch_size, self.engine = meta_batch_size, engine
        self.env_by_id = isinstance(env, str)
        self.env_id = env if isinstance(env, str) else env_id_of(env)
        self.interaction_history = interaction_history
        self.env_kwargs, self.max_episode_steps = dict(env_kwargs or {}), max_episode_steps
        made_with = with_limit(self.env_kwargs, max_episode_steps)
        self.tasks = make_tasks(tasks, sampler, self.env_id, self.env_by_id, env_kwargs)
        policy_class = self._get_policy_from_name(policy) if isinstance(policy, str) else policy
        learns_program = issubclass(policy_class, ProgrammaticActorCritic)
        venv = None
        if env is not None:
            remade = self.tasks.apply == "constructor"
            venv = with_history(make_venv(env, n_envs, seed, made_with, remade), interaction_history, learns_program)
        if batch_size is None:
            batch_size = default_batch_size(n_steps, 1 if venv is None else venv.num_envs, learns_program)
        if learning_rate is None:
            learning_rate = LinearSchedule(2e-2, 0.0, 1.0) if learns_program else 3e-4
        if normalize_observations is None:
            normalize_observations = learns_program and init_program is None
        self._initial_program, self.learned_by = read_initial_program(init_program), LEARNED_BY[0]
        self.symmetric, policy_kwargs = symmetric, dict(policy_kwargs or {})
        if symmetric and "symmetries" not in policy_kwargs:
            policy_kwargs["symmetries"] = symmetries_of(self.env_id, venv)
        names = (None, None) if venv is None else program_names(venv)
        self.ignore, about = list(ignore), (self._initial_program, normalize_observations, interaction_history)
        policy_kwargs = complete_policy_kwargs(policy_kwargs, policy_class, *about, self.ignore, names[0])
        self.inner_updates, self.tasks_per_iteration, self.meta_iteration = inner_updates, tasks_per_iteration, 0
        self.meta_optimizer, self.meta_update, self.meta_learning_rate = meta_optimizer, meta_update, meta_learning_rate
        self.search_method, self.search_fraction = search_method, search_fraction
        self.growth_iterations, self.normalize_observations = growth_iterations, normalize_observations
        self.input_names: tuple[str, ...] | None = names[0]
        self.output_names: tuple[str, ...] | None = names[1]
        self.wrappers: tuple[str, ...] = () if venv is None else wrappers_of(venv)
        super().__init__(
            policy,
            venv,
            length_coef=length_coef,
            temperature=temperature,
            action_temperature=action_temperature,
            action_std=action_std,
            scale_rewards=scale_rewards,
            timeouts=timeouts,
            learning_rate=learning_rate,
            n_steps=n_steps,
            batch_size=batch_size,
            n_epochs=n_epochs,
            gamma=gamma,
            gae_lambda=gae_lambda,
            clip_range=clip_range,
            clip_range_vf=clip_range_vf,
            normalize_advantage=normalize_advantage,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            target_kl=target_kl,
            stats_window_size=stats_window_size,
            tensorboard_log=None if tensorboard_log is None else str(tensorboard_log),
            policy_kwargs=policy_kwargs,
            verbose=int(verbose),
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _setup_model(self) -> None:
        super()._setup_model()  # lines 1-2: the derivation graph, its W at even odds, and phi
        if self._initial_program is not None:
            self.learned_by = start_from_program(self, self._initial_program)
            self._initial_program = None
        self.growth = begin_growth(self) if self.search_method == "growth" else None
        self._statistics: EpisodeStatistics | None = None
        self.outer_optimizer = MetaOptimizer(self.meta_optimizer)

    # ---------------------------------------------------------------------------------------------- algorithm 1

    def learn(
        self: SelfReptilePPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str = "ReptilePPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfReptilePPO:
        """Train: algorithm 1. See SB3's ``BaseAlgorithm.learn`` for the arguments.

        :param reset_num_timesteps: ``False`` goes on where training stopped
        """
        total_timesteps, callback = self._setup_learn(
            whole_timesteps(total_timesteps), callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        self._update_current_progress_remaining(self.num_timesteps, max(1, total_timesteps))
        check_variations(self.tasks, self.env)
        with open_inner_loops(self) as inner_loops:
            learning = Learning(callback, log_interval, inner_loops)
            callback.on_training_start(locals(), globals())
            while self._goes_on(learning) and self._search_goes_on():  # line 3
                self._meta_iterate(learning)  # lines 4-8
            if self._goes_on(learning):
                self._fix_program()  # line 10
            while self._goes_on(learning):  # line 11
                self._meta_iterate(learning)  # lines 12-16
            callback.on_training_end()
        return self

    def _meta_iterate(self, learning: Learning) -> None:
        """Make one meta-iteration: a task, inner updates on it, and a step of the initial parameters."""
        if self.growth is not None and self.growth.goes_on(self):
            self.growth.meta_iterate(self, learning)
        else:
            self._reptile_step(self._begin_tasks(), learning)
        self.meta_iteration += 1
        self.logger.record("reptile/meta_iteration", self.meta_iteration)

    def _reptile_step(self, begun: Sequence[Begun], learning: Learning) -> None:
        """Make the inner updates of tasks, and the step of the initial parameters."""
        theta = [parameter.detach().clone() for parameter in self.policy.parameters()]
        if self.meta_batch_size == 1:
            self._inner_updates(*begun[0], learning)  # theta becomes theta_hat: lines 5-7 and 13-15
        else:
            inner_updates_of_batch(self, begun, learning)
        if self.meta_update:
            beta = FloatSchedule(self.meta_learning_rate)(self._current_progress_remaining)
            norm = self.outer_optimizer.step(self.policy.parameters(), theta, beta)  # lines 8 and 16
            self.logger.record("reptile/meta_learning_rate", beta)
            self.logger.record("reptile/meta_step_norm", norm)

    def _begin_tasks(self) -> list[Begun]:
        """Draw what a meta-iteration trains on: a task for every inner loop (lines 4 and 12)."""
        return [self._begin_task(replica) for replica in range(self.meta_batch_size)]

    def _begin_task(self, replica: int, n_tasks: int | None = None) -> Begun:
        repeated = self.meta_batch_size > 1 or self.growth is not None  # in another process, or with another program
        return begin_task(
            (),
            self.tasks,
            self.n_envs,
            n_tasks=n_tasks or self.tasks_per_iteration,
            number=self.meta_iteration,
            progress=1 - self._current_progress_remaining,
            seed=int(self.rng.integers(2**31)) if repeated and self.seed is None else self.seed,
            rng=self.rng,
            replica=replica,
        )[1:]

    def inner_loop(self, theta: Theta, task: Task, rng: np.random.Generator) -> Theta:
        """Make the inner updates of one task: ``theta`` becomes ``theta_hat`` (lines 5-7).

        The result follows from the arguments and the hyperparameters alone, so that another process can compute it.
        :meth:`learn` makes the same updates from the theta that the model holds.

        :param theta: where to start
        :param task: what to train on
        :param rng: source of randomness in rollouts and updates
        :return: theta_hat, which the model holds then, too
        """
        if self.ep_info_buffer is None or not hasattr(self, "_logger"):
            self._setup_learn(theta.total_timesteps)
        theta.put_into(self)
        self._inner_updates(task, rng, Learning(self._init_callback(None)))
        return Theta.of(self)

    def _inner_updates(self, task: Task, rng: np.random.Generator, learning: Learning) -> None:
        """Make ``inner_updates`` times a rollout and an update on a task, from the parameters that the model holds."""
        self.rng = rng
        if self.reward_scaler is not None:
            self.reward_scaler.reset_returns()
        start_task(self, self.tasks, task)
        self._task, self._statistics = task, EpisodeStatistics(self.tasks)
        assert self.env is not None
        for number in range(self.inner_updates):
            if not self.collect_rollouts(self.env, learning.callback, self.rollout_buffer, self.n_steps):  # lines 5-6
                learning.stopped = True
                break
            self._statistics.flush(self.logger)
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            learning.n_rollouts += 1
            if learning.log_interval is not None and learning.n_rollouts % learning.log_interval == 0:
                self.dump_logs(learning.n_rollouts)
            # W and phi in turns (section 2.3), also from one task to the next.
            odd = (task.number * self.inner_updates + number) % 2 == 1
            self.train(derivation=self.searching and odd)  # line 7
            if self.num_timesteps >= self._total_timesteps:
                break

    def _goes_on(self, learning: Learning) -> bool:
        return self.num_timesteps < self._total_timesteps and not learning.stopped

    def _search_goes_on(self) -> bool:
        if self.growth is not None:
            return self.growth.goes_on(self)
        searching = self.search is not None and self.search.searching
        return searching and 1 - self._current_progress_remaining < self.search_fraction

    def _fix_program(self) -> None:
        """Select the most likely program; from here on phi alone is trained (line 10)."""
        if self.search is None or not self.search.searching:
            return
        self.search.select(self.search.most_likely())
        names = [name for name, _ in self.policy.named_parameters()]
        self.outer_optimizer.drop(names.index("module.search.logits"))

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Any = None) -> None:
        ended = np.flatnonzero(dones)  # no other info is read
        if len(ended):
            super()._update_info_buffer([infos[row] for row in ended], dones[ended])
            if self._statistics is not None:  # SB3 lets collect_rollouts be called outside learn, without a task
                self._statistics.add(self._task.indices, dones, infos)

    # --------------------------------------------------------------------------------------------- the program

    def program(self, **metadata: Any) -> Program:
        """Return the most likely program as plain data, its inputs and outputs named by the environment.

        :param metadata: JSON values to keep with it; environment id, seed and number of steps are put in
        :raises TypeError: if the policy is not a program
        """
        return extract_program(self, **metadata)

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """Set the environment, and append the interaction history to its observations if the policy reads it.

        :param env: an environment id is accepted too; it is made with the ``env_kwargs`` of this one
        :param force_reset: see SB3's ``BaseAlgorithm.set_env``
        """
        made = isinstance(env, str)
        remade = self.tasks.apply == "constructor"
        made_with = with_limit(self.env_kwargs, self.max_episode_steps) if made else {}
        venv = make_venv(env, self.n_envs if made else None, self.seed, made_with, remade)
        venv = with_history(venv, self.interaction_history, isinstance(self.policy, ProgrammaticActorCritic))
        super().set_env(venv, force_reset)
        self.env_by_id, self.env_id = made, env if isinstance(env, str) else env_id_of(venv)
        self.wrappers, (self.input_names, self.output_names) = wrappers_of(venv), program_names(venv)
