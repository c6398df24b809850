"""Hierarchical reinforcement learning with off-policy correction."""

from sb3_progpolicy.baselines.hiro.algorithm import HIRO
from sb3_progpolicy.baselines.hiro.policies import GoalState, HIROPolicy

__all__ = ["HIRO", "GoalState", "HIROPolicy"]
