"""What each part of the training is worth: one thing removed, or put in, at a time, over seeds.

    python benchmarks/ablation.py --env HikingEgo-v0 [--seeds 5] [--episodes 100] [--workers 1] [--variants NAME ...]

Each seed of each variant trains from scratch with ``sb3_progpolicy/hyperparams/reptile_ppo.yml`` but for what
:func:`variants_of` says, and is run on the training and validation variations, crisp and soft. Unseen variations are
not looked at. A finished seed is kept in ``runs/`` and one that is interrupted goes on from its last checkpoint. What
is in the file for the same settings and number of episodes is not done again, and rows of variants that are not asked
for stay. Each row names its commit.

Writes ``benchmarks/results/ablation_<env>.csv`` and a ``.json`` with command, commit and versions, and prints a table.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from domain_seeds import COLUMNS, Job, Row, run_seed
from rich.console import Console
from rich.table import Table
from study import RESULTS, commit, pool, settings_of, write_results

from sb3_progpolicy.experiment.config import make_config
from sb3_progpolicy.hyperparams import load_hyperparams

BASE = (
    "base"  # what is shipped for HikingEgo; for PandaPush what was shipped before this study: without ties, `left` read
)


def _with_policy(env_id: str, **changes: Any) -> dict[str, Any]:
    """Return the shipped ``policy_kwargs`` with some of them changed, or left out where the value is ``None``."""
    kwargs = {**load_hyperparams("reptile_ppo", env_id)["policy_kwargs"], **changes}
    return {"policy_kwargs": {name: value for name, value in kwargs.items() if value is not None}}


def variants_of(env_id: str) -> Mapping[str, Mapping[str, Any]]:
    """Return the variants of an environment: what each has in place of the shipped hyperparameters.

    :param env_id: ``"HikingEgo-v0"`` or ``"PandaPush-v0"``
    """
    if env_id == "HikingEgo-v0":
        maps = product((1, 2, 3, 4), ("valley", "comb", "fork"))
        return {
            BASE: {},
            "no ties": {"symmetric": False},
            "temperature stays 1": {"action_temperature": 1.0},
            "usual returns": {"gamma": 0.99, "gae_lambda": 0.95},
            "three maps": {"tasks": [{"n_stars": n_stars, "layout": layout} for n_stars, layout in maps]},
            "no decay": _with_policy(env_id, optimizer_kwargs={"eps": 1e-5, "fused": True}),
            "search": _with_policy(env_id, n_conditions=None, depth=3),
        }
    # Shorter than as shipped: an hour and a half of one core for each variant otherwise.
    base: dict[str, Any] = {"n_timesteps": 400_000, "symmetric": False, "ignore": []}
    variants = {
        BASE: {},
        "mixed means": _with_policy(env_id, semantics="means"),
        "noise stays": {"temperature": 1.0, "action_std": 0.5},
        "ties": {"symmetric": True},
        "dense reward": {"env_kwargs": {"reward_type": "dense"}},
        "starts in the middle": {"tasks": [{"n_objects": count, "n_done": "random"} for count in (1, 2, 3)]},
        "limits bootstrapped": {"timeouts": "bootstrap"},
        "search": _with_policy(env_id, n_conditions=None, depth=6) | {"search_fraction": 0.5, "length_coef": 0.005},
    }
    return {name: {**base, **changes} for name, changes in variants.items()}


def run_variant(job: tuple[str, str, Job]) -> list[Row]:
    """Train and evaluate one seed of a variant."""
    variant, settings, arguments = job
    return [{"variant": variant, **row, "settings": settings} for row in run_seed(arguments)]


def known_rows(path: Path) -> list[Row]:
    """Read the rows that are there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def show(rows: Sequence[Row]) -> None:
    """Print what the seeds of each variant reach on each set."""
    columns = ("success: least, median", "steps / planner's, median", "numbers, median")
    table = Table("variant", "set", "semantics", *columns)
    for variant, kind, semantics in dict.fromkeys((row["variant"], row["set"], row["semantics"]) for row in rows):
        here = [row for row in rows if (row["variant"], row["set"], row["semantics"]) == (variant, kind, semantics)]
        seeds = sorted({int(row["seed"]) for row in here})
        of_seed = [[row for row in here if int(row["seed"]) == seed] for seed in seeds]
        success = [np.mean([float(row["success_rate"]) for row in mine]) for mine in of_seed]
        ratio = [np.mean([float(row["ratio"]) for row in mine]) for mine in of_seed if mine[0]["ratio"] != ""]
        numbers = np.median([float(mine[0]["n_numbers"]) for mine in of_seed])
        table.add_row(
            *(variant, kind, semantics, f"{min(success):.1%}, {np.median(success):.1%}"),
            *(f"{np.median(ratio):.2f}" if ratio else "", f"{numbers:.0f}"),
        )
    Console(width=120).print(table)


def main() -> None:
    """Run the ablation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, choices=("HikingEgo-v0", "PandaPush-v0"), help="environment id")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds, from 0 on")
    parser.add_argument("--episodes", type=int, default=100, help="episodes on each variation")
    parser.add_argument("--workers", type=int, default=1, help="seeds trained at the same time")
    parser.add_argument("--variants", nargs="+", metavar="NAME", help="names; all by default")
    options = parser.parse_args()
    variants = variants_of(options.env)
    asked = options.variants or list(variants)
    if strange := [name for name in asked if name not in variants]:
        parser.error(f"--variants {', '.join(strange)} is not accepted; there are {', '.join(variants)}")
    loaded = commit()  # of the code that is loaded now
    name = f"ablation_{options.env.partition('-')[0].lower()}"
    path, order = RESULTS / f"{name}.csv", list(variants)
    jobs, wanted = [], set()
    for seed, variant in product(range(options.seeds), asked):
        overrides, folder = dict(variants[variant]), Path("runs") / name / variant.replace(" ", "_")
        _, settings = settings_of(make_config("reptile_ppo", options.env, seed, overrides=overrides))
        jobs.append(
            (variant, settings, Job(options.env, seed, folder, overrides, options.episodes, False, False, loaded))
        )
        wanted.add((variant, str(seed), settings, str(options.episodes)))
    known = known_rows(path)
    done = {tuple(row[key] for key in ("variant", "seed", "settings", "episodes")) for row in known} & wanted
    kept = {(variant, seed) for variant, seed, _, _ in done}
    rows: list[Row] = [row for row in known if row["variant"] not in asked or (row["variant"], row["seed"]) in kept]
    left = [job for job in jobs if (job[0], str(job[2].seed)) not in kept]
    with pool(options.workers) as workers:
        for found in workers.imap_unordered(run_variant, left):
            rows += [{**row, "commit": loaded} for row in found]
            rows.sort(key=lambda row: (order.index(row["variant"]), int(row["seed"])))
            write_results(name, ("variant", *COLUMNS, "settings", "commit"), rows, {})
            print(f"{found[0]['variant']}, seed {found[0]['seed']}: {_first(found)}", flush=True)
    show(rows)


def _first(rows: Sequence[Row]) -> str:
    """Return the success on the variations of each set, crisp, in a line."""
    crisp = [row for row in rows if row["semantics"] == "crisp"]
    return ", ".join(f"{row['variation']} {row['success_rate']:.0%}" for row in crisp)


if __name__ == "__main__":
    main()
