"""ReptilePPO: algorithm 1 of the paper, PPO on whole rollouts inside Reptile, with search for a program."""

from __future__ import annotations

import io
import math
import os
import pathlib
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from sb3_contrib.ppo_recurrent import MlpLstmPolicy
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv, is_vecenv_wrapped

from sb3_progpolicy.interaction import InteractionHistory, VecInteractionHistory, program_names
from sb3_progpolicy.normalization import NormalizingExtractor, RewardScaler
from sb3_progpolicy.policies import (
    DERIVATION_LR_SCALE,
    ProgrammaticActorCritic,
    ProgrammaticPolicy,
    RecurrentProgrammaticPolicy,
)
from sb3_progpolicy.programs.modules import State
from sb3_progpolicy.programs.sampler import ProgramSampler
from sb3_progpolicy.programs.syntax import Program
from sb3_progpolicy.reptile import MetaOptimizer, ReptileWrapper
from sb3_progpolicy.tasks import TaskDistribution, default_tasks
from sb3_progpolicy.vec_env import make_fast_vec_env

SelfReptilePPO = TypeVar("SelfReptilePPO", bound="ReptilePPO")

DEFAULT_N_ENVS = 32


class ReptilePPO(PPO):
    """Reptile + PPO across the variations of a task domain, learning a program (algorithm 1).

    .. code-block:: python

        model = ReptilePPO("ProgPolicy", "Hanoi-v0", verbose=1)
        model.learn(1_000_000, progress_bar=True)
        print(model.program())

    What differs from SB3's ``PPO``:

    * tasks are drawn and parameters meta-updated by a :class:`ReptileWrapper`;
    * the policy also sees its previous action, reward and done flag, and recurrent states survive the end of an
      episode; they are zeroed at a task switch only (section 2.4);
    * recurrent policies train on whole rollouts, one unpadded sequence per environment;
    * while the search goes on, updates alternate between phi, with W frozen, and W, with phi frozen (section 2.3). When
      ``search_fraction`` of the steps is over the most likely program is extracted (line 10) and phi alone is trained
      on (lines 11-17).

    :param policy: ``"ProgPolicy"``, ``"PRLPolicy"``, ``"MlpPolicy"``, ``"MlpLstmPolicy"`` or a policy class
    :param env: an environment id (the fastest vectorised form is built), an environment or a ``VecEnv``
    :param learning_rate: of the inner updates (Adam), a number or a schedule of the remaining progress; by default 0.01
        for a program, which is nearly linear in its parameters and takes large steps, and 0.0003 for a network
    :param n_steps: steps of a rollout, per environment
    :param batch_size: transitions per gradient step; recurrent policies take ``batch_size / n_steps`` whole sequences,
        or, where ``batch_size`` is smaller, sequences of ``batch_size`` steps, which must then divide ``n_steps``. By
        default an eighth of the rollout
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
    :param n_envs: number of environments to build for an id; 32 by default
    :param env_kwargs: constructor arguments for an id
    :param inner_updates: k, PPO updates per meta-iteration
    :param tasks_per_iteration: tasks of a meta-iteration, dealt out over the environments; see :class:`ReptileWrapper`
    :param meta_learning_rate: beta, a number or a schedule
    :param meta_optimizer: ``"sgd"`` or ``"adam"``
    :param meta_update: ``False`` for PPO-N: tasks change, the meta-step is left out
    :param search_fraction: share of the steps, 0 to 1, after which the program is extracted
    :param length_coef: price on the expected number of conditions, at least 0; the higher, the shorter the programs
    :param temperature: of the sigmoid in the soft semantics, a number or a schedule of the remaining progress; ``None``
        leaves it as the policy has it
    :param action_std: standard deviation of Box actions, a number or a schedule of the remaining progress; by default
        PPO learns it. Programs are read and run without noise, but what is learnt under much noise may rely on it: a
        schedule towards 0 makes the two agree
    :param interaction_history: append previous action, reward and done to the observation
    :param normalize_observations: shift and scale observations by running statistics (folded into the program)
    :param scale_rewards: divide rewards by the running deviation of the return
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
    policy: ActorCriticPolicy

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule | None = None,
        n_steps: int = 128,
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
        target_kl: float | None = None,
        *,
        tasks: TaskDistribution | Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
        n_envs: int | None = None,
        env_kwargs: Mapping[str, Any] | None = None,
        inner_updates: int = 4,
        tasks_per_iteration: int = 4,
        meta_learning_rate: float | Schedule = 0.5,
        meta_optimizer: MetaOptimizer = "sgd",
        meta_update: bool = True,
        search_fraction: float = 0.5,
        length_coef: float = 0.005,
        temperature: float | Schedule | None = None,
        action_std: float | Schedule | None = None,
        interaction_history: bool = True,
        normalize_observations: bool = False,
        scale_rewards: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        if not 0 <= search_fraction <= 1:
            raise ValueError(f"search_fraction={search_fraction} is not accepted; it is from 0 to 1")
        if length_coef < 0:
            raise ValueError(f"length_coef={length_coef} is not accepted; it is at least 0")
        self.env_id = env if isinstance(env, str) else _env_id(env)
        self.interaction_history = interaction_history
        venv = None
        if env is not None:
            venv = _with_history(_make_venv(env, n_envs, seed, env_kwargs or {}), interaction_history)
        if batch_size is None:
            batch_size = max(2, n_steps * (1 if venv is None else venv.num_envs) // 8)
        policy_class = self._get_policy_from_name(policy) if isinstance(policy, str) else policy
        if learning_rate is None:
            learning_rate = 1e-2 if issubclass(policy_class, ProgrammaticActorCritic) else 3e-4
        policy_kwargs = dict(policy_kwargs or {})
        if normalize_observations:
            policy_kwargs.setdefault("features_extractor_class", NormalizingExtractor)
        if tasks is None:
            tasks = default_tasks(self.env_id)
        self.tasks = tasks if isinstance(tasks, TaskDistribution) else TaskDistribution(tasks)
        self.inner_updates, self.tasks_per_iteration = inner_updates, tasks_per_iteration
        self.meta_learning_rate = meta_learning_rate
        self.meta_optimizer, self.meta_update = meta_optimizer, meta_update
        self.search_fraction, self.length_coef = search_fraction, length_coef
        self.temperature, self.action_std = temperature, action_std
        self.normalize_observations = normalize_observations
        self.reward_scaler = RewardScaler(gamma) if scale_rewards else None
        self.input_names: tuple[str, ...] | None = None
        self.output_names: tuple[str, ...] | None = None
        if venv is not None:
            self.input_names, self.output_names = program_names(venv)
        self.meta_iteration = 0
        self._last_lstm_states: RNNStates | None = None
        super().__init__(
            policy,
            venv,  # type: ignore[arg-type]
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
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    # ------------------------------------------------------------------------------------------------ set-up

    def _setup_model(self) -> None:
        super()._setup_model()
        self._check_sequences()
        if self.action_std is not None and not hasattr(self.policy, "log_std"):
            raise ValueError(f"action_std is for Box actions, not {self.action_space}")
        self.reptile = _Reptile(
            self.tasks,
            self.inner_updates,
            self.tasks_per_iteration,
            self.meta_learning_rate,
            self.meta_optimizer,
            self.meta_update,
        )
        self.reptile.meta_iteration = self.meta_iteration
        self.reptile.set_up(self)
        self._zero_lstm_states()

    def _check_sequences(self) -> None:
        if self.recurrent and self.batch_size < self.n_steps and self.n_steps % self.batch_size:
            raise ValueError(
                f"batch_size={self.batch_size} is not accepted with n_steps={self.n_steps}; recurrent policies train "
                "on whole sequences: batch_size is a divisor of n_steps, or larger than it"
            )

    def _zero_lstm_states(self) -> None:
        if not isinstance(self.policy, RecurrentActorCriticPolicy):
            return
        lstm = self.policy.lstm_actor
        shape = (lstm.num_layers, self.n_envs, lstm.hidden_size)
        pi, vf = (tuple(th.zeros(shape, device=self.device) for _ in range(2)) for _ in range(2))
        self._last_lstm_states = RNNStates(pi, vf)

    @property
    def recurrent(self) -> bool:
        """Whether the policy has a state."""
        return isinstance(self.policy, RecurrentActorCriticPolicy)

    @property
    def sequence_length(self) -> int:
        """Length of the sequences that gradient steps are made on; 1 for a policy without a state."""
        return min(self.n_steps, self.batch_size) if self.recurrent else 1

    @property
    def search(self) -> Any:
        """W, or ``None`` for a policy that is not a program."""
        return self.policy.module.search if isinstance(self.policy, ProgrammaticActorCritic) else None

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        if isinstance(callback, list):
            callback = CallbackList(callback)
        if not isinstance(callback, BaseCallback):
            callback = ConvertCallback(callback)
        # Reptile first: it finishes a task before anyone else, a checkpoint say, looks at the parameters.
        return super()._init_callback([self.reptile, callback], progress_bar)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        if self.search is not None:
            self.policy.optimizer.param_groups[-1]["lr"] *= DERIVATION_LR_SCALE

    # ------------------------------------------------------------------------- lines 5-6: sample trajectories

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fill the buffer with ``n_rollout_steps`` steps of every environment.

        :return: ``False`` if a callback ended the training
        """
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        callback.on_rollout_start()
        if self.temperature is not None and isinstance(self.policy, ProgrammaticActorCritic):
            self.policy.set_temperature(FloatSchedule(self.temperature)(self._current_progress_remaining))
        self._set_action_std()
        self._sampler = self._make_sampler(n_rollout_steps)
        # States at which the sequences of the update start.
        self._sequence_states: list[RNNStates] = []
        for step in range(n_rollout_steps):
            if self.recurrent and step % self.sequence_length == 0:
                self._sequence_states.append(self._present_states())
            actions = self._act(rollout_buffer, step)
            env_actions = actions
            if isinstance(self.action_space, spaces.Box):
                env_actions = np.clip(actions, self.action_space.low, self.action_space.high)
            elif isinstance(self.action_space, spaces.Discrete) and self.action_space.start:
                env_actions = actions + self.action_space.start
            new_obs, rewards, dones, infos = env.step(env_actions)
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            if self.reward_scaler is not None:
                rewards = self.reward_scaler(rewards, dones)
            self._bootstrap_truncated(rewards, dones, infos)
            rollout_buffer.observations[step] = self._last_obs
            rollout_buffer.actions[step] = actions.reshape(env.num_envs, -1)
            rollout_buffer.rewards[step] = rewards
            rollout_buffer.episode_starts[step] = self._last_episode_starts
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
        rollout_buffer.pos, rollout_buffer.full = n_rollout_steps, True
        self._complete_rollout(rollout_buffer, dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _make_sampler(self, n_steps: int) -> ProgramSampler | None:
        """Return the fast way to draw actions, where there is one: a program on the CPU that reads flat numbers."""
        policy = self.policy
        if not isinstance(policy, ProgrammaticActorCritic) or self.device.type != "cpu":
            return None
        if type(policy.features_extractor) not in (FlattenExtractor, NormalizingExtractor):
            return None
        states = self._last_lstm_states
        state = policy.module.initial_state(self.n_envs) if states is None else cast(State, states.pi)
        return ProgramSampler(policy.module, state, n_steps, self.reptile.rng, getattr(policy, "log_std", None))

    def _act(self, buffer: RolloutBuffer, step: int) -> np.ndarray:
        """Draw actions ``(n_envs, *action_shape)`` and advance the recurrent states."""
        if self._sampler is None:
            return self._act_by_policy(buffer, step)
        features = np.asarray(self._last_obs, dtype=np.float32)
        if isinstance(self.policy.features_extractor, NormalizingExtractor):
            features = self.policy.features_extractor(th.from_numpy(features)).numpy()
        return self._sampler.sample(features).reshape(self.n_envs, *self.action_space.shape)  # type: ignore[misc]

    @th.no_grad()
    def _act_by_policy(self, buffer: RolloutBuffer, step: int) -> np.ndarray:
        obs = obs_as_tensor(self._last_obs, self.device)  # type: ignore[arg-type]
        if self.recurrent:
            starts = th.zeros(self.n_envs, device=self.device)  # states survive the end of an episode
            drawn, values, log_probs, self._last_lstm_states = self.policy(obs, self._last_lstm_states, starts)
        else:
            drawn, values, log_probs = self.policy(obs)
        buffer.values[step] = values.cpu().numpy().ravel()
        buffer.log_probs[step] = log_probs.cpu().numpy()
        return drawn.cpu().numpy()

    def _present_states(self) -> RNNStates:
        """Return the recurrent states after the last step; the sampler keeps its own while it acts."""
        if self._sampler is not None:
            states = self._sampler.state
            return RNNStates(states, states)
        assert self._last_lstm_states is not None
        return self._last_lstm_states

    @th.no_grad()
    def _complete_rollout(self, buffer: RolloutBuffer, dones: np.ndarray) -> None:
        """Put in what the fast way leaves out, values and log-probabilities, and estimate the advantages."""
        if self.recurrent:
            self._last_lstm_states = self._present_states()
        if self._sampler is not None:
            policy = cast(ProgrammaticActorCritic, self.policy)
            arrays = (buffer.observations, self._sampler.recorded_tests, buffer.actions)
            observations, tests, actions = (th.from_numpy(array).flatten(0, 1) for array in arrays)
            values, log_probs = policy.evaluate_tests(observations, tests, self._typed(actions))
            buffer.values[:], buffer.log_probs[:] = (
                tensor.numpy().reshape(buffer.values.shape) for tensor in (values, log_probs)
            )
        last_values = self._predict_values(obs_as_tensor(self._last_obs, self.device))  # type: ignore[arg-type]
        buffer.compute_returns_and_advantage(last_values=last_values, dones=dones)

    def _predict_values(self, obs: th.Tensor, rows: Sequence[int] | slice = slice(None)) -> th.Tensor:
        if not self.recurrent:
            return self.policy.predict_values(obs)
        assert self._last_lstm_states is not None
        states = tuple(state[:, rows].contiguous() for state in self._last_lstm_states.vf)
        return self.policy.predict_values(obs, states, th.zeros(len(obs), device=self.device))  # type: ignore[call-arg]

    def _bootstrap_truncated(self, rewards: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Add the value of the state at which an episode was cut short, as PPO does."""
        rows = [row for row in dones.nonzero()[0].tolist() if infos[row].get("TimeLimit.truncated", False)]
        if rows:
            last = np.stack([infos[row]["terminal_observation"] for row in rows])
            with th.no_grad():
                values = self._predict_values(obs_as_tensor(last, self.device), rows)  # type: ignore[arg-type]
            rewards[rows] += self.gamma * values.cpu().numpy().ravel()

    # ------------------------------------------------------------------------------ line 7: estimate theta_hat

    def train(self) -> None:
        """Make one PPO update from the rollout in the buffer.

        While the search goes on, every second update moves W with phi frozen and the others phi with W frozen (the
        bilevel optimisation of section 2.3).
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        searching = self.search is not None and self.search.searching and len(self.search.logits) > 0
        moves_derivation = searching and (self._n_updates // self.n_epochs) % 2 == 1
        self._freeze(derivation=searching and not moves_derivation, phi=moves_derivation)
        rollout = self._sequences()
        if moves_derivation:
            rollout = {
                "terms": self._derivation_terms(rollout),
                **{name: rollout[name] for name in ("actions", "log_probs", "advantages")},
            }
        statistics: list[dict[str, th.Tensor]] = []
        parameters = list(self.policy.parameters())
        for sequences in self._minibatches(len(rollout["advantages"])):
            loss, measured = self._loss(rollout, sequences, clip_range)
            statistics.append(measured)
            if self.target_kl is not None and measured["approx_kl"] > 1.5 * self.target_kl:
                break
            self.policy.optimizer.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
            self.policy.optimizer.step()
        self._freeze(derivation=False, phi=False)
        self._n_updates += self.n_epochs
        self._log(statistics, clip_range)
        if isinstance(self.policy.features_extractor, NormalizingExtractor):
            observations = self.rollout_buffer.observations
            self.policy.features_extractor.update(observations.reshape(-1, observations.shape[-1]))

    def _freeze(self, derivation: bool, phi: bool) -> None:
        """Freeze W, or phi, or neither; a scheduled ``action_std`` is never trained."""
        if isinstance(self.policy, ProgrammaticActorCritic):
            self.policy.optimizer.zero_grad()
            for parameter in self.policy.derivation_parameters():
                parameter.requires_grad_(not derivation)
            for parameter in self.policy.phi():
                parameter.requires_grad_(not phi)
        if self.action_std is not None:
            self.policy.log_std.requires_grad_(False)

    @th.no_grad()
    def _set_action_std(self) -> None:
        """Let the standard deviation of the actions follow its schedule, if it has one."""
        if self.action_std is None:
            return
        deviation = FloatSchedule(self.action_std)(self._current_progress_remaining)
        if not deviation > 0:
            raise ValueError(f"action_std={deviation} is not accepted; it is above 0")
        self.policy.log_std.fill_(math.log(deviation))

    @th.no_grad()
    def _derivation_terms(self, rollout: Mapping[str, th.Tensor]) -> th.Tensor:
        """Return what an update of W needs to know of every step; with phi frozen it stays the same throughout."""
        policy = cast(ProgrammaticActorCritic, self.policy)
        observations = rollout["observations"].flatten(0, 1)
        if self._sampler is not None:
            tests = self._lay_out(self._sampler.recorded_tests).flatten(0, 1)
        else:
            tests = policy.condition_values(observations, self._states(rollout).pi if self.recurrent else None)
        return policy.derivation_terms(observations, tests).unflatten(0, rollout["advantages"].shape)

    def _lay_out(self, array: np.ndarray) -> th.Tensor:
        """Turn ``(n_steps, n_envs, ...)`` into ``(n_sequences, sequence_length, ...)``."""
        split = array.reshape(-1, self.sequence_length, self.n_envs, *array.shape[2:]).swapaxes(1, 2)
        return th.as_tensor(split.reshape(-1, self.sequence_length, *array.shape[2:]), device=self.device)

    def _typed(self, actions: th.Tensor) -> th.Tensor:
        """Return actions of the buffer, ``(..., action_dim)``, as the distributions take them."""
        if isinstance(self.action_space, spaces.Discrete):
            return actions.long().squeeze(-1)
        if isinstance(self.action_space, spaces.MultiDiscrete):
            return actions.long()
        return actions.float() if isinstance(self.action_space, spaces.MultiBinary) else actions

    def _sequences(self) -> dict[str, th.Tensor]:
        """Lay the buffer out as ``(n_sequences, sequence_length, ...)``; nothing resets inside: nothing is padded."""
        names = ("observations", "actions", "log_probs", "advantages", "returns", "values")
        rollout = {name: self._lay_out(getattr(self.rollout_buffer, name)) for name in names}
        rollout["actions"] = self._typed(rollout["actions"])
        if self.recurrent:
            for part in ("pi", "vf"):
                for i, kind in enumerate("hc"):
                    states = [getattr(sequence, part)[i] for sequence in self._sequence_states]
                    rollout[part + kind] = th.cat(states, dim=1).transpose(0, 1)
        return rollout

    def _minibatches(self, n_sequences: int) -> Iterator[np.ndarray]:
        per_batch = max(1, self.batch_size // self.sequence_length)
        for _ in range(self.n_epochs):
            order = self.reptile.rng.permutation(n_sequences)
            yield from (order[start : start + per_batch] for start in range(0, n_sequences, per_batch))

    @staticmethod
    def _states(batch: Mapping[str, th.Tensor]) -> RNNStates:
        """Return the states at which the sequences of a batch start."""
        pi, vf = (tuple(batch[part + kind].transpose(0, 1).contiguous() for kind in "hc") for part in ("pi", "vf"))
        return RNNStates(pi, vf)

    def _evaluate(self, batch: Mapping[str, th.Tensor]) -> tuple[th.Tensor | None, th.Tensor, th.Tensor | None]:
        """Return values (``None`` when only W is moved), log-probabilities and entropies of a batch of sequences."""
        actions = batch["actions"].flatten(0, 1)
        if "terms" in batch:
            policy = cast(ProgrammaticActorCritic, self.policy)
            return None, *policy.evaluate_derivation(batch["terms"].flatten(0, 1), actions)
        observations = batch["observations"].flatten(0, 1)
        if not self.recurrent:
            return self.policy.evaluate_actions(observations, actions)
        starts = th.zeros(len(observations), device=self.device)
        return self.policy.evaluate_actions(observations, actions, self._states(batch), starts)  # type: ignore[call-arg]

    def _loss(
        self, rollout: Mapping[str, th.Tensor], sequences: np.ndarray, clip_range: float
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """Return PPO's clipped loss (Schulman et al., 2017), with the price on length, and what is logged of it."""
        index = th.as_tensor(sequences, device=self.device)
        batch = {name: tensor[index] for name, tensor in rollout.items()}
        values, log_prob, entropy = self._evaluate(batch)
        advantages = batch["advantages"].flatten()
        if self.normalize_advantage and len(advantages) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        log_ratio = log_prob - batch["log_probs"].flatten()
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
        policy_loss = -th.min(advantages * ratio, advantages * clipped).mean()
        entropy_loss = -(-log_prob if entropy is None else entropy).mean()
        loss = policy_loss + self.ent_coef * entropy_loss
        measured = {"policy_gradient_loss": policy_loss, "entropy_loss": entropy_loss}
        if values is not None:
            measured["value_loss"] = self._value_loss(values.flatten(), batch)
            loss = loss + self.vf_coef * measured["value_loss"]
        if self.length_coef and self.search is not None:
            loss = loss + self.length_coef * self.search.expected_conditions()
        with th.no_grad():
            measured["approx_kl"] = ((ratio - 1) - log_ratio).mean()
            measured["clip_fraction"] = ((ratio - 1).abs() > clip_range).float().mean()
        measured["loss"] = loss
        return loss, {name: value.detach() for name, value in measured.items()}

    def _value_loss(self, values: th.Tensor, batch: Mapping[str, th.Tensor]) -> th.Tensor:
        if self.clip_range_vf is not None:
            reach = self.clip_range_vf(self._current_progress_remaining)  # type: ignore[operator]
            old_values = batch["values"].flatten()
            values = old_values + (values - old_values).clamp(-reach, reach)
        return th.nn.functional.mse_loss(batch["returns"].flatten(), values)

    def _log(self, statistics: Sequence[Mapping[str, th.Tensor]], clip_range: float) -> None:
        for name in statistics[0]:
            self.logger.record(f"train/{name}", th.stack([measured[name] for measured in statistics]).mean().item())
        values, returns = self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten()
        self.logger.record("train/explained_variance", explained_variance(values, returns))
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", self.policy.log_std.exp().mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)
        if isinstance(self.policy, ProgrammaticActorCritic):
            self._log_program()

    @th.no_grad()
    def _log_program(self) -> None:
        """Log W and how often each branch was taken: C'_k is ``branch_then_k``, C_k is ``branch_last_k``."""
        assert isinstance(self.policy, ProgrammaticActorCritic)
        for n_conditions, probability in enumerate(self.search.probabilities().tolist()):
            self.logger.record(f"program/prob_{n_conditions}_conditions", probability)
        self.logger.record("program/search_entropy", self.search.entropy().item())
        self.logger.record("program/temperature", self.policy.module.temperature.item())
        if self._sampler is not None:
            names = [f"then_{k}" for k in range(1, self.policy.module.depth)]
            names += [f"last_{k}" for k in range(1, self.policy.module.depth + 1)]
            for name, share in zip(names, self._sampler.branch_frequencies(), strict=True):
                self.logger.record(f"program/branch_{name}", share)

    # --------------------------------------------------------------------------------------------- the program

    def program(self, **metadata: Any) -> Program:
        """Return the most likely program as plain data, its inputs and outputs named by the environment.

        :param metadata: JSON values to keep with it; environment id, seed and number of steps are put in
        :raises TypeError: if the policy is not a program
        """
        if not isinstance(self.policy, ProgrammaticActorCritic):
            raise TypeError(f"{type(self.policy).__name__} is not a program; ProgPolicy and PRLPolicy are")
        origin = {"env": self.env_id, "seed": self.seed, "timesteps": self.num_timesteps}
        # A saved model's tuples are loaded as lists.
        inputs, outputs = (tuple(names or ()) for names in (self.input_names, self.output_names))
        return self.policy.program(inputs, outputs, self.interaction_history, **{**origin, **metadata})

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions, as the environment takes them, and the next state. See SB3's ``BaseAlgorithm.predict``.

        :param observation: with the interaction history, if the policy was trained with it
        :param state: of a recurrent policy; ``None`` at the start of a task, which reads as zeros
        :param episode_start: changes nothing: states survive the end of an episode, as in training (section 2.4)
        :param deterministic: take the likeliest action, or the mean, instead of drawing one
        """
        actions, state = super().predict(observation, state, None, deterministic)
        if isinstance(self.action_space, spaces.Discrete):
            actions = actions + self.action_space.start
        return actions, state

    # ------------------------------------------------------------------------------------------ learn and save

    def learn(
        self: SelfReptilePPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "ReptilePPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfReptilePPO:
        """Train. See SB3's ``BaseAlgorithm.learn``; ``reset_num_timesteps=False`` goes on where training stopped."""
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    @classmethod
    def load(
        cls: type[SelfReptilePPO],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfReptilePPO:
        """Load a model. See SB3's ``BaseAlgorithm.load``.

        :param env: an environment id is accepted too; what the policy sees of its interaction is appended as it was
            in training
        """
        if env is not None:
            data, _, _ = load_from_zip_file(path, device=device, custom_objects=custom_objects)
            if isinstance(path, io.BufferedIOBase):
                path.seek(0)
            assert data is not None
            n_envs = data["n_envs"] if isinstance(env, str) else None
            env = _with_history(_make_venv(env, n_envs, data["seed"], {}), data["interaction_history"])
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Set the environment, and append the interaction history to its observations if the policy reads it."""
        super().set_env(_with_history(_make_venv(env, None, None, {}), self.interaction_history), force_reset)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "reptile", "_last_lstm_states", "_sequence_states", "_sampler"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer", "reptile.meta_optimizer"], []

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save the model; a file of the same name is replaced only when the new one is complete."""
        self.meta_iteration = self.reptile.meta_iteration
        if isinstance(path, io.BufferedIOBase):
            super().save(path, exclude, include)
            return
        path = pathlib.Path(path)
        path = path if path.suffix else path.with_suffix(".zip")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
        try:
            super().save(temporary, exclude, include)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


class _Reptile(ReptileWrapper):
    """Reptile that ends the search between two tasks."""

    model: ReptilePPO

    def _begin_task(self) -> None:
        model = self.model
        over = 1 - model._current_progress_remaining >= model.search_fraction
        if model.search is not None and model.search.searching and over:
            model.search.select(model.search.most_likely())
            # The momentum of a meta-optimizer would move W on.
            assert self.meta_optimizer is not None
            self.meta_optimizer.state.pop(model.search.logits, None)
        if model.reward_scaler is not None:
            model.reward_scaler.forget_returns()
        super()._begin_task()


def _make_venv(env: GymEnv | str, n_envs: int | None, seed: int | None, env_kwargs: Mapping[str, Any]) -> VecEnv:
    if isinstance(env, str):
        return make_fast_vec_env(env, DEFAULT_N_ENVS if n_envs is None else n_envs, seed, **env_kwargs)
    if n_envs is not None or env_kwargs:
        raise ValueError("n_envs and env_kwargs are for environment ids; the environment given is already made")
    return PPO._wrap_env(env)


def _with_history(venv: VecEnv, interaction_history: bool) -> VecEnv:
    if interaction_history and any(venv.env_is_wrapped(InteractionHistory)):
        raise ValueError(
            "an environment wrapped in InteractionHistory is not accepted; ReptilePPO appends the history itself. "
            "Give it the environment without the wrapper, or interaction_history=False"
        )
    if interaction_history and not is_vecenv_wrapped(venv, VecInteractionHistory):
        return VecInteractionHistory(venv)
    return venv


def _env_id(env: Any) -> str | None:
    """The id under which an environment, or every one of a ``VecEnv``, was made."""
    if env is None:
        return None
    spec = env.get_attr("spec")[0] if isinstance(env, VecEnv) else getattr(env, "spec", None)
    return None if spec is None else spec.id
