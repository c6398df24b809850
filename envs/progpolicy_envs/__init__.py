"""Task domains whose variations share their subroutines, as Gymnasium environments.

Importing this package registers the ids; ``gym.make("progpolicy_envs:Hanoi-v0")`` imports it by itself.
"""

import warnings
from typing import Any

import gymnasium as gym

from progpolicy_envs.domains import DOMAINS, Domain, find_domain, get_domain, register_domain

MAX_EPISODE_STEPS = 500


def register_envs() -> None:
    """Register every id that is not registered yet; nothing heavy is imported."""
    for domain in DOMAINS.values():
        if domain.entry_point and domain.id not in gym.registry:
            gym.register(
                id=domain.id,
                entry_point=domain.entry_point,
                vector_entry_point=domain.vector_entry_point or None,
                max_episode_steps=MAX_EPISODE_STEPS,
                kwargs=dict(domain.arguments),
            )


def __getattr__(name: str) -> Any:
    if name == "HIKING_EGOCENTRIC":
        warnings.warn(
            'HIKING_EGOCENTRIC is deprecated; it is DOMAINS["HikingEgo-v0"]', DeprecationWarning, stacklevel=2
        )
        return DOMAINS["HikingEgo-v0"]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register_envs()

__all__ = ["DOMAINS", "Domain", "find_domain", "get_domain", "register_domain", "register_envs"]
