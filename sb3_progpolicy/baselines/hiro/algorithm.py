"""HIRO: two levels of off-policy learning, the high one of which sets goals for the low one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import safe_mean

from sb3_progpolicy.baselines.arguments import check_action_space, check_off_policy, check_range
from sb3_progpolicy.baselines.batch import CheckLoss
from sb3_progpolicy.baselines.hiro import td3
from sb3_progpolicy.baselines.hiro.buffer import GoalReplayBuffer
from sb3_progpolicy.baselines.hiro.learning import EntropyCoefficient, high_batch, low_batch, low_step, measured_scale
from sb3_progpolicy.baselines.hiro.policies import GoalState, HIROPolicy
from sb3_progpolicy.finite import check_parameters, check_step, check_update
from sb3_progpolicy.interaction import appends_history
from sb3_progpolicy.spaces import action_spec

SelfHIRO = TypeVar("SelfHIRO", bound="HIRO")

ADVICE = "A smaller learning_rate, or VecNormalize around the environment, may help"
SCALE_SEGMENTS = 4096  # drawn to measure the scale of goals


class HIRO(OffPolicyAlgorithm):
    """Hierarchical reinforcement learning with off-policy correction.

    Source: Nachum et al. 2018, "Data-Efficient Hierarchical Reinforcement Learning", arXiv:1805.08296. Every
    ``goal_period`` steps the high level proposes a goal, a wished change of some numbers of the observation; in between
    it follows the goal transition ``h(s, g, s') = s + g - s'``. The low level is paid ``-||s + g - s'||`` and nothing
    else, the high level the environment's rewards, summed. Both are TD3. When the high level learns from old segments,
    their goals are replaced by those under which the low level, as it is now, would act as it did then (off-policy
    correction).

    Where this differs from the paper: goals and distances are counted in units of ``goal_scale``, so that numbers of
    different kinds count alike; the low level's values take a goal to hold on, beyond its period and the episode's end,
    and look less far (``low_gamma``); goals stay random until the low level has learnt for a while
    (``high_learning_starts``). With ``Discrete`` actions the low level is discrete soft actor-critic, whose
    probabilities are what the correction asks for; its exploration is its entropy.

    Arguments are those of SB3's ``TD3``, in the same order, less the choice of a replay buffer, and more about goals.
    Behind ``VecNormalize``, fix its statistics before training (``env.training = False``): goals are in its units.

    :param policy: ``"MlpPolicy"`` or a class
    :param env: environment, vectorised environment or id, with observations that are vectors and ``Box`` or
        ``Discrete`` actions
    :param learning_rate: of all networks; a number or a function of the progress remaining
    :param buffer_size: steps kept
    :param learning_starts: environment steps with uniformly drawn actions before learning begins; the scale of goals is
        measured on them
    :param batch_size: steps of a gradient step of the low level, and segments of one of the high level
    :param tau: weight of the networks in each update of their targets, 0 to 1
    :param gamma: discount of the high level's steps, which are segments, 0 to 1
    :param train_freq: steps, or ``(n, "step")`` or ``(n, "episode")``, between updates
    :param gradient_steps: gradient steps of the low level in an update, -1 for as many as steps were made since the
        last
    :param action_noise: on the low level's actions, in -1 to 1; Gaussian of standard deviation 0.1 by default, and not
        accepted with ``Discrete`` actions
    :param policy_delay: critic updates for each update of an actor and the targets
    :param target_policy_noise: standard deviation of the noise on the target actors' actions
    :param target_noise_clip: bound of that noise
    :param goal_period: steps under one goal, the paper's c
    :param goal_dims: indices of the observation that goals address; all by default, but for an interaction history
    :param goal_scale: largest goal along each of them, in the observation's units, one number or one for each;
        ``"auto"`` for twice the largest change seen over ``goal_period`` of the first steps. Along what has not changed
        there are no goals
    :param goal_noise: standard deviation of the noise on goals, in units of ``goal_scale``
    :param high_learning_starts: environment steps with uniformly drawn goals, in which the low level learns to reach
        them; ``learning_starts`` at least
    :param reward_scale: factor on the rewards that the high level sums; 0.1 in the paper
    :param low_gamma: discount of the low level's steps, 0 to 1
    :param high_gradient_steps: gradient steps of the high level for every ``goal_period`` of the low level; 1 in the
        paper, whose budgets are of millions of steps
    :param stats_window_size: episodes in the logged means
    :param tensorboard_log: folder of the log
    :param policy_kwargs: arguments of the policy
    :param verbose: 0, 1 or 2
    :param seed: of all random numbers
    :param device: of the networks
    :param _init_setup_model: whether to make the networks now
    :raises ValueError: if an argument is out of range, or a space is of another kind
    :raises FloatingPointError: in training, at the first observation, reward, loss or parameter that is not finite
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": HIROPolicy}
    policy: HIROPolicy
    replay_buffer: GoalReplayBuffer | None

    def __init__(
        self,
        policy: str | type[HIROPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 1_000,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        goal_period: int = 10,
        goal_dims: Sequence[int] | None = None,
        goal_scale: str | float | Sequence[float] | NDArray[Any] = "auto",
        goal_noise: float = 0.1,
        high_learning_starts: int = 5_000,
        reward_scale: float = 0.1,
        low_gamma: float = 0.95,
        high_gradient_steps: int = 1,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        check_off_policy(locals())
        for name in ("policy_delay", "goal_period", "high_gradient_steps"):
            check_range(name, locals()[name], 1)
        for name in ("target_policy_noise", "target_noise_clip", "goal_noise", "high_learning_starts"):
            check_range(name, locals()[name], 0)
        check_range("low_gamma", low_gamma, 0, 1)
        check_range("reward_scale", reward_scale, 0, open_low=True)
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class=GoalReplayBuffer,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            support_multi_env=True,
        )
        self.goal_period, self.goal_dims, self.goal_scale = goal_period, goal_dims, goal_scale
        self.goal_noise, self.high_learning_starts, self.reward_scale = goal_noise, high_learning_starts, reward_scale
        self.low_gamma, self.high_gradient_steps = low_gamma, high_gradient_steps
        self._n_high_updates = 0
        self.policy_delay, self.target_policy_noise = policy_delay, target_policy_noise
        self.target_noise_clip = target_noise_clip
        self.ent_coef: EntropyCoefficient | None = None
        self._goal_state: GoalState | None = None
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_spaces()
        dims = self._checked_dims()
        scale = self._checked_scale(len(dims))
        self.replay_buffer_kwargs = {"n_goal_dims": len(dims), "goal_period": self.goal_period}
        given = self.policy_kwargs
        if misplaced := {"goal_dims", "goal_period"} & set(given):
            raise ValueError(f"policy_kwargs has {sorted(misplaced)}; give them as arguments of HIRO")
        # Kept apart, so that the policy_kwargs of a saved model are those given, which SB3 compares in loading.
        self.policy_kwargs = {**given, "goal_dims": dims, "goal_period": self.goal_period}
        super()._setup_model()
        self.policy_kwargs = given
        if scale is not None:
            self.policy.goal_scale.copy_(scale)
        if isinstance(self.action_space, spaces.Discrete):
            self.ent_coef = EntropyCoefficient(int(self.action_space.n), self.lr_schedule(1)).to(self.device)
        elif self.action_noise is None:
            shape = self.action_space.shape
            assert shape is not None
            self.action_noise = NormalActionNoise(np.zeros(shape), np.full(shape, 0.1))

    def _check_spaces(self) -> None:
        check_action_space("HIRO", self.action_space, (spaces.Box, spaces.Discrete))
        space = self.observation_space
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(
                f"HIRO takes observations that are vectors (one-dimensional Box); the environment has {space}. "
                "gymnasium.wrappers.FlattenObservation makes vectors of others"
            )
        if isinstance(self.action_space, spaces.Discrete) and self.action_noise is not None:
            raise ValueError("action_noise is given, but accepted only for Box actions; these are Discrete")

    def _checked_dims(self) -> list[int]:
        assert self.observation_space.shape is not None
        size = self.observation_space.shape[0]
        dims = list(range(self._n_default_dims(size)) if self.goal_dims is None else self.goal_dims)
        whole = all(isinstance(dim, (int, np.integer)) and 0 <= dim < size for dim in dims)
        if not dims or not whole or len(set(dims)) < len(dims):
            raise ValueError(
                f"goal_dims={self.goal_dims!r} is not accepted; it has one or more different indices of the "
                f"observation, from 0 to {size - 1}"
            )
        return [int(dim) for dim in dims]

    def _n_default_dims(self, size: int) -> int:
        """Return how many numbers of the observation goals address by default: those before an interaction history."""
        if (saved := (self.replay_buffer_kwargs or {}).get("n_goal_dims")) is not None:
            return int(saved)  # of a model that is loaded, perhaps without an environment that would show the history
        appended = self.env is not None and appends_history(self.env)
        return size - action_spec(self.action_space).interaction_size if appended else size

    def _checked_scale(self, n_dims: int) -> th.Tensor | None:
        """Return the scale given, ``(n_dims,)``, or ``None`` for ``"auto"``."""
        if isinstance(self.goal_scale, str) and self.goal_scale == "auto":
            if self.learning_starts < self.goal_period * self.n_envs:
                raise ValueError(
                    f"learning_starts={self.learning_starts} is too few to measure goal_scale='auto' on: a segment of "
                    f"{self.n_envs} environments is {self.goal_period * self.n_envs} steps. Raise it or give a "
                    "goal_scale"
                )
            return None
        scale: NDArray[Any]
        try:
            scale = np.broadcast_to(np.asarray(self.goal_scale, dtype=np.float32), (n_dims,))
        except ValueError:
            scale = np.zeros(1)
        if not (np.isfinite(scale) & (scale > 0)).all():
            raise ValueError(
                f"goal_scale={self.goal_scale!r} is not accepted; it is 'auto', a number above 0, or {n_dims} of them"
            )
        return th.tensor(scale)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        noise = self.action_noise
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != self.n_envs:
            self.action_noise = noise.base_noise  # a model that was loaded for another number of environments
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        assert self._last_episode_starts is not None
        if self._last_episode_starts.all():
            self._goal_state = None
        return result

    def _propose(self, observations: th.Tensor) -> th.Tensor:
        """Return goals to explore with, in units of the scale."""
        if self.num_timesteps < max(self.learning_starts, self.high_learning_starts):
            return th.rand(len(observations), len(self.policy.goal_dims), device=self.device) * 2 - 1
        goals = self.policy.high.actor(observations)
        return (goals + self.goal_noise * th.randn_like(goals)).clamp(-1, 1)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        observations, _ = self.policy.obs_to_tensor(self._last_obs)  # type: ignore[arg-type]
        assert isinstance(observations, th.Tensor)
        observations = observations.float()
        self._goal_state = self.policy.next_goals(
            observations, self._goal_state, self._last_episode_starts, self._propose
        )
        if self.num_timesteps < learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        actions = self.policy.act(observations, self._goal_state, deterministic=False).cpu().numpy()
        if not isinstance(self.action_space, spaces.Box):
            return actions, actions
        if action_noise is not None:
            actions = np.clip(actions + action_noise(), -1, 1)
        return self.policy.unscale_action(actions), actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: NDArray[Any],
        new_obs: NDArray[Any] | dict[str, NDArray[Any]],
        reward: NDArray[Any],
        dones: NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        check_step("reward", reward, self.num_timesteps)
        check_step("observation", new_obs, self.num_timesteps)
        assert isinstance(replay_buffer, GoalReplayBuffer)
        assert self._goal_state is not None
        replay_buffer.note_goals(self._goal_state.goals, self._goal_state.ages)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._last_episode_starts = np.asarray(dones, dtype=bool)

    def train(self, gradient_steps: int, batch_size: int = 256) -> None:
        """Make gradient steps of the low level, and for every ``goal_period`` of them those of the high level.

        :param gradient_steps: of the low level
        :param batch_size: steps, or segments, of each
        :raises FloatingPointError: if a loss is not finite
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self._optimizers())
        if not (self._scale_is_known or self._measure_scale()):
            return
        check = partial(check_update, timesteps=self.num_timesteps, advice=ADVICE)
        logs: dict[str, list[float]] = {}
        for _ in range(gradient_steps):
            self._n_updates += 1
            self._train_low(batch_size, check, logs)
            for _ in range(0 if self._n_updates % self.goal_period else self.high_gradient_steps):
                self._train_high(batch_size, check, logs)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for key, values in logs.items():
            self.logger.record(f"train/{key}", safe_mean(values))

    @property
    def _scale_is_known(self) -> bool:
        return bool((self.policy.goal_scale > 0).any())

    @property
    def _td3_settings(self) -> td3.TD3Settings:
        return td3.TD3Settings(self.tau, self.policy_delay, self.target_policy_noise, self.target_noise_clip)

    def _optimizers(self) -> list[th.optim.Optimizer]:
        levels = (self.policy.high, self.policy.low)
        optimizers = [network.optimizer for level in levels for network in (level.actor, level.critic)]
        return optimizers if self.ent_coef is None else [*optimizers, self.ent_coef.optimizer]

    def _measure_scale(self) -> bool:
        """Set the scale of goals once, from the segments so far, if any; those of random goals did not depend on it."""
        assert self.replay_buffer is not None
        segments = self.replay_buffer.sample_segments(SCALE_SEGMENTS, self._vec_normalize_env)
        if segments is None:
            return False
        scale = measured_scale(self.policy, segments)
        if not bool((scale > 0).any()):
            raise ValueError(
                f"goal_scale='auto' finds no change along goal_dims={self.goal_dims!r} in the first "
                f"{self.num_timesteps} steps; give a goal_scale, other goal_dims or more learning_starts"
            )
        self.policy.goal_scale.copy_(scale)
        return True

    def _train_low(self, batch_size: int, check: CheckLoss, logs: dict[str, list[float]]) -> None:
        assert self.replay_buffer is not None
        steps = self.replay_buffer.sample_steps(batch_size, self._vec_normalize_env)
        batch = low_batch(self.policy, steps, self.low_gamma)
        losses = low_step(self.policy, batch, self._td3_settings, self._n_updates, self.ent_coef, check)
        logs.setdefault("intrinsic_reward", []).append(batch.rewards.mean().item())
        if self.ent_coef is not None:
            logs.setdefault("ent_coef", []).append(self.ent_coef.value().item())
        self._note_losses("low", losses, logs)

    def _train_high(self, batch_size: int, check: CheckLoss, logs: dict[str, list[float]]) -> None:
        assert self.replay_buffer is not None
        segments = self.replay_buffer.sample_segments(batch_size, self._vec_normalize_env)
        if segments is None:
            return
        batch = high_batch(self.policy, segments, self.gamma, self.reward_scale)
        relabelled = (batch.actions != segments.goals).any(dim=1).float().mean()
        logs.setdefault("relabelled", []).append(relabelled.item())
        self._n_high_updates += 1
        losses = td3.gradient_step(self.policy.high, batch, self._td3_settings, self._n_high_updates, check)
        self._note_losses("high", losses, logs)

    def _note_losses(
        self, level: str, losses: tuple[th.Tensor, th.Tensor | None], logs: dict[str, list[float]]
    ) -> None:
        for name, loss in zip(("critic_loss", "actor_loss"), losses, strict=True):
            if loss is not None:
                logs.setdefault(f"{level}_{name}", []).append(loss.item())

    def learn(
        self: SelfHIRO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "HIRO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfHIRO:
        """Train; see SB3's ``TD3.learn``.

        :param total_timesteps: environment steps
        :param callback: called at every step
        :param log_interval: episodes between logs
        :param tb_log_name: name of the run
        :param reset_num_timesteps: whether steps are counted from 0
        :param progress_bar: whether one is shown
        :raises FloatingPointError: at the first number that is not finite
        """
        super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        check_parameters(self.policy.named_parameters(), self.num_timesteps)
        return self

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        levels = [f"policy.{level}.{net}.optimizer" for level in ("high", "low") for net in ("actor", "critic")]
        return ["policy", *levels, *([] if self.ent_coef is None else ["ent_coef", "ent_coef.optimizer"])], []
