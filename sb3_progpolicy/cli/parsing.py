"""What the command line's arguments mean: variations and key:value pairs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from progpolicy_envs import find_domain
from sb3_progpolicy.hyperparams import parse_kwargs, parse_value, shortened

# Flags that, as in the zoo, take several values: `--hyperparams n_steps:64 gamma:0.9`.
_MANY = {"--hyperparams": ":", "-params": ":", "--env-kwargs": ":", "--set": "="}
_RANGE = re.compile(r"(\d+)-(\d+)")
MAX_VARIATIONS = 10_000
#: Help of ``--allow-pickle``.
ALLOW_PICKLE = "load a model of a stock algorithm, which runs the code in its file: only for files that you trust"


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
            raise ValueError(f"{flag} {shortened(pair)} is not accepted; give name:value")
        parsed[name] = parse_kwargs(name, value) if value.startswith("dict(") else parse_value(value)
    return parsed


def parse_variations(pairs: Iterable[str]) -> list[dict[str, Any]]:
    """Return every combination of ``["n_discs=1-4,7", "source=random"]``.

    :param pairs: texts ``name=value``, a value being a list with commas whose items may be ranges, ends included; what
        stands in brackets, as ``discs=[1,0,0]``, is one item
    :raises ValueError: if one is not of that form
    """
    values: dict[str, list[Any]] = {}
    for pair in pairs:
        name, equals, listed = pair.partition("=")
        items = [item.strip() for item in _split(listed)]
        if not equals or not name.isidentifier() or not all(items):
            raise ValueError(f"--set {shortened(pair)} is not accepted; give name=value, a list 5,6,7 or a range 1-8")
        if name in values:
            raise ValueError(f"--set {shortened(pair)} is not accepted: {name} is given twice; give all in one, as 5,6")
        values[name] = [value for item in items for value in _expand(pair, item)]
    combinations = list(product(*values.values()))
    return [dict(zip(values, combination, strict=True)) for combination in combinations]


def _split(listed: str) -> list[str]:
    """Split at the commas that are not in brackets."""
    items, depth = [""], 0
    for character in listed:
        depth += (character in "[{") - (character in "]}")
        if character == "," and depth <= 0:
            items.append("")
        else:
            items[-1] += character
    return items


def _expand(pair: str, item: str) -> Sequence[Any]:
    bounds = _RANGE.fullmatch(item)
    if bounds is None:
        return [parse_value(item)]
    low, high = (int(bound) for bound in bounds.groups())
    if not low <= high < low + MAX_VARIATIONS:
        raise ValueError(f"--set {pair!r} is not accepted; a range goes from the smaller to the larger, as 1-8")
    return range(low, high + 1)


def check_folder(output: Path, option: str = "-o") -> None:
    """Find out before the work that a file cannot be written.

    :param output: the file
    :param option: that gives it
    :raises ValueError: if its folder does not exist
    """
    if not output.parent.is_dir():
        raise ValueError(f"{option} {str(output)!r} is not accepted; the folder {str(output.parent)!r} does not exist")


def default_variations(env_id: str) -> list[dict[str, Any]]:
    """Return a domain's training sizes and all larger variations, or the environment as it is for any other id."""
    domain = find_domain(env_id)
    if domain is None:
        return [{}]
    sizes = [{domain.size: size} for size in dict.fromkeys(variation[domain.size] for variation in domain.train)]
    return [*sizes, *domain.validation, *domain.unseen]
