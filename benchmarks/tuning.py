"""The search behind the comparison: the same trials for every method on the planning domains.

Each is trained at a shortened budget and scored on validation variations (``progpolicy tune``); no unseen one is looked
at. It goes on where it was, and several processes may share a storage. The trials are written to
``benchmarks/results/tuning.csv``.

    python benchmarks/tuning.py --storage sqlite:///runs/tuning.db [--methods ppo sac] [--envs Hanoi-v0]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

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


def describe(tuning: Tuning, trial: FrozenTrial) -> dict[str, object]:
    """Return a row of the file."""
    seconds = None if trial.duration is None else round(trial.duration.total_seconds(), 1)
    return {
        "method": tuning.algo,
        "env": tuning.env,
        "trial": trial.number,
        "score": None if trial.value is None else round(trial.value, 4),
        "timesteps": trial.user_attrs.get("timesteps"),
        "stopped_at_60_s": trial.user_attrs.get("capped"),
        "wall_seconds": seconds,
        "hyperparams": json.dumps(trial.user_attrs.get("hyperparams")),
    }


def main() -> None:
    """Run the studies and write their trials."""
    compared = [name for name in METHODS if name != "recurrent_ppo"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--storage", required=True, help="database of the studies")
    parser.add_argument("--methods", nargs="+", default=compared, choices=compared)
    parser.add_argument("--envs", nargs="+", default=list(BUDGETS), choices=list(BUDGETS))
    parser.add_argument("--export", action="store_true", help="write the file of what there is, and run nothing")
    options = parser.parse_args()
    th.set_num_threads(1)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    console, rows = Console(stderr=True), []
    for env in options.envs:
        steps, episodes = BUDGETS[env]
        for method in options.methods:
            tuning = Tuning(method, env, N_TRIALS, n_timesteps=steps, max_seconds=MAX_SECONDS, episodes=episodes)
            study = open_study(tuning, options.storage)
            if not options.export:
                tune(tuning, study, lambda trial: console.print(f"{trial.number}: {trial.value}"))
                console.print(f"{method} on {env}: {study.best_value:.4f}", highlight=False)
            rows += [describe(tuning, trial) for trial in finished(study)]
    write_atomically(RESULTS, as_csv(rows))


if __name__ == "__main__":
    main()
