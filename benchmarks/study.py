"""What the studies over seeds share: training with the shipped settings, and results that say where they come from."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_progpolicy.experiment.config import RunConfig, make_config
from sb3_progpolicy.experiment.folder import CONFIG, MODEL, describe_run, load_model, timesteps_of
from sb3_progpolicy.experiment.run import TrainingOptions, build_model, resume
from sb3_progpolicy.experiment.run import train as train_run
from sb3_progpolicy.hyperparams import parse_value
from sb3_progpolicy.programs import Program
from sb3_progpolicy.programs.files import write_atomically

RESULTS = Path(__file__).parent / "results"
SAVE_FREQ = 250_000  # environment steps between two checkpoints
_PACKAGES = ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "pybullet")


def overrides_from(pairs: Iterable[str]) -> dict[str, Any]:
    """Return the hyperparameters that texts of the form ``key:value`` give."""
    return {key: parse_value(value) for key, _, value in (pair.partition(":") for pair in pairs)}


def train(env_id: str, seed: int, folder: Path, overrides: dict[str, Any]) -> Program:
    """Return the program of one seed, trained now with the shipped settings or read from ``folder``.

    A training that was killed goes on from its last checkpoint, to the same program. Its metadata hold the settings and
    the seconds of the processor that the training took.

    :param env_id: environment id
    :param seed: of the training
    :param folder: where programs and checkpoints are kept
    :param overrides: hyperparameters in place of the shipped ones
    """
    config = make_config("reptile_ppo", env_id, seed, overrides=overrides, device="cpu")
    path = folder / f"seed_{seed}.json"
    settings, digest = settings_of(config)
    if path.exists() and (program := Program.load(path)).metadata.get("hyperparams") == settings:
        return program
    th.set_num_threads(1)
    run, clock = folder / f"seed_{seed}_{digest}", _Clock(folder / f"seed_{seed}_{digest}" / "processor_seconds")
    trained = timesteps_of(run / MODEL) if (run / MODEL).exists() else None
    if trained is not None and trained >= config.n_timesteps:  # killed between its end and its program
        program = load_model(run / MODEL).program(hyperparams=settings, train_seconds=clock.seconds)  # type: ignore[attr-defined]
        program.save(path)
        return program
    if (run / CONFIG).exists():
        model, _ = resume(run)
    else:
        run.mkdir(parents=True, exist_ok=True)
        describe_run(run, config, {})
        model, _ = build_model(config)
    try:
        train_run(model, config, run, options=TrainingOptions(save_freq=SAVE_FREQ), callbacks=[clock])
        program = model.program(hyperparams=settings, train_seconds=clock.seconds)  # type: ignore[attr-defined]
    finally:
        model.get_env().close()  # type: ignore[union-attr]
    program.save(path)
    shutil.rmtree(run)
    return program


def settings_of(config: RunConfig) -> tuple[dict[str, Any], str]:
    """Return all hyperparameters of a training, and eight hexadecimal digits that tell them from others."""
    settings = json.loads(json.dumps(dict(config.hyperparams)))
    return settings, hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]


class _Clock(BaseCallback):
    """Counts the seconds of the processor that a training takes, those before it was interrupted, too.

    :param path: where they are kept
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self._started = path, time.process_time()
        self._before = float(path.read_text()) if path.exists() else 0.0
        self._kept = self._before

    @property
    def seconds(self) -> float:
        """So far."""
        return round(self._before + time.process_time() - self._started, 1)

    def _on_rollout_start(self) -> None:
        if self.seconds > self._kept + 1:
            self._kept = self.seconds
            write_atomically(self.path, str(self.seconds))

    def _on_step(self) -> bool:
        return True


def pool(workers: int) -> Pool:
    """Return processes to train in, each with a core of its own where there are enough.

    A training then starts no processes for its environments, which would only be in the way of the others.

    :param workers: number of processes
    """
    context = multiprocessing.get_context("spawn")
    if workers == 1 or not hasattr(os, "sched_setaffinity"):
        return context.Pool(workers)
    cores = context.Queue()
    for core in (available := sorted(os.sched_getaffinity(0))):
        cores.put(core)
    for place in range(workers - len(available)):
        cores.put(available[place % len(available)])
    return context.Pool(workers, _keep_to_one_core, (cores,))


def _keep_to_one_core(cores: multiprocessing.Queue[int]) -> None:
    os.sched_setaffinity(0, {cores.get()})


@cache
def commit() -> str:
    """Return the commit that was checked out when this was first asked, before a long study.

    In a copy of the files without a repository it is what the environment variable ``PROGPOLICY_COMMIT`` says.

    :raises RuntimeError: if neither is there: results have to name their commit
    """
    asked = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    if found := asked.stdout.strip() or os.environ.get("PROGPOLICY_COMMIT"):
        return found
    raise RuntimeError(
        f"the commit is not known ({asked.stderr.strip()}); run this in a clone, or set PROGPOLICY_COMMIT to it"
    )


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
