"""Damaged configurations: each is taken, or refused in one line with exit code 2. Nothing is trained."""

from __future__ import annotations

import contextlib
import io
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

from sb3_progpolicy import cli, hyperparams
from sb3_progpolicy.experiment import run

_FLAGS = ("--seed", "0", "-n", "64", "--verbose", "0")
_SMALL = ("n_envs:2", "n_steps:16", "batch_size:16", "n_epochs:1")
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2.5, 2**31, 2**63, 10**40, -0.0, 1e308, float("nan"), float("inf"), "", "x",
    "a" * 5000, "nan", "-inf", "1e999", "0x10", "lin_", "lin_0.1", "lin_-1", "lin_nan_1", "dict(a=1)", "dict(",
    "cuda", "meta",
    "Hanoi-v0", "no_module:Hanoi-v0", "os:Hanoi-v0", ":", "__import__('os')", "\u0000", "\ud7ff\n", [], {}, [1, 2],
    [[[]]], {"a": 1},
    {"a": {"b": [None]}}, {"n_discs": [1, 2]}, {"n_discs": 3}, {"depth": 0}, {"depth": 10**9}, {"cell": 3},
    {"depth": None},
)  # fmt: skip
_PIECES = (
    "[" * 3000, "{a: " * 3000, "&a [*a]", "*nowhere", "!!python/object/apply:os.system [ls]", "!!binary x", "!!bool x",
    "!!int x", "!!float x", "!!timestamp x", "2020-13-45", "2020-01-01", "!!set {1, 2}", "? [1]\n: 2", "<<: 3", "\t",
    "\n", ": ", "- ", "---\n", "%YAML 9.9\n", "'", '"', "|", "\x00", "\x85", "\ufeff", "#", "null", "1" * 6000, "=",
    "a: &a [x,x]\nb: &b [*a,*a]\n",
)  # fmt: skip


def case(rng: np.random.Generator, folder: Path) -> str:
    """Damage one configuration, give it to the command line, and look at what that says."""
    kind, damaged = tuple(_KINDS.items())[rng.integers(len(_KINDS))]
    errors = io.StringIO()
    with (
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(errors),
        damaged(rng, folder) as arguments,
    ):
        code = cli.run(arguments)
    said = errors.getvalue()
    if code == 0:
        return f"{kind}: taken"
    assert code == 2, f"{arguments} ended with {code}: {said}"
    assert said.startswith("progpolicy: "), said
    assert said.count("\n") == 1, said
    assert len(said) < 2000, f"{len(said)} characters"
    return f"{kind}: refused"


@cache
def _trained() -> Path:
    folder = Path(mkdtemp(prefix="progpolicy-fuzz-"))
    assert cli.run(["train", "-f", str(folder), *_FLAGS, "--hyperparams", *_SMALL]) == 0
    return folder / "reptile_ppo" / "Hanoi-v0_1"


@contextlib.contextmanager
def _config(rng: np.random.Generator, folder: Path) -> Any:
    shutil.copytree(_trained(), folder / "run")
    path = folder / "run" / "config.yml"
    path.write_bytes(_damage(path.read_text(), rng))
    commands = (["train", "--resume", str(path.parent), "-n", "128", "--verbose", "0"], ["show", str(path.parent)])
    with patch.object(run, "train"):
        yield commands[rng.integers(len(commands))]


@contextlib.contextmanager
def _hyperparameter_file(rng: np.random.Generator, folder: Path) -> Any:
    """A file in place of the shipped one."""
    entries = {"default": {"policy": "ProgPolicy", "n_timesteps": 100, **dict(pair.split(":") for pair in _SMALL)}}
    entries["Hanoi-v0"] = {**entries["default"], "policy_kwargs": {"depth": 2}, "env_kwargs": {"source": "random"}}
    (folder / "reptile_ppo.yml").write_bytes(_damage(yaml.safe_dump(entries), rng))
    with patch.object(hyperparams, "files", lambda _: folder), patch.object(run, "train"):
        yield ["train", "-f", str(folder), *_FLAGS]


@contextlib.contextmanager
def _pairs(flag: str, names: tuple[str, ...], rng: np.random.Generator, folder: Path) -> Any:
    value = yaml.safe_dump(_pick(_VALUES, rng), default_flow_style=True, width=10**6).removesuffix("\n...\n").strip()
    value = value if rng.random() < 0.7 else _pick(_PIECES, rng)
    pair = f"{_pick(names, rng)}:{value}" if rng.random() < 0.95 else value
    small = () if flag == "--hyperparams" else ("--hyperparams", *_SMALL)
    with patch.object(run, "train"):
        yield ["train", "-f", str(folder), *_FLAGS, *small, flag, *(_SMALL if not small else ()), pair]


def _hyperparams(rng: np.random.Generator, folder: Path) -> Any:
    names = (
        "learning_rate",
        "gamma",
        "n_steps",
        "n_envs",
        "policy",
        "policy_kwargs",
        "tasks",
        "meta_optimizer",
        "nothing",
    )
    return _pairs("--hyperparams", (*names, *run.REPTILE, "clip_range", "target_kl", "env_kwargs"), rng, folder)


def _env_kwargs(rng: np.random.Generator, folder: Path) -> Any:
    return _pairs("--env-kwargs", ("n_discs", "source", "target", "render_mode", "nothing"), rng, folder)


_KINDS: dict[str, Callable[[np.random.Generator, Path], Any]] = {
    "config.yml": _config,
    "hyperparameter file": _hyperparameter_file,
    "--hyperparams": _hyperparams,
    "--env-kwargs": _env_kwargs,
}


def _damage(text: str, rng: np.random.Generator) -> bytes:
    """Damage a value, the text, or bytes."""
    level = rng.integers(3)
    if level == 0:
        content = yaml.safe_load(text)
        for _ in range(rng.integers(1, 3)):
            _replace_a_value(content, rng)
        return yaml.safe_dump(content).encode()
    raw = text.encode()
    for _ in range(rng.integers(1, 4)):
        start, stop = sorted(rng.integers(len(raw) + 1, size=2))
        stop = stop if rng.random() < 0.3 else min(stop, start + 8)
        new = _pick(_PIECES, rng).encode() if level == 1 else rng.bytes(int(rng.integers(4)))
        raw = raw[:start] + new + raw[stop:]
    return raw


def _replace_a_value(content: Any, rng: np.random.Generator) -> None:
    places = list(_places(content))
    holder, key = places[rng.integers(len(places))]
    chance = rng.random()
    if chance < 0.1:
        del holder[key]
    elif chance < 0.2 and isinstance(holder, dict):
        holder[_pick(("nothing", "", "env", "n_envs", 3, None, True), rng)] = _pick(_VALUES, rng)
    else:
        holder[key] = _pick(_VALUES, rng)


def _places(content: Any) -> Any:
    for key in content if isinstance(content, dict) else range(len(content)):
        yield content, key
        if isinstance(content[key], (dict, list)):
            yield from _places(content[key])


def _pick(choices: Any, rng: np.random.Generator) -> Any:
    return choices[rng.integers(len(choices))]
