"""ReptilePPO: the algorithm, PPO on whole rollouts, and what these need to know of a policy."""

from sb3_progpolicy.reptile_ppo.algorithm import ReptilePPO
from sb3_progpolicy.reptile_ppo.environments import DEFAULT_N_ENVS
from sb3_progpolicy.reptile_ppo.theta import Theta

__all__ = ["DEFAULT_N_ENVS", "ReptilePPO", "Theta"]
