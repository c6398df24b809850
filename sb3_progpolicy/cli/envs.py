"""``progpolicy envs``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sb3_progpolicy.cli.streams import plain_console, quiet_stdout


def envs() -> None:
    """List the environments with their parameters and their training, validation and unseen variations."""
    from rich.table import Table

    from progpolicy_envs import DOMAINS

    table = Table(show_lines=True)
    for name in ("environment", "parameters", "trained on", "validation", "unseen"):
        table.add_column(name, overflow="fold")
    for domain in DOMAINS.values():
        try:
            with quiet_stdout():
                parameters = [f"{name}: {parameter.allowed}" for name, parameter in _parameters(domain.id).items()]
        except ModuleNotFoundError as error:
            parameters = [str(error)]
        table.add_row(
            domain.id,
            "\n".join(parameters),
            _listed(domain.train),
            _listed(domain.validation),
            _listed(domain.unseen),
        )
    plain_console().print(table)


def _parameters(env_id: str) -> Mapping[str, Any]:
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    return getattr(load_env_creator(str(gym.spec(env_id).entry_point)), "variations", {})


def _listed(variations: Any) -> str:
    values: dict[str, dict[str, None]] = {}
    for variation in variations:
        for name, value in variation.items():
            values.setdefault(name, {})[str(value)] = None
    return "\n".join(f"{name}: {', '.join(seen)}" for name, seen in values.items())
