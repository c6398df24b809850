"""Algorithms to compare with that Stable-Baselines3 does not have."""

from sb3_progpolicy.baselines.discrete_sac import DiscreteSAC
from sb3_progpolicy.baselines.hiro import HIRO

__all__ = ["HIRO", "DiscreteSAC"]
