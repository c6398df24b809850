"""Tuned hyperparameters, one YAML file per algorithm in the form of rl-baselines3-zoo; nothing in them is evaluated."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import yaml

from sb3_progpolicy.nearest import unknown

DEFAULT, SEARCH = "default", "search"
_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")
#: Bounds far above what real files have; damaged or hostile ones would take memory or end in a traceback.
MAX_CHARACTERS, MAX_ITEMS, MAX_DEPTH = 1_000_000, 10_000, 20


def algorithms() -> list[str]:
    """Return the names of the algorithms that there are hyperparameters for."""
    return sorted(entry.name.removesuffix(".yml") for entry in files(__name__).iterdir() if entry.name.endswith(".yml"))


def load_hyperparams(algo: str, env_id: str) -> dict[str, Any]:
    """Read the hyperparameters of an algorithm for an environment.

    :param algo: such as ``"reptile_ppo"``
    :param env_id: environment id, with or without a module prefix; one that the file does not name gets its
        ``default`` entry
    :return: values by name, as they stand in the file
    :raises ValueError: if the algorithm is not known or its file is damaged
    """
    if algo not in algorithms():
        raise unknown("algorithm", algo, algorithms())
    entries = load_entries(algo)
    entry = entries.get(env_id.rpartition(":")[2], entries.get(DEFAULT))
    if not isinstance(entry, dict):
        raise ValueError(f"{algo}.yml has no mapping of hyperparameters for {env_id} and none as {DEFAULT!r}")
    return entry


def load_entries(algo: str) -> dict[str, Any]:
    """Read the hyperparameters of an algorithm by environment id, and ``default``.

    :param algo: one of :func:`algorithms`
    :raises ValueError: if the file is damaged
    """
    return {name: entry for name, entry in _read_file(algo).items() if name != SEARCH}


def load_search(algo: str) -> dict[str, Any]:
    """Read what to try when the hyperparameters of an algorithm are tuned.

    :param algo: one of :func:`algorithms`
    :return: by name, or ``policy_kwargs.<name>``, a list of values or a mapping of ``low``, ``high`` and ``log``
    :raises ValueError: if the algorithm is not known or its file is damaged
    """
    if algo not in algorithms():
        raise unknown("algorithm", algo, algorithms())
    search = _read_file(algo).get(SEARCH, {})
    if not isinstance(search, dict):
        raise ValueError(f"{algo}.yml: {SEARCH} is not a mapping from hyperparameters to what to try")
    return search


def _read_file(algo: str) -> dict[str, Any]:
    file = files(__name__) / f"{algo}.yml"
    try:
        entries = read_yaml(file.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise ValueError(f"{algo}.yml is not text") from None
    except ValueError as error:
        raise ValueError(f"{algo}.yml {error}") from None
    if not isinstance(entries, dict):
        raise ValueError(f"{algo}.yml is not a mapping from environment ids to hyperparameters")
    return entries


def read_yaml(text: str) -> Any:
    """Return what a text denotes in YAML: texts, finite numbers, truth values, null, lists and mappings of these.

    :param text: a file's content or a value
    :raises ValueError: if it is anything else, or too long or nested too deeply; the message goes on after a name
    """
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"has {len(text)} characters; at most {MAX_CHARACTERS} are accepted")
    try:
        value = yaml.safe_load(text)
    except RecursionError:
        raise ValueError("is nested too deeply") from None
    except (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError):  # PyYAML lets some of its own slip out
        raise ValueError("is not YAML") from None
    _count_items(value, 0)
    return value


def _count_items(value: Any, depth: int) -> int:
    """Return how many items a value has with all that is in it; aliases count as often as they stand for something."""
    if depth > MAX_DEPTH:
        raise ValueError("is nested too deeply")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"holds {value}; numbers are finite")
    if value is None or isinstance(value, (str, bool, int, float)):
        return 1
    if not isinstance(value, (list, dict)):
        raise ValueError(f"holds a {type(value).__name__}; texts, numbers, true, false, null, lists and mappings do")
    if isinstance(value, dict) and not all(isinstance(key, str) for key in value):
        raise ValueError("has a name that is not a text")
    n_items = 1
    for item in value.values() if isinstance(value, dict) else value:
        n_items += _count_items(item, depth + 1)
        if n_items > MAX_ITEMS:
            raise ValueError(f"has more than {MAX_ITEMS} items")
    return n_items


def parse_value(text: str) -> Any:
    """Return the value that a text denotes in YAML; ``1e-3``, which YAML reads as a text, is a number here.

    :param text: such as ``"3"``, ``"lin_0.001"``, ``"{depth: 3}"``
    :raises ValueError: if it is not YAML, or a number is not finite
    """
    try:
        value = parse_numbers(parse_number(read_yaml(text)))
        _count_items(value, 0)
    except ValueError as error:
        raise ValueError(f"{shortened(text)} is not accepted; it {error}") from None
    return value


def shortened(value: Any) -> str:
    """Return the ``repr`` of a value for an error message, cut where it is long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of thousands of digits, or a list within a list within ...
        text = f"a {type(value).__name__}"
    return text if len(text) <= 100 else f"{text[:80]} ... {text[-10:]}"


def parse_number(value: Any) -> Any:
    """Return a text that is a number, such as ``"1e-3"``, as that number, and anything else as it is."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def parse_numbers(value: Any) -> Any:
    """Return a value with what is written as ``1e-3`` in its lists and mappings, which YAML reads as texts, as numbers.

    Other texts stay what they are, ``"12"`` too.
    """
    if isinstance(value, Mapping):
        return {name: parse_numbers(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(parse_numbers(item) for item in value)
    return float(value) if isinstance(value, str) and _EXPONENT.fullmatch(value) else value


def parse_kwargs(name: str, value: Any) -> dict[str, Any]:
    """Return keyword arguments given as a mapping or, as the zoo writes them, as ``"dict(depth=3, cell='gru')"``.

    :param name: what they are the arguments of, for the error message
    :param value: a mapping, or a text made of ``dict(...)`` and literals; nothing in it is run
    :raises ValueError: if it is neither
    """
    if value is None:
        return {}
    if isinstance(value, Mapping):
        parsed: Any = {str(key): parse_numbers(parse_number(item)) for key, item in value.items()}
    else:
        try:
            parsed = _literal(ast.parse(value[:MAX_ITEMS], mode="eval").body)
        except (TypeError, ValueError, SyntaxError, RecursionError, MemoryError):
            parsed = None
    if not isinstance(parsed, dict) or not all(isinstance(key, str) for key in parsed):
        given = shortened(value)
        raise ValueError(f"{name}={given} is not accepted; give a mapping or dict(name=value, ...) of literals")
    for key, item in parsed.items():
        if not _is_finite(item):
            raise ValueError(f"{name}: {key}={item} is not accepted; numbers are finite")
    return parsed


def _is_finite(value: Any) -> bool:
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def _literal(node: ast.expr) -> Any:
    is_dict = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dict"
    if not is_dict:
        return ast.literal_eval(node)
    assert isinstance(node, ast.Call)
    if node.args or any(keyword.arg is None for keyword in node.keywords):
        raise ValueError("dict() takes keywords only")
    return {keyword.arg: _literal(keyword.value) for keyword in node.keywords}
