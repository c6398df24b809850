"""PPO whose recurrent policies train on whole rollouts: one unpadded sequence for every environment."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_progpolicy.actor_critic import for_reptile_ppo
from sb3_progpolicy.finite import check_parameters, check_step, check_update
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.normalization import NormalizingExtractor, RewardScaler
from sb3_progpolicy.policies import DERIVATION_LR_SCALE
from sb3_progpolicy.reptile_ppo import update
from sb3_progpolicy.reptile_ppo.adapters import adapt
from sb3_progpolicy.reptile_ppo.rollout import Actor, Batch, SequenceBuffer, minibatches
from sb3_progpolicy.spaces import action_spec

MAX_DEFAULT_BATCH = 2048
#: What is taken to follow where a limit of steps cuts an episode short: more of the same, or nothing.
Timeouts = Literal["bootstrap", "terminal"]


def largest_divisor(number: int, limit: int) -> int:
    """Return the largest divisor of a number up to a limit."""
    return next(divisor for divisor in range(min(number, limit), 0, -1) if number % divisor == 0)


def default_batch_size(n_steps: int, n_envs: int, learns_program: bool) -> int:
    """Return the whole rollout, up to 2048 transitions, for a program, and an eighth of it for a network.

    An update of a small program costs torch's calls, not arithmetic: few large steps are as good as many small ones and
    quicker. Where the size is less than a sequence it is the next smaller divisor of a sequence's length.
    """
    rollout = n_steps * n_envs
    size = largest_divisor(rollout, MAX_DEFAULT_BATCH) if learns_program else max(2, rollout // 8)
    return size if size >= n_steps else largest_divisor(n_steps, size)


def positive(name: str, schedule: float | Schedule, progress: float) -> float:
    """Return the value of a schedule.

    :param progress: what remains of the training, from 1 to 0
    :raises ValueError: if it is not above 0
    """
    value = float(FloatSchedule(schedule)(progress))
    if not value > 0:
        raise ValueError(f"{name}={value} is not accepted; it is above 0")
    return value


class SequencePPO(PPO):
    """PPO for networks and programs, with a state or without.

    States survive the end of an episode (section 2.4), so that a rollout is one sequence for every environment.
    Programs on the CPU act through a sampler that costs no call of torch.

    :param policy: see ``PPO``, as all that is not named here
    :param env: see ``PPO``
    :param length_coef: price on the expected number of conditions, at least 0
    :param temperature: of the conditions' sigmoid, a number or a schedule; ``None`` leaves it as the policy has it
    :param action_temperature: of discrete actions' logits, a number or a schedule; ``None`` leaves it at 1
    :param action_std: standard deviation of Box actions, a number or a schedule; ``None`` lets PPO learn it
    :param scale_rewards: divide rewards by the running deviation of the return
    :param timeouts: ``"bootstrap"`` or ``"terminal"``, see :class:`~sb3_progpolicy.ReptilePPO`
    :param ppo: arguments of ``PPO``
    :raises ValueError: if a value is not accepted
    """

    policy: ActorCriticPolicy
    rollout_buffer: SequenceBuffer

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: VecEnv | None,
        *,
        length_coef: float,
        temperature: float | Schedule | None,
        action_temperature: float | Schedule | None,
        action_std: float | Schedule | None,
        scale_rewards: bool,
        timeouts: Timeouts,
        **ppo: Any,
    ) -> None:
        if length_coef < 0:
            raise ValueError(f"length_coef={length_coef} is not accepted; it is at least 0")
        if timeouts not in get_args(Timeouts):
            raise unknown("timeouts", timeouts, get_args(Timeouts))
        self.timeouts = timeouts
        self.length_coef, self.temperature, self.action_std = length_coef, temperature, action_std
        self.action_temperature = action_temperature
        self.reward_scaler = RewardScaler(ppo["gamma"]) if scale_rewards else None
        self.rng = np.random.default_rng()
        self._last_lstm_states: RNNStates | None = None
        super().__init__(policy, env, **ppo)  # type: ignore[arg-type]

    def _setup_model(self) -> None:
        if isinstance(self.observation_space, spaces.Dict):
            raise ValueError(
                f"observation space {self.observation_space} is not accepted; {type(self).__name__} reads arrays. "
                "Wrap the environment in gymnasium.wrappers.FlattenObservation"
            )
        self.rollout_buffer_class = SequenceBuffer
        with for_reptile_ppo():
            super()._setup_model()
        self.adapter = adapt(self.policy)
        if self.recurrent and self.sequence_length < min(self.n_steps, self.batch_size):
            warnings.warn(
                f"batch_size={self.batch_size} does not divide n_steps={self.n_steps}: gradient steps are made on "
                f"{self.batch_size // self.sequence_length} sequences of {self.sequence_length} steps",
                stacklevel=2,
            )
        if self.temperature is not None and self.search is None:
            raise ValueError(f"temperature is for the conditions of programs, not for {type(self.policy).__name__}")
        if self.action_temperature is not None and (self.search is None or hasattr(self.policy, "log_std")):
            raise ValueError(f"action_temperature is for programs with discrete actions, not {self.action_space}")
        if self.action_std is not None and not hasattr(self.policy, "log_std"):
            raise ValueError(f"action_std is for Box actions, not {self.action_space}")
        self._last_lstm_states = self.adapter.initial_states(self.n_envs)

    @property
    def recurrent(self) -> bool:
        """Whether the policy has a state."""
        return self.adapter.recurrent

    @property
    def search(self) -> Any:
        """W, or ``None`` for a policy that is not a program."""
        return self.adapter.search

    @property
    def sequence_length(self) -> int:
        """Length of the sequences that gradient steps are made on; 1 for a policy without a state."""
        return largest_divisor(self.n_steps, self.batch_size) if self.recurrent else 1

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        if self.search is not None:
            self.policy.optimizer.param_groups[-1]["lr"] *= DERIVATION_LR_SCALE

    # ----------------------------------------------------------------------------------------- sample trajectories

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fill the buffer with ``n_rollout_steps`` steps of every environment.

        :return: ``False`` if a callback ended the training
        """
        assert isinstance(rollout_buffer, SequenceBuffer)
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        callback.on_rollout_start()
        self._follow_schedules()
        actor = self._actor = self.adapter.make_actor(self._last_lstm_states, rollout_buffer, n_rollout_steps, self.rng)
        length = self.sequence_length
        for step in range(n_rollout_steps):
            if self.recurrent and step % length == 0:
                rollout_buffer.sequence_states.append(actor.states)  # type: ignore[arg-type]
            actions = actor.act(self._last_obs, step)  # type: ignore[arg-type]
            new_obs, rewards, dones, infos = env.step(self._to_env(actions))
            self.num_timesteps += env.num_envs
            check_step("the reward", rewards, self.num_timesteps)
            check_step("the observation", new_obs, self.num_timesteps)
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            if self.reward_scaler is not None:
                rewards = self.reward_scaler(rewards, dones)
            if self.timeouts == "bootstrap":
                self._bootstrap_truncated(rewards, dones, infos)
            rollout_buffer.put(step, self._last_obs, actions, rewards, self._last_episode_starts)  # type: ignore[arg-type]
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
        rollout_buffer.pos, rollout_buffer.full = n_rollout_steps, True
        self._complete(rollout_buffer, actor, dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    @th.no_grad()
    def _follow_schedules(self) -> None:
        """Set the temperature and the deviation of the actions to where their schedules are."""
        progress = self._current_progress_remaining
        if self.temperature is not None:
            self.adapter.set_temperature(positive("temperature", self.temperature, progress))
        if self.action_temperature is not None:
            self.adapter.set_action_temperature(positive("action_temperature", self.action_temperature, progress))
        if self.action_std is not None:
            self.policy.log_std.fill_(math.log(positive("action_std", self.action_std, progress)))

    def _to_env(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return actions as the environment takes them."""
        if isinstance(self.action_space, spaces.Box):
            return np.clip(actions, self.action_space.low, self.action_space.high)
        if isinstance(self.action_space, spaces.Discrete) and self.action_space.start:
            return actions + self.action_space.start
        return actions

    @th.no_grad()
    def _complete(self, buffer: SequenceBuffer, actor: Actor, dones: NDArray[np.bool_]) -> None:
        self._last_lstm_states = actor.states
        actor.complete(buffer)
        last_values = self._predict_values(obs_as_tensor(self._last_obs, self.device))  # type: ignore[arg-type]
        buffer.compute_returns_and_advantage(last_values=last_values, dones=dones)

    def _predict_values(self, obs: th.Tensor, rows: Sequence[int] | slice = slice(None)) -> th.Tensor:
        return self.adapter.predict_values(obs, self._last_lstm_states, rows)

    def _bootstrap_truncated(
        self, rewards: NDArray[Any], dones: NDArray[np.bool_], infos: list[dict[str, Any]]
    ) -> None:
        """Add the value of the state at which an episode was cut short, as PPO does."""
        rows = [
            row
            for row in dones.nonzero()[0].tolist()
            if infos[row].get("TimeLimit.truncated", False) and infos[row].get("terminal_observation") is not None
        ]
        if rows:
            last = np.stack([infos[row]["terminal_observation"] for row in rows])
            with th.no_grad():
                values = self._predict_values(obs_as_tensor(last, self.device), rows)  # type: ignore[arg-type]
            rewards[rows] += self.gamma * values.cpu().numpy().ravel()

    # -------------------------------------------------------------------------------------------------- update

    def train(self, derivation: bool = False) -> None:
        """Make one PPO update from the rollout in the buffer.

        :param derivation: move W with phi frozen, instead of phi with W frozen while there is a choice left (the
            bilevel optimisation of section 2.3)
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        self._freeze(derivation=self.searching and not derivation, phi=derivation)
        rollout = self.rollout_buffer.sequences(self.sequence_length)
        if derivation:
            recorded = self.rollout_buffer.condition_values
            laid_out = None if recorded is None else self.rollout_buffer.lay_out(recorded, self.sequence_length)
            rollout = self.adapter.derivation_batch(rollout, laid_out)
        statistics: list[update.Measured] = []
        parameters = list(self.policy.parameters())
        per_batch = max(1, self.batch_size // self.sequence_length)
        for sequences in minibatches(len(rollout["advantages"]), per_batch, self.n_epochs, self.rng):
            index = th.as_tensor(sequences, device=self.device)
            loss, measured = self.loss({name: tensor[index] for name, tensor in rollout.items()}, clip_range)
            statistics.append(measured)
            if self.target_kl is not None and measured["approx_kl"] > 1.5 * self.target_kl:
                break
            check_update(loss, self.num_timesteps)
            self.policy.optimizer.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
            self.policy.optimizer.step()
        check_parameters(self.policy.named_parameters(), self.num_timesteps)
        self._freeze(derivation=False, phi=False)
        self._n_updates += self.n_epochs
        self._log(statistics, clip_range)
        observations = self.rollout_buffer.observations
        for extractor in self.policy.modules():
            if isinstance(extractor, NormalizingExtractor):
                extractor.update(observations.reshape(-1, observations.shape[-1]))

    @property
    def searching(self) -> bool:
        """Whether W has a choice left to make."""
        return self.search is not None and self.search.searching and len(self.search.logits) > 0

    def _freeze(self, derivation: bool, phi: bool) -> None:
        """Freeze W, or phi, or neither; a scheduled ``action_std`` is never trained."""
        self.adapter.freeze(derivation, phi)
        if self.action_std is not None:
            self.policy.log_std.requires_grad_(False)

    def loss(self, batch: Batch, clip_range: float) -> tuple[th.Tensor, update.Measured]:
        """Return PPO's loss with the price on length, and what is logged of it.

        :param batch: of sequences ``(n_sequences, sequence_length, ...)``
        :param clip_range: of the policy ratio
        """
        values, log_prob, entropy = self.adapter.evaluate(batch)
        advantages = batch["advantages"].flatten()
        if self.normalize_advantage:
            advantages = update.normalized(advantages)
        policy_loss, measured = update.policy_loss(log_prob, batch["log_probs"].flatten(), advantages, clip_range)
        measured |= {
            "policy_gradient_loss": policy_loss,
            "entropy_loss": update.entropy_loss(entropy, log_prob),
        }
        loss = policy_loss + self.ent_coef * measured["entropy_loss"]
        if values is not None:
            clip_vf = self.clip_range_vf and self.clip_range_vf(self._current_progress_remaining)  # type: ignore[operator]
            measured["value_loss"] = update.value_loss(
                values.flatten(), batch["values"].flatten(), batch["returns"].flatten(), clip_vf
            )
            loss = loss + self.vf_coef * measured["value_loss"]
        if self.length_coef and self.search is not None:
            loss = loss + self.length_coef * self.search.expected_conditions()
        measured["loss"] = loss
        return loss, {name: value.detach() for name, value in measured.items()}

    def _log(self, statistics: Sequence[update.Measured], clip_range: float) -> None:
        for name in statistics[0]:
            self.logger.record(f"train/{name}", th.stack([measured[name] for measured in statistics]).mean().item())
        values, returns = self.rollout_buffer.values.flatten(), self.rollout_buffer.returns.flatten()
        self.logger.record("train/explained_variance", explained_variance(values, returns))
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", self.policy.log_std.exp().mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)
        self.adapter.log(self.logger, self._actor)

    # ------------------------------------------------------------------------------------------------- predict

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
        self._check_observation(observation)
        actions, state = super().predict(observation, state, None, deterministic)
        if isinstance(self.action_space, spaces.Discrete):
            actions = np.asarray(actions + self.action_space.start)
        return actions, state

    def _check_observation(self, observation: Any) -> None:
        if isinstance(observation, tuple):
            raise ValueError(
                "a tuple is not an observation. You are probably mixing Gym API with SB3's VecEnv API: Gymnasium's "
                "reset() returns (observation, info), of which the first is to be passed; model.get_env() gives an "
                "environment whose reset() returns observations alone"
            )
        expected = self.observation_space.shape
        if len(expected or ()) != 1 or np.ndim(observation) not in (1, 2) or np.shape(observation)[-1:] == expected:
            return
        history = action_spec(self.action_space).interaction_size
        if np.shape(observation)[-1] + history == expected[0]:  # type: ignore[index]
            raise ValueError(
                f"the observation has {np.shape(observation)[-1]} numbers; the policy reads {expected[0]}, "  # type: ignore[index]
                f"of which {history} are the previous action, reward and done flag. Take observations from "
                "model.get_env(), or from the environment wrapped in sb3_progpolicy.InteractionHistory"
            )
