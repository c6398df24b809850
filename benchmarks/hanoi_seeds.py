"""Ten seeds on Hanoi: train on 1-4 discs with the shipped settings, then solve sizes never seen.

    python benchmarks/hanoi_seeds.py

Each seed trains from scratch with ``sb3_progpolicy/hyperparams/reptile_ppo.yml``, the same for all. Its program is then
run once on every size, soft and crisp: 1-8 discs with the usual cap of 500 steps, 9 and 10 with the cap lifted to four
times the optimum. A finished seed is kept in ``runs/``, so that an interrupted study goes on where it was.

Writes ``benchmarks/results/<name>.csv``, a plot and a ``.json`` with command, commit and versions.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.progress import track
from study import RESULTS, overrides_from, pool, train, write_results

from sb3_progpolicy.evaluation import Evaluation, evaluate_program
from sb3_progpolicy.programs import Program
from sb3_progpolicy.programs.files import write_atomically

SIZES, LONG_SIZES = range(1, 9), (9, 10)
TRAINED_SIZES = range(1, 5)
COLUMNS = ("seed", "n_discs", "semantics", "steps", "optimal_steps", "success", "n_conditions", "train_seconds")


def evaluate(program: Program) -> Iterator[Evaluation]:
    """Run a program on every size, soft and crisp."""
    for semantics in ("soft", "crisp"):
        yield from evaluate_program(program, "Hanoi-v0", [{"n_discs": n} for n in SIZES], semantics=semantics)
        for n_discs in LONG_SIZES:
            cap = 4 * (2**n_discs - 1)
            yield from evaluate_program(program, "Hanoi-v0", [{"n_discs": n_discs}], semantics=semantics, max_steps=cap)


def run_seed(job: tuple[int, Path, dict[str, Any]]) -> list[dict[str, Any]]:
    """Train and evaluate one seed."""
    seed, folder, overrides = job
    program = train("Hanoi-v0", seed, folder, overrides)
    return [
        {
            "seed": seed,
            "n_discs": row.variation["n_discs"],
            "semantics": row.semantics,
            "steps": int(row.steps_mean),
            "optimal_steps": 2 ** row.variation["n_discs"] - 1,
            "success": int(row.success_rate),
            "n_conditions": len(program.conditions),
            "train_seconds": program.metadata["train_seconds"],
        }
        for row in evaluate(program)
    ]


def plot(name: str, rows: list[dict[str, Any]]) -> None:
    """Draw the steps of every seed over the number of discs, as a multiple of the optimum."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.2, 4), layout="constrained")
    seeds = sorted({row["seed"] for row in rows})
    sizes = [*SIZES, *LONG_SIZES]
    axes.axvspan(0.5, TRAINED_SIZES[-1] + 0.5, color="#e8eef5", zorder=0)
    axes.text(0.6, 4.6, "trained on", color="#5b6b7b", va="top")
    axes.text(TRAINED_SIZES[-1] + 0.6, 4.6, "never seen", color="#5b6b7b", va="top")
    for i, seed in enumerate(seeds):
        crisp = {row["n_discs"]: row for row in rows if row["seed"] == seed and row["semantics"] == "crisp"}
        spread = 0.5 * (i / max(1, len(seeds) - 1) - 0.5)
        for n_discs in sizes:
            row = crisp[n_discs]
            ratio = row["steps"] / row["optimal_steps"]
            solved = bool(row["success"])
            axes.plot(
                n_discs + spread,
                min(ratio, 4.2) if solved else 4.2,
                "o" if solved else "x",
                color="#24598a" if solved else "#c0392b",
                markersize=5,
                alpha=0.8,
            )
    axes.axhline(1, color="#5b6b7b", linewidth=0.8, zorder=0)
    axes.set(xlabel="discs", ylabel="moves / optimum", xticks=sizes, xlim=(0.5, sizes[-1] + 0.5), ylim=(0.8, 4.7))
    axes.set_title(f"Hanoi: {len(seeds)} seeds, one point each (x: not solved within the cap)", fontsize=11)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    plt.close(figure)
    write_atomically(RESULTS / f"{name}.png", picture.getvalue())


def summarise(rows: list[dict[str, Any]]) -> None:
    """Print for each size the number of seeds that are optimal and that are successful."""
    seeds = {row["seed"] for row in rows}

    def optimal(seed: int, sizes: tuple[int, ...]) -> bool:
        return all(
            row["success"] and row["steps"] == row["optimal_steps"]
            for row in rows
            if row["seed"] == seed and row["n_discs"] in sizes
        )

    for n_discs in (*SIZES, *LONG_SIZES):
        here = [row for row in rows if row["n_discs"] == n_discs]
        count = sum(optimal(seed, (n_discs,)) for seed in seeds)
        worst = max(row["steps"] for row in here)
        print(
            f"{n_discs:2d} discs: {count} of {len(seeds)} seeds optimal, most steps {worst}, optimum {2**n_discs - 1}"
        )
    print(f"optimal on 5, 6 and 7 discs: {sum(optimal(seed, (5, 6, 7)) for seed in seeds)} of {len(seeds)} seeds")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds, from 0 on")
    parser.add_argument("--workers", type=int, default=2, help="seeds trained at the same time")
    parser.add_argument("--name", default="hanoi_seeds", help="name of the result files")
    parser.add_argument(
        "--hyperparams", nargs="*", default=[], metavar="KEY:VALUE", help="in place of the shipped ones"
    )
    options = parser.parse_args()
    overrides = overrides_from(options.hyperparams)
    jobs = [(seed, Path("runs") / options.name, overrides) for seed in range(options.seeds)]
    with pool(options.workers) as workers:
        done = track(workers.imap(run_seed, jobs), "Seeds", total=len(jobs))
        rows = [row for seed_rows in done for row in seed_rows]
    write_results(options.name, COLUMNS, rows, overrides)
    plot(options.name, rows)
    summarise(rows)


if __name__ == "__main__":
    main()
