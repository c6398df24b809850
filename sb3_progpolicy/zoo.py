"""rl-baselines3-zoo with our algorithms and hyperparameters: ``python -m sb3_progpolicy.zoo train|enjoy ...``."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.utils import LinearSchedule

import progpolicy_envs  # noqa: F401  registers the environments
from sb3_progpolicy.experiment.config import parse_schedule
from sb3_progpolicy.experiment.methods import METHODS, Method
from sb3_progpolicy.hyperparams import load_entries
from sb3_progpolicy.nearest import unknown

COMMANDS = ("train", "enjoy")
# Schedules that the zoo reads by itself; all others of ours are read here.
_READ_BY_THE_ZOO = ("learning_rate", "clip_range", "clip_range_vf")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command of the zoo with our algorithms; all options are the zoo's.

    :param arguments: without the program's name; ``sys.argv`` by default
    :raises SystemExit: if the command is neither ``train`` nor ``enjoy``, or the zoo is not installed
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] not in COMMANDS:
        sys.exit(f"usage: python -m sb3_progpolicy.zoo {'|'.join(COMMANDS)} [the zoo's options]")
    try:
        register()
    except ModuleNotFoundError as error:
        sys.exit(f'{error.name} is missing: pip install "sb3-progpolicy[zoo]"')
    command = import_module(f"rl_zoo3.{given[0]}")
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = [f"rl_zoo3 {given[0]}", *given[1:]]
        algo = _algorithm(given)
        if given[0] == "train" and algo in _our_methods():
            file = Path(folder) / f"{algo}.yml"
            file.write_text(yaml.safe_dump(zoo_hyperparams(algo)), encoding="utf-8")
            # Before the user's options: of two files the zoo takes the last, however the option is written.
            sys.argv[1:1] = ["--conf-file", str(file)]
        getattr(command, given[0])()


def register() -> None:
    """Put our algorithms into ``rl_zoo3.ALGOS``, under the names of our methods."""
    from rl_zoo3 import ALGOS

    ALGOS.update({name: _reading_schedules(method.algorithm) for name, method in _our_methods().items()})


def zoo_hyperparams(algo: str) -> dict[str, dict[str, Any]]:
    """Return our hyperparameters of an algorithm by environment id, in values that the zoo accepts.

    The zoo wraps single environments, so the interaction history is appended there and not by the algorithm.

    :param algo: a method whose algorithm is ours
    :raises ValueError: if it is not, or the zoo has no form for a value
    """
    if algo not in _our_methods():
        raise unknown("algorithm", algo, _our_methods())
    entries = load_entries(algo)
    return {env_id: _translated(f"{algo}, {env_id}", entry) for env_id, entry in entries.items()}


def _translated(place: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    for name in _READ_BY_THE_ZOO:
        if str(entry.get(name, "")).count("_") > 1:
            raise ValueError(f"{place}: {name}={entry[name]!r} has no form in the zoo, whose schedules fall to 0")
    translated = {name: value for name, value in entry.items() if value is not None}
    limit = translated.pop("max_episode_steps", None)
    if limit is not None:  # it makes the environments, for evaluation too
        translated["env_kwargs"] = {**translated.get("env_kwargs", {}), "max_episode_steps": limit}
    if translated.pop("interaction_history", True):
        translated["env_wrapper"] = "sb3_progpolicy.InteractionHistory"
    return {**translated, "interaction_history": False}


def _our_methods() -> dict[str, Method]:
    return {name: method for name, method in METHODS.items() if method.has_reptile}


def _algorithm(arguments: Sequence[str]) -> str | None:
    """Return what ``--algo`` says, as the zoo's parser takes it."""
    parser = argparse.ArgumentParser(prog="rl_zoo3", add_help=False)
    parser.add_argument("--algo", default=None)
    found: str | None = parser.parse_known_args(arguments[1:])[0].algo
    return found


def _reading_schedules(algorithm: type[Any]) -> type[Any]:
    """Return an algorithm that reads those schedules which the zoo hands on as texts, and the zoo's own kind.

    That is no data, in which our models are saved; SB3's is.
    """
    from rl_zoo3.utils import SimpleLinearSchedule

    def read(name: str, value: Any) -> Any:
        if isinstance(value, SimpleLinearSchedule):
            return LinearSchedule(value.initial_value, 0.0, 1.0)
        return parse_schedule(name, value)

    class WithSchedules(algorithm):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **{name: read(name, value) for name, value in options.items()})

    WithSchedules.__name__ = WithSchedules.__qualname__ = algorithm.__name__
    return WithSchedules


if __name__ == "__main__":
    main()
