"""The mathematics of an update: pure functions of tensors (Schulman et al., 2017, *Proximal Policy Optimization*)."""

from __future__ import annotations

import torch as th

Measured = dict[str, th.Tensor]


def normalized(advantages: th.Tensor) -> th.Tensor:
    """Return the advantages of a minibatch ``(n,)`` at mean 0 and deviation 1; a single one stays as it is."""
    if len(advantages) < 2:
        return advantages
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def policy_loss(
    log_prob: th.Tensor, old_log_prob: th.Tensor, advantages: th.Tensor, clip_range: float
) -> tuple[th.Tensor, Measured]:
    """Return PPO's clipped surrogate (equation 7), to be minimised, and what is logged of it.

    :param log_prob: of the actions under the present policy, ``(n,)``
    :param old_log_prob: under the policy of the rollout, ``(n,)``
    :param advantages: ``(n,)``
    :param clip_range: epsilon of the paper
    """
    log_ratio = log_prob - old_log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    loss = -th.min(advantages * ratio, advantages * clipped).mean()
    with th.no_grad():
        measured = {
            "approx_kl": ((ratio - 1) - log_ratio).mean(),
            "clip_fraction": ((ratio - 1).abs() > clip_range).float().mean(),
        }
    return loss, measured


def entropy_loss(entropy: th.Tensor | None, log_prob: th.Tensor) -> th.Tensor:
    """Return the negative mean entropy; where it has no closed form, ``-log_prob`` estimates it, as in SB3."""
    return -(-log_prob if entropy is None else entropy).mean()


def value_loss(values: th.Tensor, old_values: th.Tensor, returns: th.Tensor, clip_range_vf: float | None) -> th.Tensor:
    """Return the squared error of the values.

    :param values: of the present critic, ``(n,)``
    :param old_values: of the critic of the rollout, ``(n,)``
    :param returns: what they should be, ``(n,)``
    :param clip_range_vf: how far values may move from the old ones; ``None`` for no limit
    """
    if clip_range_vf is not None:
        values = old_values + (values - old_values).clamp(-clip_range_vf, clip_range_vf)
    return th.nn.functional.mse_loss(returns, values)
