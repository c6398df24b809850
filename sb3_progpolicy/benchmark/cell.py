"""What one cell does: train, then evaluate on every training and every unseen variation."""

from __future__ import annotations

import json
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from progpolicy_envs import get_domain
from sb3_progpolicy.benchmark.suite import Cell
from sb3_progpolicy.evaluation import evaluate_any
from sb3_progpolicy.experiment import folder as folders
from sb3_progpolicy.experiment import run
from sb3_progpolicy.experiment.budget import ProcessorTimeLimit
from sb3_progpolicy.experiment.methods import METHODS
from sb3_progpolicy.extraction import holds_program
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.vec_env.factory import simulations_in_this_process

#: Seed of the first training variation's evaluation; far from those of training.
EVALUATION_SEED = 1_000_000
NOTES, TRAINED = "notes.json", "trained.json"
SECONDS_BETWEEN_NOTES = 2.0


@dataclass(frozen=True)
class CellResult:
    """What comes of a cell, as JSON values.

    :param rows: one for each variation and, where there is a program, each of its semantics
    :param curve: evaluations on the validation variations during training
    :param program: content of its file, if there is one
    :param timesteps: environment steps made
    :param capped: whether the limit on processor time has ended the training
    :param processor_seconds: of the training, evaluations during it included
    :param wall_seconds: of training and evaluation
    :param versions: of Python and the packages
    :param commit: of the source, ``""`` where it is not in a repository
    """

    rows: list[dict[str, Any]]
    curve: list[dict[str, Any]] = field(default_factory=list)
    program: str | None = None
    timesteps: int = 0
    capped: bool = False
    processor_seconds: float = 0.0
    wall_seconds: float = 0.0
    versions: dict[str, str] = field(default_factory=dict)
    commit: str = ""


class _Notes(BaseCallback):
    """Notes every few seconds how far training is and what it has cost, for the runner and for a run that goes on."""

    def __init__(self, folder: Path, limit: ProcessorTimeLimit, wall_before: float) -> None:
        super().__init__()
        self.folder, self.limit, self.wall_before = folder, limit, wall_before
        self._started = self._noted = time.monotonic()

    def note(self) -> None:
        """Write the notes."""
        self._noted = time.monotonic()
        wall = self.wall_before + self._noted - self._started
        notes = {"timesteps": self.num_timesteps, "processor": self.limit.used, "wall": wall}
        write_atomically(self.folder / NOTES, json.dumps(notes))

    def _on_rollout_start(self) -> None:
        if time.monotonic() - self._noted >= SECONDS_BETWEEN_NOTES:
            self.note()

    def _on_step(self) -> bool:
        return True


def run_cell(cell: Cell, folder: Path) -> CellResult:
    """Train and evaluate a cell, or go on with one that was interrupted.

    It keeps to one core. The result follows from the cell alone: it is the same on every engine, and after every
    interruption. Training goes on from its last checkpoint where the method's runs can be resumed, and starts anew
    elsewhere.

    :param cell: what to do
    :param folder: of its run; made if it does not exist
    :raises Interrupted: if training was interrupted; what can be gone on with is saved
    """
    th.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    with folders.locked(folder, wait=60), simulations_in_this_process():
        model = _train(cell, folder)
        started = time.monotonic()
        rows = _evaluate(cell, model)
        env = model.get_env()
        if env is not None:
            env.close()
        notes, trained, curve = (_read(folder / name) for name in (NOTES, TRAINED, folders.EVALUATIONS))
        program = (folder / folders.PROGRAM).read_text(encoding="utf-8") if holds_program(model) else None
        return CellResult(
            rows=rows,
            curve=curve or [],
            program=program,
            timesteps=trained["timesteps"],
            capped=trained["capped"],
            processor_seconds=round(notes["processor"], 1),
            wall_seconds=round(notes["wall"] + time.monotonic() - started, 1),
            versions=folders.versions(),
            commit=commit_of_source(),
        )


def _train(cell: Cell, folder: Path) -> BaseAlgorithm:
    """Return the trained model."""
    config, resumable = cell.config, METHODS[cell.config.algo].has_reptile
    if resumable and (folder / TRAINED).is_file():
        return folders.load_model(folder / folders.MODEL, env=run.make_env(config), device=config.device)
    notes = _read(folder / NOTES) if resumable and (folder / NOTES).is_file() else {"processor": 0.0, "wall": 0.0}
    limit = ProcessorTimeLimit(cell.max_seconds or float("inf"), notes["processor"])
    noting = _Notes(folder, limit, notes["wall"])
    wrapper = None
    if resumable and (folder / folders.CONFIG).is_file():
        model, config = run.resume(folder)
    else:
        (folder / folders.EVALUATIONS).unlink(missing_ok=True)
        folders.describe_run(folder, config, {})
        model, wrapper = run.build_model(config)
    freq = -(-config.n_timesteps // cell.curve_points) if cell.curve_points else -1
    options = run.TrainingOptions(eval_freq=freq, eval_episodes=cell.curve_episodes, eval_max_steps=cell.max_steps)
    run.train(model, config, folder, wrapper, options, (limit, noting))
    noting.note()
    write_atomically(folder / TRAINED, json.dumps({"timesteps": model.num_timesteps, "capped": limit.reached}))
    return model


def _evaluate(cell: Cell, model: BaseAlgorithm) -> list[dict[str, Any]]:
    config = cell.config
    domain = get_domain(config.env)
    trained_on = run.trained_variations(config, domain)
    sets = {"train": domain.trained, "unseen": domain.unseen}
    rows = []
    for name, variations in sets.items():
        # In the form of the environment's arguments, those of the training that a variation does not give stay.
        results = evaluate_any(
            model,
            config.env,
            variations,
            cell.episodes,
            seed=EVALUATION_SEED,
            max_steps=cell.max_steps,
            env_kwargs=config.env_kwargs,
        )
        for result in results:
            if result.success_rate is None:
                raise ValueError(f"{config.env} reports no is_success at the end of an episode, which a suite counts")
            row = result.to_json()
            for column in ("env", "return_mean", "return_std"):
                del row[column]
            rows.append({"set": name, "relation": domain.relation(dict(result.variation), trained_on), **row})
    return rows


def commit_of_source() -> str:
    """Return the commit of the repository that this package is in, with ``+`` where files were changed; else ``""``."""
    here = Path(__file__).parents[1]
    try:
        commit = subprocess.run(
            ["git", "rev-parse", "--short=10", "HEAD"], cwd=here, capture_output=True, text=True, check=True
        ).stdout.strip()
        changed = subprocess.run(
            ["git", "status", "--porcelain", "--untracked-files=no", str(here)],
            cwd=here,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
    return commit + ("+" if changed else "")


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
