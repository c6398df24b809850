"""Suites: which methods are compared on which domains, with how many seeds, as YAML."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from progpolicy_envs import get_domain
from sb3_progpolicy.env_ids import spec_of
from sb3_progpolicy.experiment.config import MAX_SEED, RunConfig, make_config, parse_config
from sb3_progpolicy.hyperparams import read_yaml, shortened
from sb3_progpolicy.nearest import unknown

#: What a suite says besides methods, domains and seeds, with its default, which also gives the type.
SETTINGS: Mapping[str, Any] = {
    "episodes": 100,
    "max_minutes": None,
    "curve_points": 20,
    "curve_episodes": 5,
    "max_steps": None,
    "device": "cpu",
}
#: Of these, what a domain may have for itself.
OF_A_DOMAIN = ("episodes", "curve_episodes", "max_steps")


@dataclass(frozen=True)
class Cell:
    """One training with its evaluation: a method on a domain with a seed.

    :param method: its name in the suite
    :param config: of the training
    :param episodes: of the evaluation, on each variation
    :param max_seconds: processor time of the training; ``None`` for no limit
    :param curve_points: evaluations on the validation variations during training; 0 for none
    :param curve_episodes: episodes of each of them, on each variation
    :param max_steps: cap on the steps of an episode in evaluations; ``None`` for the registered one
    """

    method: str
    config: RunConfig
    episodes: int
    max_seconds: float | None = None
    curve_points: int = 0
    curve_episodes: int = 1
    max_steps: int | None = None

    @property
    def key(self) -> str:
        """What tells cells apart: a digest of all that decides the result."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:16]

    @property
    def name(self) -> str:
        """The cell in words."""
        return f"{self.method} on {self.config.env}, seed {self.config.seed}"

    def to_json(self) -> dict[str, Any]:
        """Return the cell as JSON values."""
        return asdict(self)

    @classmethod
    def from_json(cls, described: Mapping[str, Any]) -> Cell:
        """Return the cell that :meth:`to_json` described.

        :raises ValueError: if its configuration is not accepted
        """
        return cls(**{**described, "config": parse_config(described["config"])})


def cap_of(described: Mapping[str, Any]) -> int | None:
    """Return the most steps of an episode in a cell's evaluations; ``None`` where nothing caps them.

    :param described: the cell, as :meth:`Cell.to_json` has it
    """
    registered: int | None = spec_of(described["config"]["env"]).max_episode_steps
    return described["max_steps"] or registered


@dataclass(frozen=True)
class Suite:
    """A comparison.

    :param name: of the suite
    :param cells: in the order in which they are run
    """

    name: str
    cells: tuple[Cell, ...]


def load_suite(path: str | Path) -> Suite:
    """Read a suite from a YAML file and check all of it, so that nothing fails hours later.

    ``name``; ``methods``, a mapping from method to hyperparameters in place of the tuned ones (a name of your own with
    ``algo: <method>`` among them makes a variant); ``domains``, a mapping from id to hyperparameters for all methods;
    ``seeds``; ``episodes`` (100), ``max_minutes`` of processor time a training (none), ``curve_points`` (20) and
    ``curve_episodes`` (5) of the curves, ``max_steps`` of an evaluated episode (the registered cap), ``device`` (cpu).
    A domain may have ``episodes``, ``curve_episodes`` and ``max_steps`` of its own.

    :param path: of the file
    :raises ValueError: naming what is not accepted
    """
    try:
        described = read_yaml(Path(path).read_text(encoding="utf-8"))
        return parse_suite(described)
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not a suite: it is not text") from None
    except ValueError as error:
        raise ValueError(f"{path} is not a suite: {error}") from None


def parse_suite(described: Any) -> Suite:
    """Return the suite that a file describes.

    :param described: what it holds
    :raises ValueError: naming what is not accepted
    """
    if not isinstance(described, Mapping):
        raise ValueError("it is not a mapping")
    for name in described:
        if name not in ("name", "methods", "domains", "seeds", *SETTINGS):
            raise unknown("entry", name, ["name", "methods", "domains", "seeds", *SETTINGS])
    for name in ("name", "methods", "domains", "seeds"):
        if not described.get(name):
            raise ValueError(f"{name} is missing")
    if not isinstance(described["name"], str):
        raise ValueError(f"name={shortened(described['name'])} is not accepted; it is a text")
    methods, domains = (_overrides(name, described[name]) for name in ("methods", "domains"))
    seeds = described["seeds"]
    if (
        not isinstance(seeds, Sequence)
        or len(set(map(str, seeds))) < len(seeds)
        or not all(type(seed) is int and 0 <= seed <= MAX_SEED for seed in seeds)
    ):
        raise ValueError(f"seeds={shortened(seeds)} is not accepted; it is a list of different whole numbers")
    settings = {name: _setting(name, described.get(name, default)) for name, default in SETTINGS.items()}
    cells = [
        _cell(method, methods[method], env, domains[env], seed, settings)
        for seed in seeds
        for env in domains
        for method in methods
    ]
    return Suite(described["name"], tuple(cells))


def _overrides(name: str, value: Any) -> dict[str, dict[str, Any]]:
    if not isinstance(value, Mapping) or not all(isinstance(entry, (Mapping, type(None))) for entry in value.values()):
        raise ValueError(f"{name}={shortened(value)} is not accepted; it is a mapping from names to hyperparameters")
    return {key: dict(entry or {}) for key, entry in value.items()}


def _setting(name: str, value: Any) -> Any:
    if name == "device":
        if not isinstance(value, str):
            raise ValueError(f"device={shortened(value)} is not accepted; it is a text")
        return value
    least = {"max_minutes": 0.01, "curve_points": 0}.get(name, 1)
    if value is None and SETTINGS[name] is None:
        return None
    whole = name != "max_minutes"
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or value < least:
        raise ValueError(
            f"{name}={shortened(value)} is not accepted; it is a {'whole ' if whole else ''}number from {least:g}"
        )
    return value


def _cell(
    method: str, of_method: Mapping[str, Any], env: str, of_domain: Mapping[str, Any], seed: int, settings: Any
) -> Cell:
    get_domain(env)
    own = {name: _setting(name, of_domain[name]) for name in OF_A_DOMAIN if name in of_domain}
    settings = {**settings, **own}
    overrides = {name: value for name, value in of_domain.items() if name not in OF_A_DOMAIN} | dict(of_method)
    algo, env_kwargs = overrides.pop("algo", method), overrides.pop("env_kwargs", None)
    try:
        config = make_config(algo, env, seed, None, env_kwargs, overrides, settings["device"])
    except ValueError as error:
        raise ValueError(f"{method} on {env}: {error}") from None
    minutes = settings["max_minutes"]
    return Cell(
        method=method,
        config=config,
        episodes=settings["episodes"],
        max_seconds=None if minutes is None else 60.0 * minutes,
        curve_points=settings["curve_points"],
        curve_episodes=settings["curve_episodes"],
        max_steps=settings["max_steps"],
    )
