"""Several seeds on any domain: train on its training variations, then run the programs on those never seen.

    python benchmarks/domain_seeds.py --env PandaReach-v0 [--seeds 5] [--episodes 20]

Each seed trains from scratch with ``sb3_progpolicy/hyperparams/reptile_ppo.yml``, the same for all. Its program is then
run as a real if-then-else (crisp) on every training and every unseen variation, on starts that training did not use. A
finished seed is kept in ``runs/``, so that an interrupted study goes on where it was.

Writes ``benchmarks/results/<name>.csv`` and a ``.json`` with command, commit and versions.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from study import train, write_results

from progpolicy_envs import DOMAINS
from sb3_progpolicy.evaluation import evaluate_program

COLUMNS = ("seed", "set", "variation", "episodes", "success_rate", "steps_mean", "n_conditions", "train_seconds")
EVALUATION_SEED = 10_000


def run_seed(env_id: str, seed: int, folder: Path, overrides: dict[str, Any], episodes: int) -> list[dict[str, Any]]:
    """Train and evaluate one seed."""
    program = train(env_id, seed, folder, overrides)
    domain = DOMAINS[env_id]
    rows = []
    for kind, variations in (("train", domain.train), ("validation", domain.validation), ("unseen", domain.unseen)):
        results = evaluate_program(program, env_id, variations, episodes, seed=EVALUATION_SEED)
        rows += [
            {
                "seed": seed,
                "set": kind,
                "variation": ", ".join(f"{name}={value}" for name, value in row.variation.items()),
                "episodes": row.episodes,
                "success_rate": row.success_rate,
                "steps_mean": round(row.steps_mean, 2),
                "n_conditions": len(program.conditions),
                "train_seconds": program.metadata["train_seconds"],
            }
            for row in results
        ]
    return rows


def main() -> None:
    """Run the study."""
    from sb3_progpolicy.hyperparams import parse_value

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=list(DOMAINS), required=True, help="environment id")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds, from 0 on")
    parser.add_argument("--episodes", type=int, default=20, help="episodes on each variation")
    parser.add_argument("--name", help="name of the result files; that of the domain by default")
    parser.add_argument(
        "--hyperparams", nargs="*", default=[], metavar="KEY:VALUE", help="in place of the shipped ones"
    )
    options = parser.parse_args()
    overrides = {key: parse_value(value) for key, _, value in (pair.partition(":") for pair in options.hyperparams)}
    name = options.name or f"{options.env.rpartition('-')[0].lower()}_seeds"
    rows: list[dict[str, Any]] = []
    for seed in track(range(options.seeds), "Seeds"):
        rows += run_seed(options.env, seed, Path("runs") / name, overrides, options.episodes)
    write_results(name, COLUMNS, rows, overrides)
    for variation in dict.fromkeys(row["variation"] for row in rows):
        here = [row for row in rows if row["variation"] == variation]
        rates = [row["success_rate"] for row in here]
        steps = np.mean([row["steps_mean"] for row in here])
        success = f"success {np.mean(rates):.1%}, worst seed {min(rates):.0%}"
        print(f"{variation} ({here[0]['set']}): {success}, {steps:.1f} steps")


if __name__ == "__main__":
    main()
