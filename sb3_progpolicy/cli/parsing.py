"""What the command line's arguments mean: variations, key:value pairs, and names of runs and programs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from progpolicy_envs import DOMAINS
from sb3_progpolicy.hyperparams import parse_kwargs, parse_value
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.pretrained import load_pretrained, pretrained_names
from sb3_progpolicy.programs.io import load_program
from sb3_progpolicy.programs.syntax import Program

if TYPE_CHECKING:
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

# Flags that, as in the zoo, take several values: `--hyperparams n_steps:64 gamma:0.9`.
_MANY = {"--hyperparams": ":", "-params": ":", "--env-kwargs": ":", "--set": "="}
_RANGE = re.compile(r"(\d+)-(\d+)")
MAX_VARIATIONS = 10_000


def repeat_flags(arguments: Sequence[str]) -> list[str]:
    """Write ``--set a=1 b=2`` as ``--set a=1 --set b=2``, which the command line library understands.

    :param arguments: as the shell gives them
    """
    repeated: list[str] = []
    flag: str | None = None
    fresh = False
    for argument in arguments:
        if argument in _MANY:
            flag, fresh = argument, True
        elif flag and not fresh and re.match(rf"[A-Za-z_]\w*{_MANY[flag]}", argument):
            repeated.append(flag)
        elif not fresh:
            flag = None
        fresh = argument in _MANY
        repeated.append(argument)
    return repeated


def parse_pairs(flag: str, pairs: Iterable[str]) -> dict[str, Any]:
    """Return ``["n_steps:64", ...]`` as a mapping; values are YAML, or ``dict(...)`` for ``policy_kwargs``.

    :param flag: for the error message
    :param pairs: texts
    :raises ValueError: if one is not ``name:value``
    """
    parsed: dict[str, Any] = {}
    for pair in pairs:
        name, colon, value = pair.partition(":")
        if not colon or not name.isidentifier():
            raise ValueError(f"{flag} {pair!r} is not accepted; give name:value")
        parsed[name] = parse_kwargs(name, value) if value.startswith("dict(") else parse_value(value)
    return parsed


def parse_variations(pairs: Iterable[str]) -> list[dict[str, Any]]:
    """Return every combination of ``["n_discs=1-4,7", "source=random"]``.

    :param pairs: texts ``name=value``, a value being a list with commas whose items may be ranges, ends included
    :raises ValueError: if one is not of that form
    """
    values: dict[str, list[Any]] = {}
    for pair in pairs:
        name, equals, listed = pair.partition("=")
        items = [item.strip() for item in listed.split(",")]
        if not equals or not name.isidentifier() or not all(items):
            raise ValueError(f"--set {pair!r} is not accepted; give name=value, a list 5,6,7 or a range 1-8")
        values[name] = [value for item in items for value in _expand(pair, item)]
    combinations = list(product(*values.values()))
    return [dict(zip(values, combination, strict=True)) for combination in combinations]


def _expand(pair: str, item: str) -> Sequence[Any]:
    bounds = _RANGE.fullmatch(item)
    if bounds is None:
        return [parse_value(item)]
    low, high = (int(bound) for bound in bounds.groups())
    if not low <= high < low + MAX_VARIATIONS:
        raise ValueError(f"--set {pair!r} is not accepted; a range goes from the smaller to the larger, as 1-8")
    return range(low, high + 1)


def check_folder(output: Path) -> None:
    """Find out before the work that a file cannot be written.

    :param output: the file
    :raises ValueError: if its folder does not exist
    """
    if not output.parent.is_dir():
        raise ValueError(f"-o {str(output)!r} is not accepted; the folder {str(output.parent)!r} does not exist")


def default_variations(env_id: str) -> list[dict[str, Any]]:
    """Return a domain's training sizes and its unseen variations, or the environment as it is for any other id."""
    domain = DOMAINS.get(env_id.rpartition(":")[2])
    if domain is None:
        return [{}]
    sizes = [{domain.size: size} for size in dict.fromkeys(variation[domain.size] for variation in domain.train)]
    return [*sizes, *domain.unseen]


@dataclass(frozen=True)
class Source:
    """What a name on the command line stands for.

    :param name: as given
    :param env_id: environment it was trained in, if known
    :param program: if it is one
    :param model: if it is not a program
    :param env_kwargs: constructor arguments that it was trained with
    """

    name: str
    env_id: str | None
    program: Program | None
    model: OnPolicyAlgorithm | None
    env_kwargs: dict[str, Any]


def find_source(name: str) -> Source:
    """Load a run folder, a program's ``.json``, a model's ``.zip`` or a pretrained program, in this order.

    :param name: a path or a name
    :raises ValueError: if there is nothing of that name; the message names the nearest pretrained programs
    """
    path = Path(name)
    if path.is_dir():
        return _from_run(path)
    if path.is_file() and path.suffix == ".json":
        return _from_program(name, load_program(path))
    if path.is_file() and path.suffix == ".zip":
        return _from_model(path)
    if path.suffix in (".json", ".zip") or path.is_file():
        reason = "is neither a .json nor a .zip file" if path.is_file() else "does not exist"
        raise ValueError(f"{name} {reason}; give a run folder, a program (.json), a model (.zip) or a pretrained name")
    if name.rpartition(":")[2] in pretrained_names():
        return _from_program(name, load_pretrained(name))
    raise unknown("run, file or pretrained program", name, pretrained_names())


def _from_program(name: str, program: Program, env_kwargs: dict[str, Any] | None = None) -> Source:
    env_id = program.metadata.get("env")
    if env_id is not None and not isinstance(env_id, str):
        raise ValueError(f"{name}: metadata: env={env_id!r} is not accepted; it is an environment id")
    return Source(name, env_id, program, None, env_kwargs or {})


def _from_run(folder: Path) -> Source:
    from sb3_progpolicy.training import MODEL, PROGRAM, read_config

    config = read_config(folder)
    if (folder / PROGRAM).is_file():
        return _from_program(str(folder), load_program(folder / PROGRAM), dict(config.env_kwargs))
    if not (folder / MODEL).is_file():
        raise ValueError(f"{folder} holds no model yet")
    return _from_model(folder / MODEL)


def _from_model(path: Path) -> Source:
    from sb3_progpolicy.policies import ProgrammaticActorCritic
    from sb3_progpolicy.reptile_ppo import ReptilePPO
    from sb3_progpolicy.training import CONFIG, load_model, read_config

    config = read_config(path.parent) if (path.parent / CONFIG).is_file() else None
    try:
        model = load_model(path, device="cpu")
    except ValueError:
        raise
    except Exception as error:  # unpickling a damaged file may raise anything
        raise ValueError(f"{path} is not a model that can be loaded: {error}") from None
    env_kwargs = dict(config.env_kwargs) if config else {}
    if isinstance(model, ReptilePPO) and isinstance(model.policy, ProgrammaticActorCritic):
        return _from_program(str(path), model.program(), env_kwargs)
    env_id = config.env if config else getattr(model, "env_id", None)
    return Source(str(path), env_id, None, model, env_kwargs)
