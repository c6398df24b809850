"""Run folders: a configuration, a model, its program if it is one, and the versions it was made with."""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import platform
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from filelock import FileLock, Timeout
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_progpolicy.experiment.config import RunConfig, parse_config
from sb3_progpolicy.experiment.methods import Method, get_method
from sb3_progpolicy.experiment.stock_files import stock_algorithm
from sb3_progpolicy.extraction import extract_program, holds_program
from sb3_progpolicy.hyperparams import read_yaml, shortened
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.vec_env.worker import interrupts_deferred

MODEL, PROGRAM, CONFIG, ARGUMENTS, VERSIONS = "model.zip", "program.json", "config.yml", "args.yml", "versions.yml"
EVALUATIONS, LOCK = "evaluations.json", ".lock"
#: Options of the command line that a resumed run goes on with, and their smallest values.
KEPT_OPTIONS = {"save_freq": None, "eval_freq": None, "eval_episodes": 1, "log_interval": 1}


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
    describe_run(folder, config, arguments)
    return folder


def describe_run(folder: Path, config: RunConfig, arguments: Mapping[str, Any]) -> None:
    """Write versions, options and configuration of a run; the configuration, which makes it a run folder, comes last.

    :param folder: of the run
    :param config: what is run
    :param arguments: the command line's options
    """
    if not (folder / VERSIONS).is_file():  # those that it was begun with
        write_atomically(folder / VERSIONS, yaml.safe_dump(versions(), sort_keys=False))
    for file, content in {ARGUMENTS: dict(arguments), CONFIG: asdict(config)}.items():
        write_atomically(folder / file, yaml.safe_dump(content, sort_keys=False))


def read_arguments(folder: str | Path) -> dict[str, Any]:
    """Return the command line's options that a run was started with, or last resumed with.

    :param folder: of the run
    :raises ValueError: if the file is damaged
    """
    path = Path(folder) / ARGUMENTS
    if not path.is_file():
        return {}
    try:
        arguments = read_yaml(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} does not hold options: it {error}") from None
    if not isinstance(arguments, dict):
        raise ValueError(f"{path} does not hold options: it is not a mapping")
    for name, least in KEPT_OPTIONS.items():
        value = arguments.get(name, least or 0)
        if isinstance(value, bool) or not isinstance(value, int) or (least is not None and value < least):
            raise ValueError(f"{path}: {name}={shortened(value)} is not accepted; it is a whole number")
    for name in ("trained_agent", "tensorboard_log"):
        if not isinstance(arguments.get(name, ""), str):
            raise ValueError(f"{path}: {name}={shortened(arguments[name])} is not accepted; it is a text")
    return arguments


@contextlib.contextmanager
def locked(folder: str | Path, wait: float = 0) -> Iterator[None]:
    """Keep other processes from training in a run folder; the lock ends with this process, however that ends.

    :param folder: of the run
    :param wait: seconds to wait for another process
    :raises ValueError: if another process has it
    """
    lock = FileLock(Path(folder) / LOCK)
    try:
        lock.acquire(timeout=wait)
    except Timeout:
        raise ValueError(f"{folder} is in use: another process trains in it") from None
    try:
        yield
    finally:
        lock.release()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide what comes of a training."""
    packages = ("sb3-progpolicy", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy")
    return {"python": platform.python_version(), **{package: _version(package) for package in packages}}


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
        described = read_yaml(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{folder} is not a run folder; it has no {CONFIG}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path} does not describe a run: it is not text") from None
    except ValueError as error:
        raise ValueError(f"{path} does not describe a run: it {error}") from None
    try:
        return parse_config(described)
    except ValueError as error:
        raise ValueError(f"{path} does not describe a run: {error}") from None


def load_model(path: str | Path, env: VecEnv | None = None, allow_pickle: bool = False, **kwargs: Any) -> BaseAlgorithm:
    """Load a model: of the algorithm that the configuration next to it names, else of the one that the file is of.

    Without a configuration these are ReptilePPO and the algorithms of Stable-Baselines3 and sb3-contrib.

    :param path: a ``.zip`` file
    :param env: environments to go on training in
    :param allow_pickle: load a file that holds pickled objects, as those of stock algorithms do. That runs whatever
        code is in it, so do it only with files that you trust
    :param kwargs: see SB3's ``BaseAlgorithm.load``
    :raises ValueError: if there is no such file, or it holds pickled objects and they are not allowed
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist; a model is a .zip file")
    config = read_config(path.parent) if (path.parent / CONFIG).is_file() else None
    stock = stock_algorithm(path) if config is None else None
    method = get_method("reptile_ppo" if config is None else config.algo)
    algorithm = stock or method.algorithm
    if "allow_pickle" in inspect.signature(algorithm.load).parameters:
        kwargs["allow_pickle"] = allow_pickle
    elif (stock is not None or not method.has_reptile) and not allow_pickle:
        raise ValueError(
            f"{path} is a model of {algorithm.__name__}, which is saved with pickle: loading it runs the code "
            "in it. If you trust the file, give --allow-pickle"
        )
    return (stock or _algorithm_of(method, config, env)).load(path, env=env, **kwargs)


def _algorithm_of(method: Method, config: RunConfig | None, env: VecEnv | None) -> type[BaseAlgorithm]:
    """Return the algorithm of a method for the action space of a run's environment."""
    if method.discrete is None or config is None:
        return method.algorithm
    if env is not None:
        return method.algorithm_for(env.action_space)
    with contextlib.closing(gym.make(config.env, **config.env_kwargs)) as single:
        return method.algorithm_for(single.action_space)


def timesteps_of(path: Path) -> int | None:
    """Return the environment steps that a saved model has been trained for, read without unpickling anything.

    :param path: a ``.zip`` file
    :return: ``None`` if it does not say
    """
    try:
        with zipfile.ZipFile(path) as archive:
            name = "model.json" if "model.json" in archive.namelist() else "data"  # "data" is SB3's
            with archive.open(name) as file:
                document = json.loads(file.read(2**24))
        return int(document.get("state", document)["num_timesteps"])
    except (OSError, zipfile.BadZipFile, ValueError, LookupError, TypeError, AttributeError, RuntimeError):
        return None


def save_results(folder: Path, model: BaseAlgorithm) -> None:
    """Write the model and, if it is one, its program to a run folder.

    A reader finds out whether a process was killed between the two: both tell their number of steps.
    """
    buffer = io.BytesIO()
    model.save(buffer)
    program = extract_program(model, env=read_config(folder).env) if holds_program(model) else None
    with interrupts_deferred():
        write_atomically(folder / MODEL, buffer.getvalue())
        if program is not None:
            program.save(folder / PROGRAM)
