"""Learn a readable program instead of a black box: programmatic policies and Reptile for Stable-Baselines3."""

import progpolicy_envs  # registers the environments
from sb3_progpolicy.interaction import InteractionHistory, VecInteractionHistory
from sb3_progpolicy.policies import ProgrammaticPolicy, RecurrentProgrammaticPolicy
from sb3_progpolicy.reptile import ReptileWrapper
from sb3_progpolicy.reptile_ppo import ReptilePPO
from sb3_progpolicy.tasks import TaskDistribution

__all__ = [
    "InteractionHistory",
    "ProgrammaticPolicy",
    "RecurrentProgrammaticPolicy",
    "ReptilePPO",
    "ReptileWrapper",
    "TaskDistribution",
    "VecInteractionHistory",
    "progpolicy_envs",
]
