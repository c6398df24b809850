"""The search behind the comparison: the same trials for every method on the planning domains.

Eight trials are trained at a shortened budget and scored on validation variations (``progpolicy tune``); no unseen one
is looked at. What is best then need not be best in the end, so the best and the values of the file can be trained with
the full budget, too (``--full``), and the better of the two goes into the file. It goes on where it was: what
``benchmarks/results/tuning.csv`` has of a study is not made again, and several processes may share a storage.

    python benchmarks/tuning.py --storage sqlite:///runs/tuning.db [--full] [--methods ppo sac] [--envs Hanoi-v0]
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
import torch as th
from optuna.trial import FrozenTrial
from rich.console import Console

from sb3_progpolicy.benchmark.export import as_csv
from sb3_progpolicy.experiment.methods import METHODS
from sb3_progpolicy.experiment.tuning import Tuning, finished, open_study, tune
from sb3_progpolicy.programs.files import write_atomically

#: Environment steps of a trial, and episodes of its evaluation on each variation.
BUDGETS = {"Hanoi-v0": (200_000, 1), "Stacking-v0": (400_000, 10), "Hiking-v0": (400_000, 10)}
N_TRIALS, MAX_SECONDS = 8, 60.0
RESULTS = Path(__file__).parent / "results" / "tuning.csv"


#: Processor time and seed of a training with the full budget, which is that of the suite.
FULL_SECONDS, FULL_SEED = 1800.0, 1000
FULL_STEPS = {"Hanoi-v0": 1_000_000, "Stacking-v0": 2_000_000, "Hiking-v0": 2_000_000}
Key = tuple[str, str, str]


def describe(tuning: Tuning, trial: FrozenTrial, budget: str) -> dict[str, object]:
    """Return a row of the file."""
    seconds = None if trial.duration is None else round(trial.duration.total_seconds(), 1)
    return {
        "method": tuning.algo,
        "env": tuning.env,
        "budget": budget,
        "trial": trial.number,
        "score": None if trial.value is None else round(trial.value, 4),
        "timesteps": trial.user_attrs.get("timesteps"),
        "stopped_by_time": trial.user_attrs.get("capped"),
        "wall_seconds": seconds,
        "hyperparams": json.dumps(trial.user_attrs.get("hyperparams")),
    }


def known_rows() -> dict[Key, list[dict[str, object]]]:
    """Return the rows that the file has, by study."""
    found: dict[Key, list[dict[str, object]]] = {}
    if RESULTS.is_file():
        for row in csv.DictReader(RESULTS.read_text(encoding="utf-8").splitlines()):
            found.setdefault((row["method"], row["env"], row["budget"]), []).append(dict(row))
    return found


def search(method: str, env: str, storage: str, report: Callable[[FrozenTrial], None]) -> list[dict[str, object]]:
    """Make the trials of a method on a domain and return their rows."""
    steps, episodes = BUDGETS[env]
    tuning = Tuning(method, env, N_TRIALS, n_timesteps=steps, max_seconds=MAX_SECONDS, episodes=episodes)
    study = open_study(tuning, storage)
    tune(tuning, study, report)
    return [describe(tuning, trial, "short") for trial in finished(study)]


def confirm(
    method: str, env: str, storage: str, report: Callable[[FrozenTrial], None], trials: list[dict[str, object]]
) -> list[dict[str, object]]:
    """Train the file's values and the best of the trials with the full budget, and return the rows."""
    best = min((row for row in trials if row["score"] not in (None, "")), key=lambda row: float(str(row["score"])))
    chosen = json.loads(str(best["hyperparams"]))
    steps, episodes = FULL_STEPS[env], BUDGETS[env][1]
    n_trials = 2 if chosen else 1
    tuning = Tuning(
        method, env, n_trials, n_timesteps=steps, max_seconds=FULL_SECONDS, episodes=episodes, seed=FULL_SEED
    )
    study = open_study(tuning, storage, f"{method} on {env}, full budget")
    if chosen and len(study.trials) < n_trials:
        study.enqueue_trial(plain(chosen, tuning), skip_if_exists=True)
    tune(tuning, study, report)
    return [describe(tuning, trial, "full") for trial in finished(study)]


def plain(chosen: dict[str, Any], tuning: Tuning) -> dict[str, Any]:
    """Return hyperparameters as Optuna has them: a list that is chosen from is there by its number."""
    found = {}
    for name, value in chosen.items():
        tried = tuning.space[name]
        listed = isinstance(tried, list) and any(isinstance(choice, list) for choice in tried)
        found[name] = tried.index(value) if listed else value
    return found


def main() -> None:
    """Run the studies and write their trials."""
    compared = [name for name in METHODS if name != "recurrent_ppo"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--storage", required=True, help="database of the studies")
    parser.add_argument("--methods", nargs="+", default=compared, choices=compared)
    parser.add_argument("--envs", nargs="+", default=list(BUDGETS), choices=list(BUDGETS))
    parser.add_argument("--full", action="store_true", help="then train the best and the file's with the full budget")
    options = parser.parse_args()
    th.set_num_threads(1)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    console = Console(stderr=True)

    def report(trial: FrozenTrial) -> None:
        console.print(f"{trial.number}: {trial.value}", highlight=False)

    for env in options.envs:
        for method in options.methods:
            console.print(f"{method} on {env}", highlight=False)
            short, full = (method, env, "short"), (method, env, "full")
            made: dict[Key, list[dict[str, object]]] = {}
            if short not in known_rows():
                made[short] = search(method, env, options.storage, report)
            if options.full and full not in known_rows():
                trials = made.get(short) or known_rows()[short]
                made[full] = confirm(method, env, options.storage, report, trials)
            if made:  # another process may have written meanwhile
                rows = known_rows() | made
                write_atomically(RESULTS, as_csv([row for key in sorted(rows) for row in rows[key]]))


if __name__ == "__main__":
    main()
