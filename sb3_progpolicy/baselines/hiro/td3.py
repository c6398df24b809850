"""One gradient step of TD3, for either level: SB3's own is bound to its algorithm class and its replay buffer."""

from __future__ import annotations

from dataclasses import dataclass

import torch as th
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.td3.policies import TD3Policy
from torch.nn import functional as F

from sb3_progpolicy.baselines.batch import Batch, CheckLoss, minimize


@dataclass(frozen=True)
class TD3Settings:
    """Arguments of SB3's ``TD3`` that a gradient step needs.

    :param tau: weight of the networks in each update of their targets
    :param policy_delay: critic updates for each update of actor and targets
    :param target_policy_noise: standard deviation of the noise on the target actor's actions, which are in -1 to 1
    :param target_noise_clip: bound of that noise
    """

    tau: float
    policy_delay: int
    target_policy_noise: float
    target_noise_clip: float


def critic_target(policy: TD3Policy, batch: Batch, settings: TD3Settings) -> th.Tensor:
    """Return the values that the critics learn, ``(batch, 1)``: clipped double Q with smoothed target actions."""
    with th.no_grad():
        noise = (th.randn_like(batch.actions) * settings.target_policy_noise).clamp(
            -settings.target_noise_clip, settings.target_noise_clip
        )
        next_actions = (policy.actor_target(batch.next_observations) + noise).clamp(-1, 1)
        next_q = th.cat(policy.critic_target(batch.next_observations, next_actions), dim=1).amin(dim=1, keepdim=True)
        return batch.rewards + (1 - batch.dones) * batch.discounts * next_q


def gradient_step(
    policy: TD3Policy, batch: Batch, settings: TD3Settings, n_updates: int, check: CheckLoss
) -> tuple[th.Tensor, th.Tensor | None]:
    """Make one step of the critics and, every ``policy_delay`` steps, one of the actor and the targets.

    :param policy: whose networks and optimizers are used
    :param batch: of transitions
    :param settings: of TD3
    :param n_updates: number of this step, from 1 on
    :param check: called with each loss before it reaches a parameter
    :return: the losses of critics and actor, the latter ``None`` where it was left alone; without gradient
    """
    target = critic_target(policy, batch, settings)
    q_values = policy.critic(batch.observations, batch.actions)
    loss = th.stack([F.mse_loss(q, target) for q in q_values]).sum()
    critic_loss = minimize(loss, policy.critic.optimizer, check)
    if n_updates % settings.policy_delay:
        return critic_loss, None

    observations = batch.observations
    assert isinstance(observations, th.Tensor)
    loss = -policy.critic.q1_forward(observations, policy.actor(observations)).mean()
    actor_loss = minimize(loss, policy.actor.optimizer, check)
    polyak_update(policy.critic.parameters(), policy.critic_target.parameters(), settings.tau)
    polyak_update(policy.actor.parameters(), policy.actor_target.parameters(), settings.tau)
    return critic_loss, actor_loss
