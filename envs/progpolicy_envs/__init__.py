"""Task domains whose variations share their subroutines, as Gymnasium environments.

Importing this package registers the ids; ``gym.make("progpolicy_envs:Hanoi-v0")`` imports it by itself.
"""

import gymnasium as gym

from progpolicy_envs.domains import DOMAINS, HIKING_EGOCENTRIC, Domain, get_domain

MAX_EPISODE_STEPS = 500

_ENTRY_POINTS: dict[str, tuple[str, str]] = {
    "Hanoi-v0": ("progpolicy_envs.hanoi:HanoiEnv", "progpolicy_envs.hanoi:HanoiVectorEnv"),
    "Hiking-v0": ("progpolicy_envs.hiking:HikingEnv", "progpolicy_envs.hiking:HikingVectorEnv"),
    "Stacking-v0": ("progpolicy_envs.stacking:StackingEnv", "progpolicy_envs.stacking:StackingVectorEnv"),
    "PandaReach-v0": ("progpolicy_envs.panda:PandaReachEnv", "progpolicy_envs.panda.vector:PandaReachVectorEnv"),
    "PandaPush-v0": ("progpolicy_envs.panda:PandaPushEnv", "progpolicy_envs.panda.vector:PandaPushVectorEnv"),
    "PandaSlide-v0": ("progpolicy_envs.panda:PandaSlideEnv", "progpolicy_envs.panda.vector:PandaSlideVectorEnv"),
    "PandaStack-v0": ("progpolicy_envs.panda:PandaStackEnv", "progpolicy_envs.panda.vector:PandaStackVectorEnv"),
}


def register_envs() -> None:
    """Register every id that is not registered yet; nothing heavy is imported."""
    for env_id, (entry_point, vector_entry_point) in _ENTRY_POINTS.items():
        if env_id not in gym.registry:
            gym.register(
                id=env_id,
                entry_point=entry_point,
                vector_entry_point=vector_entry_point,
                max_episode_steps=MAX_EPISODE_STEPS,
            )


register_envs()

__all__ = ["DOMAINS", "HIKING_EGOCENTRIC", "Domain", "get_domain", "register_envs"]
