"""How the two levels learn from the replay buffer."""

from __future__ import annotations

import math

import torch as th
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.td3.policies import TD3Policy

from sb3_progpolicy.baselines.batch import Batch, CheckLoss
from sb3_progpolicy.baselines.discrete_sac import update as discrete_sac
from sb3_progpolicy.baselines.hiro import td3
from sb3_progpolicy.baselines.hiro.buffer import Segments, Steps
from sb3_progpolicy.baselines.hiro.goals import candidate_goals, intrinsic_reward
from sb3_progpolicy.baselines.hiro.policies import HIROPolicy

DIRECTED_REACH = 2.0  # how much farther than the largest change under random actions a goal may lie


class EntropyCoefficient(th.nn.Module):
    """The tuned entropy coefficient of a discrete low level.

    :param n_actions: number of actions
    :param learning_rate: of Adam
    """

    def __init__(self, n_actions: int, learning_rate: float) -> None:
        super().__init__()
        self.target_entropy = discrete_sac.TARGET_ENTROPY_FRACTION * math.log(n_actions)
        self.log_value = th.nn.Parameter(th.zeros(1))
        self.optimizer = th.optim.Adam(self.parameters(), lr=learning_rate)

    def value(self) -> th.Tensor:
        """Return the coefficient, without gradient."""
        return self.log_value.detach().exp()

    def step(self, entropy: th.Tensor) -> None:
        """Move the coefficient towards its target.

        :param entropy: of the policy now, nats
        """
        loss = discrete_sac.ent_coef_loss(self.log_value, entropy, self.target_entropy)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


def low_batch(policy: HIROPolicy, steps: Steps, gamma: float) -> Batch:
    """Return what the low level learns from.

    A goal is taken to hold on after its period and after the episode: the low level's task is to reach it, so its
    values do not depend on the high level, and an episode's end is neither won nor lost.

    :param policy: which says what goals mean
    :param steps: from the replay buffer
    :param gamma: discount
    """
    position, next_position = policy.positions(steps.observations), policy.positions(steps.next_observations)
    start = policy.positions(steps.starts)
    goals = policy.goals_since(steps.goals, start, position)
    next_goals = policy.goals_since(steps.goals, start, next_position)
    return Batch(
        policy.low_inputs(steps.observations, goals),
        steps.actions,
        intrinsic_reward(position, goals, next_position, policy.goal_scale),
        policy.low_inputs(steps.next_observations, next_goals),
        th.zeros(len(position), 1, device=position.device),
        gamma,
    )


def relabelled_goals(policy: HIROPolicy, segments: Segments) -> th.Tensor:
    """Return for each segment the candidate under which the low level, as it is now, most likely acts as it did.

    Off-policy correction (section 3.3, equation 6).

    :param policy: whose low level is asked
    :param segments: from the replay buffer
    :return: goals in units of the scale, ``(batch, n_goal_dims)``
    """
    positions = policy.positions(segments.observations)
    start = positions[:, 0]
    candidates = candidate_goals(segments.goals, start, policy.positions(segments.ends), policy.goal_scale)
    # (batch, candidates, steps, ...)
    goals = policy.goals_since(candidates[:, :, None], start[:, None, None], positions[:, None])
    observations = segments.observations[:, None].expand(-1, goals.shape[1], -1, -1)
    actions = segments.actions[:, None].expand(-1, goals.shape[1], -1, -1)
    with th.no_grad():
        log_probs = policy.action_log_probs(policy.low_inputs(observations, goals), actions)
    best = (log_probs * segments.mask[:, None]).sum(dim=2).argmax(dim=1)
    return candidates[th.arange(len(best)), best]


def high_batch(policy: HIROPolicy, segments: Segments, gamma: float, reward_scale: float) -> Batch:
    """Return what the high level learns from: its goals relabelled, the rewards of a segment summed.

    :param policy: both levels
    :param segments: from the replay buffer
    :param gamma: discount of a segment
    :param reward_scale: factor on rewards
    """
    return Batch(
        segments.observations[:, 0],
        relabelled_goals(policy, segments),
        reward_scale * segments.rewards,
        segments.ends,
        segments.dones,
        gamma,
    )


def low_step(
    policy: HIROPolicy,
    batch: Batch,
    settings: td3.TD3Settings,
    n_updates: int,
    coefficient: EntropyCoefficient | None,
    check: CheckLoss,
) -> tuple[th.Tensor, th.Tensor | None]:
    """Make a gradient step of the low level, by TD3 or discrete soft actor-critic.

    :param policy: both levels
    :param batch: of :func:`low_batch`
    :param settings: of TD3
    :param n_updates: number of this step, from 1 on
    :param coefficient: of a discrete low level
    :param check: called with each loss before it reaches a parameter
    :return: the losses of critics and actor, the latter ``None`` where it was left alone
    """
    low = policy.low
    if isinstance(low, TD3Policy):
        return td3.gradient_step(low, batch, settings, n_updates, check)
    assert coefficient is not None
    indices = batch.actions - int(low.action_space.start)
    losses = discrete_sac.gradient_step(low, batch._replace(actions=indices), coefficient.value(), check)
    coefficient.step(losses.entropy)
    polyak_update(low.critic.parameters(), low.critic_target.parameters(), settings.tau)
    return losses.critic, losses.actor


def measured_scale(policy: HIROPolicy, segments: Segments) -> th.Tensor:
    """Return for each goal dimension twice the largest change that was seen over a segment, 0 where there was none.

    :param policy: which says what goals address
    :param segments: from the replay buffer
    """
    change = policy.positions(segments.ends) - policy.positions(segments.observations[:, 0])
    return DIRECTED_REACH * change.abs().amax(dim=0)
