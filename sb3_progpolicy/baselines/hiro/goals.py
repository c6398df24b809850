"""Goals and what follows from them: one function per definition of the paper.

Source: Nachum et al. 2018, "Data-Efficient Hierarchical Reinforcement Learning", arXiv:1805.08296. A goal is a wished
change of some numbers of the observation, called the position here, in their units. ``scale`` is the largest goal along
each dimension, 0 along one without goals: networks see goals divided by it, so in -1 to 1. Shapes: positions and goals
``(..., n_goal_dims)``, ``scale`` ``(n_goal_dims,)``.
"""

from __future__ import annotations

import torch as th

N_SAMPLED_CANDIDATES = 8
CANDIDATE_STD = 0.5  # of the scale; appendix C of the paper


def goal_transition(position: th.Tensor, goal: th.Tensor, next_position: th.Tensor) -> th.Tensor:
    """Return the goal that points to the same place from the next position, ``h(s, g, s') = s + g - s'``."""
    return position + goal - next_position


def scaled(goal: th.Tensor, scale: th.Tensor) -> th.Tensor:
    """Return goals in units of the scale, as networks see them; 0 where the scale is 0."""
    return th.where(scale > 0, goal / scale.clamp(min=1e-12), 0.0)


def intrinsic_reward(position: th.Tensor, goal: th.Tensor, next_position: th.Tensor, scale: th.Tensor) -> th.Tensor:
    """Return the low level's reward ``-||s + g - s'||`` (equation 3), ``(..., 1)``, in units of the scale.

    The units make numbers of different kinds, such as metres and metres per second, count alike.
    """
    return -scaled(goal_transition(position, goal, next_position), scale).norm(dim=-1, keepdim=True)


def candidate_goals(goals: th.Tensor, start: th.Tensor, end: th.Tensor, scale: th.Tensor) -> th.Tensor:
    """Return the goals among which relabelling chooses, ``(batch, 10, n_goal_dims)``, in units of the scale.

    They are the original, what was reached, and eight from a Gaussian around that, all within -1 to 1.

    :param goals: proposed at the start, in units of the scale, ``(batch, n_goal_dims)``
    :param start: positions in which they were proposed
    :param end: positions when the next were
    :param scale: of goals
    """
    reached = scaled(end - start, scale).unsqueeze(1)
    noise = CANDIDATE_STD * th.randn(len(goals), N_SAMPLED_CANDIDATES, goals.shape[1], device=goals.device)
    return th.cat([goals.unsqueeze(1), reached, reached + noise], dim=1).clamp(-1, 1)
