"""Soft actor-critic for discrete actions."""

from sb3_progpolicy.baselines.discrete_sac.algorithm import DiscreteSAC
from sb3_progpolicy.baselines.discrete_sac.policies import CnnPolicy, DiscreteSACPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "DiscreteSAC", "DiscreteSACPolicy", "MlpPolicy", "MultiInputPolicy"]
