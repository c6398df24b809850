"""Run folders: a configuration, a model, its program if it is one, and the versions it was made with."""

from __future__ import annotations

import io
import platform
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_progpolicy.experiment.config import RunConfig
from sb3_progpolicy.experiment.methods import get_method
from sb3_progpolicy.extraction import extract_program, holds_program
from sb3_progpolicy.programs.files import write_atomically

MODEL, PROGRAM, CONFIG, ARGUMENTS, VERSIONS = "model.zip", "program.json", "config.yml", "args.yml", "versions.yml"
EVALUATIONS = "evaluations.json"


def create_run(log_folder: str | Path, config: RunConfig, arguments: Mapping[str, Any]) -> Path:
    """Make the folder ``<log_folder>/<algo>/<env>_<n>`` with the first free n, and describe the run in it.

    :param log_folder: folder of all runs
    :param config: what is run
    :param arguments: the command line's options, kept for the reader
    """
    parent = Path(log_folder) / config.algo
    parent.mkdir(parents=True, exist_ok=True)
    name, number = config.env.rpartition(":")[2].replace("/", "-"), 1
    while True:
        folder = parent / f"{name}_{number}"
        try:
            folder.mkdir()  # fails if another process took the number
            break
        except FileExistsError:
            number += 1
    packages = ("sb3-progpolicy", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy")
    versions = {"python": platform.python_version(), **{package: _version(package) for package in packages}}
    described = {CONFIG: asdict(config), ARGUMENTS: dict(arguments), VERSIONS: versions}
    for file, content in described.items():
        write_atomically(folder / file, yaml.safe_dump(content, sort_keys=False))
    return folder


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def read_config(folder: str | Path) -> RunConfig:
    """Read the configuration of a run folder.

    :raises ValueError: if the folder holds none, or it is damaged
    """
    path = Path(folder) / CONFIG
    try:
        return RunConfig(**yaml.safe_load(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise ValueError(f"{folder} is not a run folder; it has no {CONFIG}") from None
    except (yaml.YAMLError, TypeError, UnicodeDecodeError):
        raise ValueError(f"{path} is damaged; it does not describe a run") from None


def load_model(path: str | Path, env: VecEnv | None = None, **kwargs: Any) -> OnPolicyAlgorithm:
    """Load a model saved by any of our algorithms: the one that the configuration next to it names, or ReptilePPO.

    :param path: a ``.zip`` file; those of stock algorithms hold pickles, so load only files that you trust
    :param env: environments to go on training in
    :param kwargs: see SB3's ``BaseAlgorithm.load``
    :raises ValueError: if there is no such file
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist; a model is a .zip file")
    algo = read_config(path.parent).algo if (path.parent / CONFIG).is_file() else "reptile_ppo"
    return get_method(algo).algorithm.load(path, env=env, **kwargs)


def save_results(folder: Path, model: OnPolicyAlgorithm) -> None:
    """Write the model and, if it is one, its program to a run folder."""
    buffer = io.BytesIO()
    model.save(buffer)
    write_atomically(folder / MODEL, buffer.getvalue())
    if holds_program(model):
        extract_program(model, env=read_config(folder).env).save(folder / PROGRAM)
