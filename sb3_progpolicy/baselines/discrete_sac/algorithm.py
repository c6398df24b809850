"""Soft actor-critic for discrete actions, on SB3's off-policy base."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import get_parameters_by_name, polyak_update

from sb3_progpolicy.baselines.arguments import check_action_space, check_off_policy, check_range
from sb3_progpolicy.baselines.batch import Batch
from sb3_progpolicy.baselines.discrete_sac.policies import (
    CnnPolicy,
    DiscreteActor,
    DiscreteCritic,
    DiscreteSACPolicy,
    MlpPolicy,
    MultiInputPolicy,
)
from sb3_progpolicy.baselines.discrete_sac.update import TARGET_ENTROPY_FRACTION, Losses, ent_coef_loss, gradient_step
from sb3_progpolicy.finite import check_parameters, check_step, check_update

SelfDiscreteSAC = TypeVar("SelfDiscreteSAC", bound="DiscreteSAC")

ADVICE = "A smaller learning_rate, or VecNormalize around the environment, may help"


def fraction_after(prefix: str, name: str, value: str | float, default: float) -> float | None:
    """Return the number in ``"auto"`` or ``"auto_0.5"``, or ``None`` where a plain number is given.

    :param prefix: ``"auto"``
    :param name: of the argument, for the message
    :param value: given for it
    :param default: meant by the prefix alone
    :raises ValueError: for another text, or a number that is not positive and finite
    """
    if not isinstance(value, str):
        return None
    head, separator, number = value.partition("_")
    try:
        parsed = float(number) if separator else default
    except ValueError:
        parsed = math.nan
    if head != prefix or not 0 < parsed < math.inf:
        raise ValueError(
            f"{name}={value!r} is not accepted; it is a number, {prefix!r}, or '{prefix}_' and a number above 0"
        )
    return parsed


class DiscreteSAC(OffPolicyAlgorithm):
    """Soft actor-critic for discrete actions (SAC-Discrete).

    Source: Christodoulou 2019, arXiv:1910.07207. The actor is categorical and each critic has one Q-value for each
    action, so all expectations over actions are exact sums, without sampling (equations 10 to 12). Arguments are those
    of SB3's ``SAC``, in the same order and with the same defaults; those about noise on actions have no meaning here
    and are left out.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"`` or a class
    :param env: environment, vectorised environment or id, with ``Discrete`` actions
    :param learning_rate: of actor, critics and entropy coefficient; a number or a function of the progress remaining
    :param buffer_size: transitions kept
    :param learning_starts: environment steps with uniformly drawn actions before learning begins
    :param batch_size: transitions of a gradient step
    :param tau: weight of the critics in each update of their targets, 0 to 1
    :param gamma: discount, 0 to 1
    :param train_freq: steps, or ``(n, "step")`` or ``(n, "episode")``, between updates
    :param gradient_steps: gradient steps of an update; -1 for as many as steps were made since the last
    :param replay_buffer_class: SB3's choice where ``None``
    :param replay_buffer_kwargs: its arguments
    :param optimize_memory_usage: see SB3's ``ReplayBuffer``
    :param n_steps: of the returns
    :param ent_coef: entropy coefficient (alpha); ``"auto"`` tunes it from 1, ``"auto_0.1"`` from 0.1
    :param target_update_interval: gradient steps between updates of the target critics
    :param target_entropy: in nats, which the tuned coefficient holds; ``"auto_0.98"`` for the paper's fraction of
        ``log(n_actions)``, the entropy of the uniform policy; ``"auto"`` for half of it. The paper's keeps the policy
        all but uniform; where that ends episodes, as on CartPole, the coefficient grows without bound
    :param stats_window_size: episodes in the logged means
    :param tensorboard_log: folder of the log
    :param policy_kwargs: arguments of the policy
    :param verbose: 0, 1 or 2
    :param seed: of all random numbers
    :param device: of the networks
    :param _init_setup_model: whether to make the networks now
    :raises ValueError: if an argument is out of range, or the actions are not ``Discrete``
    :raises FloatingPointError: in training, at the first observation, reward, loss or parameter that is not finite
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: DiscreteSACPolicy
    actor: DiscreteActor
    critic: DiscreteCritic
    critic_target: DiscreteCritic
    action_space: spaces.Discrete

    def __init__(
        self,
        policy: str | type[DiscreteSACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        check_off_policy(locals())
        check_range("target_update_interval", target_update_interval, 1)
        check_range("n_steps", n_steps, 1)
        if fraction_after("auto", "ent_coef", ent_coef, 1.0) is None:
            check_range("ent_coef", float(ent_coef), 0)
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
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            support_multi_env=True,
        )
        self.ent_coef, self.target_entropy = ent_coef, target_entropy
        self.target_update_interval = target_update_interval
        self.log_ent_coef: th.Tensor | None = None
        self.ent_coef_optimizer: th.optim.Adam | None = None
        if self.env is not None:
            check_action_space("DiscreteSAC", self.action_space, (spaces.Discrete,))
            self._check_target_entropy()
        if _init_setup_model:
            self._setup_model()

    def _check_target_entropy(self) -> float:
        """Return the target entropy in nats."""
        uniform = math.log(self.action_space.n)
        fraction = fraction_after("auto", "target_entropy", self.target_entropy, TARGET_ENTROPY_FRACTION)
        target = float(self.target_entropy) if fraction is None else fraction * uniform
        check_range("target_entropy", target, 0, max(uniform, 1e-12))
        return target

    def _setup_model(self) -> None:
        super()._setup_model()
        self.actor, self.critic, self.critic_target = self.policy.actor, self.policy.critic, self.policy.critic_target
        self.batch_norm_stats = get_parameters_by_name(self.critic, ["running_"])
        self.batch_norm_stats_target = get_parameters_by_name(self.critic_target, ["running_"])
        self.target_entropy = self._check_target_entropy()
        initial = fraction_after("auto", "ent_coef", self.ent_coef, 1.0)
        if initial is None:
            self.ent_coef_tensor = th.tensor(float(self.ent_coef), device=self.device)
        else:
            self.log_ent_coef = th.full((1,), math.log(initial), device=self.device, requires_grad=True)
            self.ent_coef_optimizer = th.optim.Adam([self.log_ent_coef], lr=self.lr_schedule(1))

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
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Make gradient steps on transitions from the replay buffer.

        :param gradient_steps: number of them
        :param batch_size: transitions of each
        :raises FloatingPointError: if a loss is not finite
        """
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)

        check = partial(check_update, timesteps=self.num_timesteps, advice=ADVICE)
        history: list[Losses] = []
        ent_coefs: list[float] = []
        ent_coef_losses: list[float] = []
        for step in range(gradient_steps):
            ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef.detach().exp()
            losses = gradient_step(self.policy, self._sample(batch_size), ent_coef, check)
            history.append(losses)
            ent_coefs.append(ent_coef.item())
            if self.log_ent_coef is not None:
                ent_coef_losses.append(self._update_ent_coef(losses.entropy))
            if (self._n_updates + step) % self.target_update_interval == 0:
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
        self._n_updates += gradient_steps

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/ent_coef", np.mean(ent_coefs))
        self.logger.record("train/actor_loss", np.mean([losses.actor.item() for losses in history]))
        self.logger.record("train/critic_loss", np.mean([losses.critic.item() for losses in history]))
        self.logger.record("train/entropy", np.mean([losses.entropy.item() for losses in history]))
        if ent_coef_losses:
            self.logger.record("train/ent_coef_loss", np.mean(ent_coef_losses))

    def _sample(self, batch_size: int) -> Batch:
        assert self.replay_buffer is not None
        data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
        return Batch(
            data.observations,
            data.actions - int(self.action_space.start),
            data.rewards,
            data.next_observations,
            data.dones,
            self.gamma if data.discounts is None else data.discounts,
        )

    def _update_ent_coef(self, entropy: th.Tensor) -> float:
        assert self.log_ent_coef is not None
        assert self.ent_coef_optimizer is not None
        assert isinstance(self.target_entropy, float)
        loss = ent_coef_loss(self.log_ent_coef, entropy, self.target_entropy)
        self.ent_coef_optimizer.zero_grad()
        loss.backward()
        self.ent_coef_optimizer.step()
        return loss.item()

    def learn(
        self: SelfDiscreteSAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "DiscreteSAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDiscreteSAC:
        """Train; see SB3's ``SAC.learn``.

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

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "critic", "critic_target"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "actor.optimizer", "critic.optimizer"]
        if self.ent_coef_optimizer is None:
            return state_dicts, ["ent_coef_tensor"]
        return [*state_dicts, "ent_coef_optimizer"], ["log_ent_coef"]
