"""Tuned hyperparameters, one YAML file per algorithm in the form of rl-baselines3-zoo; nothing in them is evaluated."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import yaml

from sb3_progpolicy.nearest import unknown

DEFAULT = "default"


def algorithms() -> list[str]:
    """Return the names of the algorithms that there are hyperparameters for."""
    return sorted(entry.name.removesuffix(".yml") for entry in files(__name__).iterdir() if entry.name.endswith(".yml"))


def load_hyperparams(algo: str, env_id: str) -> dict[str, Any]:
    """Read the hyperparameters of an algorithm for an environment.

    :param algo: such as ``"reptile_ppo"``
    :param env_id: environment id, with or without a module prefix; one that the file does not name gets its
        ``default`` entry
    :return: values by name, as they stand in the file
    :raises ValueError: if the algorithm is not known
    """
    if algo not in algorithms():
        raise unknown("algorithm", algo, algorithms())
    entries = yaml.safe_load((files(__name__) / f"{algo}.yml").read_text(encoding="utf-8"))
    return dict(entries.get(env_id.rpartition(":")[2], entries[DEFAULT]))


def parse_value(text: str) -> Any:
    """Return the value that a text denotes in YAML; ``1e-3``, which YAML reads as a text, is a number here.

    :param text: such as ``"3"``, ``"lin_0.001"``, ``"{depth: 3}"``
    :raises ValueError: if it is not YAML
    """
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(f"{text!r} is not accepted; it is not a YAML value") from None
    return parse_number(value)


def parse_number(value: Any) -> Any:
    """Return a text that is a number, such as ``"1e-3"``, as that number, and anything else as it is."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def parse_kwargs(name: str, value: Any) -> dict[str, Any]:
    """Return keyword arguments given as a mapping or, as the zoo writes them, as ``"dict(depth=3, cell='gru')"``.

    :param name: what they are the arguments of, for the error message
    :param value: a mapping, or a text made of ``dict(...)`` and literals; nothing in it is run
    :raises ValueError: if it is neither
    """
    if value is None:
        return {}
    if isinstance(value, Mapping):
        return {str(key): parse_number(item) for key, item in value.items()}
    try:
        parsed = _literal(ast.parse(value, mode="eval").body)
    except (TypeError, ValueError, SyntaxError, RecursionError, MemoryError):
        parsed = None
    if not isinstance(parsed, dict) or not all(isinstance(key, str) for key in parsed):
        raise ValueError(f"{name}={value!r} is not accepted; give a mapping or dict(name=value, ...) of literals")
    return parsed


def _literal(node: ast.expr) -> Any:
    is_dict = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dict"
    if not is_dict:
        return ast.literal_eval(node)
    assert isinstance(node, ast.Call)
    if node.args or any(keyword.arg is None for keyword in node.keywords):
        raise ValueError("dict() takes keywords only")
    return {keyword.arg: _literal(keyword.value) for keyword in node.keywords}
