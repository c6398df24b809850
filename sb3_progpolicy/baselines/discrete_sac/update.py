"""The mathematics of discrete soft actor-critic: one function per equation, and one gradient step.

Equation numbers are those of Christodoulou 2019, "Soft Actor-Critic for Discrete Action Settings", arXiv:1910.07207.
Shapes: ``probs``, ``log_probs`` and Q-values are ``(batch, n_actions)``.
"""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from torch.nn import functional as F

from sb3_progpolicy.baselines.batch import Batch, CheckLoss, minimize
from sb3_progpolicy.baselines.discrete_sac.policies import DiscreteSACPolicy

TARGET_ENTROPY_FRACTION = 0.5  # of log(n_actions), unless another is given


class Losses(NamedTuple):
    """What one gradient step was made with; scalars without gradient.

    :param critic: loss, halved and summed over the critics, as in SB3's SAC
    :param actor: loss
    :param entropy: mean of the policy's on the batch, nats, before the step
    """

    critic: th.Tensor
    actor: th.Tensor
    entropy: th.Tensor


def soft_value(log_probs: th.Tensor, q_values: th.Tensor, ent_coef: th.Tensor) -> th.Tensor:
    """Return values of states, ``(batch, 1)``: the mean over actions of ``Q - ent_coef * log_prob`` (equation 10)."""
    return (log_probs.exp() * (q_values - ent_coef * log_probs)).sum(dim=1, keepdim=True)


def ent_coef_loss(log_ent_coef: th.Tensor, entropy: th.Tensor, target_entropy: float) -> th.Tensor:
    """Return the loss that raises the coefficient while the entropy is below its target.

    Equation 11 in the mean over states, for the coefficient's logarithm as in SB3's SAC.
    """
    return (log_ent_coef * (entropy - target_entropy).detach()).mean()


def policy_loss(log_probs: th.Tensor, q_values: th.Tensor, ent_coef: th.Tensor) -> th.Tensor:
    """Return the actor's loss: minus the value of the states, with gradients into the policy alone (equation 12)."""
    return -soft_value(log_probs, q_values.detach(), ent_coef).mean()


def mean_entropy(log_probs: th.Tensor) -> th.Tensor:
    """Return the mean entropy of the policies, nats."""
    return -(log_probs.exp() * log_probs).sum(dim=1).mean()


def gradient_step(policy: DiscreteSACPolicy, batch: Batch, ent_coef: th.Tensor, check: CheckLoss) -> Losses:
    """Make one step of the critics and one of the actor, both from the same Q-values.

    :param policy: whose networks and optimizers are used; its target networks are left alone
    :param batch: of transitions
    :param ent_coef: entropy coefficient, without gradient
    :param check: called with each loss before it reaches a parameter
    """
    with th.no_grad():
        next_q = th.stack(policy.critic_target(batch.next_observations)).amin(dim=0)
        next_value = soft_value(policy.actor.log_probs(batch.next_observations), next_q, ent_coef)
        target = batch.rewards + (1 - batch.dones) * batch.discounts * next_value

    q_values = policy.critic(batch.observations)
    actions = batch.actions.long()
    critic_loss = 0.5 * th.stack([F.mse_loss(q.gather(1, actions), target) for q in q_values]).sum()
    critic_loss = minimize(critic_loss, policy.critic.optimizer, check)

    log_probs = policy.actor.log_probs(batch.observations)
    actor_loss = policy_loss(log_probs, th.stack(q_values).detach().amin(dim=0), ent_coef)
    actor_loss = minimize(actor_loss, policy.actor.optimizer, check)
    return Losses(critic_loss, actor_loss, mean_entropy(log_probs.detach()))
