"""What the studies over seeds share: training with the shipped settings, and results that say where they come from."""

from __future__ import annotations

import csv
import io
import json
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch as th

from sb3_progpolicy.experiment.config import make_config
from sb3_progpolicy.experiment.run import build_model
from sb3_progpolicy.programs import Program
from sb3_progpolicy.programs.files import write_atomically

RESULTS = Path(__file__).parent / "results"
_PACKAGES = ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "pybullet")


def train(env_id: str, seed: int, folder: Path, overrides: dict[str, Any]) -> Program:
    """Return the program of one seed, trained now with the shipped settings or read from ``folder``.

    Its metadata hold the settings and the seconds that the training took.

    :param env_id: environment id
    :param seed: of the training
    :param folder: where programs are kept, so that an interrupted study goes on where it was
    :param overrides: hyperparameters in place of the shipped ones
    """
    config = make_config("reptile_ppo", env_id, seed, overrides=overrides, device="cpu")
    path = folder / f"seed_{seed}.json"
    settings = json.loads(json.dumps(dict(config.hyperparams)))
    if path.exists() and (program := Program.load(path)).metadata.get("hyperparams") == settings:
        return program
    th.set_num_threads(1)
    started = time.perf_counter()
    model, _ = build_model(config)
    try:
        model.learn(config.n_timesteps)
    finally:
        model.get_env().close()  # type: ignore[union-attr]
    seconds = round(time.perf_counter() - started, 1)
    program = model.program(hyperparams=settings, train_seconds=seconds)  # type: ignore[attr-defined]
    folder.mkdir(parents=True, exist_ok=True)
    program.save(path)
    return program


@cache
def commit() -> str:
    """Return the commit that was checked out when this was first asked, before a long study."""
    return subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()


def write_results(
    name: str,
    columns: Sequence[str],
    rows: Sequence[Mapping[str, Any]],
    overrides: Mapping[str, Any],
    packages: Sequence[str] = (),
) -> None:
    """Write ``results/<name>.csv`` and a ``.json`` with the command, the commit and the versions that made it.

    :param name: of the files
    :param columns: of the table
    :param rows: of the table
    :param overrides: hyperparameters in place of the shipped ones
    :param packages: whose versions are named beside those of the usual ones
    """
    RESULTS.mkdir(exist_ok=True)
    table = io.StringIO()
    writer = csv.DictWriter(table, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(RESULTS / f"{name}.csv", table.getvalue())
    origin = {
        "command": " ".join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]),
        "commit": commit(),
        "overrides": overrides,
        "versions": {
            "python": platform.python_version(),
            **{package: version(package) for package in (*_PACKAGES, *packages)},
        },
    }
    write_atomically(RESULTS / f"{name}.json", json.dumps(origin, indent=2) + "\n")
