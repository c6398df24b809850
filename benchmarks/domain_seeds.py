"""Several seeds of a domain, or of any environment: train on its training variations, then run the programs.

    python benchmarks/domain_seeds.py --env HikingEgo-v0 [--seeds 10] [--episodes 100] [--workers 1]
    python benchmarks/domain_seeds.py --env HikingEgo-v0 --final --simplify --ship
    python benchmarks/domain_seeds.py --env Acrobot-v1

Each seed trains from scratch with ``sb3_progpolicy/hyperparams/reptile_ppo.yml``, the same for all. Its program is
then run, crisp and soft, on every training and validation variation, on starts that training did not use. With
--final it is run on the unseen variations, too, which nothing is chosen by. With --simplify each program is also
simplified: few terms with the same success and steps on the training variations (``equally_good="outcome"``). Then
--ship takes the simplified one of the median seed. A finished seed is kept in ``runs/``, its rows too as long as the
commit is the same, and one that is interrupted goes on from its last checkpoint.

Writes ``benchmarks/results/<name>.csv``, a picture of the crisp programs (simplified ones if asked for), and a
``.json`` with command, commit and versions. Says which seed is the median by what was reached in training; --ship puts
it into the package.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from study import RESULTS, commit, overrides_from, pool, train, write_results

import sb3_progpolicy.pretrained
from progpolicy_envs import find_domain
from sb3_progpolicy.analysis.rules import count_numbers
from sb3_progpolicy.analysis.simplify import simplify
from sb3_progpolicy.env_ids import spec_of
from sb3_progpolicy.evaluation import Evaluation, evaluate_program
from sb3_progpolicy.imitation.rollouts import Pool, ProgramAct, play
from sb3_progpolicy.programs import Program
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.io import program_digest

COLUMNS = (
    *("seed", "set", "variation", "semantics", "episodes", "success_rate", "steps_mean", "ratio", "return_mean"),
    *("n_conditions", "n_numbers", "timesteps", "train_seconds"),
)
SEMANTICS = ("crisp", "soft")
SMALL = "_small"  # at the end of the names of simplified programs
EVALUATION_SEED = 10_000
Row = dict[str, Any]


@dataclass(frozen=True)
class Job:
    """What is done for one seed.

    :param env_id: environment id
    :param seed: of the training
    :param folder: where programs, checkpoints and rows are kept
    :param overrides: hyperparameters in place of the shipped ones
    :param episodes: on each variation
    :param final: whether to look at the unseen variations
    :param simplified: whether to simplify the program, and run that, too
    :param commit: of the code that does it
    """

    env_id: str
    seed: int
    folder: Path
    overrides: dict[str, Any]
    episodes: int
    final: bool
    simplified: bool
    commit: str


def run_seed(job: Job) -> list[Row]:
    """Train and evaluate one seed, or return what an earlier run of the same code has left of it."""
    program = train(job.env_id, job.seed, job.folder, job.overrides)
    path = job.folder / f"seed_{job.seed}.rows.json"
    arguments = [job.episodes, job.final, job.simplified]
    about = {"program": program_digest(program), "arguments": arguments, "commit": job.commit}
    if path.exists() and (known := json.loads(path.read_text()))["about"] == about:
        return known["rows"]
    rows = rows_of(program, job)
    write_atomically(path, json.dumps({"about": about, "rows": rows}))
    return rows


def rows_of(program: Program, job: Job) -> list[Row]:
    """Run the program of a seed."""
    if find_domain(job.env_id) is None:
        return _about(job.seed, program, returns_of(program, job.env_id, job.episodes))
    rows = _about(job.seed, program, results_of(program, job.env_id, job.episodes, job.final, SEMANTICS))
    if job.simplified:
        small = simplified_of(program, job.env_id, job.folder / f"seed_{job.seed}{SMALL}.json")
        found = results_of(small, job.env_id, job.episodes, job.final, ("crisp",))
        rows += _about(job.seed, small, ({**row, "semantics": "simplified"} for row in found))
    return rows


def simplified_of(program: Program, env_id: str, path: Path) -> Program:
    """Return a program's simplified form, found now or read from a file."""
    if path.exists():
        known = Program.load(path)
        if known.metadata.get("simplified", {}).get("from") == program_digest(program):
            return known
    small = simplify(program, env_id, equally_good="outcome").program
    small.save(path)
    return small


def _about(seed: int, program: Program, rows: Iterable[Row]) -> list[Row]:
    about = {
        "seed": seed,
        "n_conditions": len(program.conditions),
        "n_numbers": count_numbers(program),
        "timesteps": program.metadata["timesteps"],
        "train_seconds": program.metadata["train_seconds"],
    }
    return [{**about, **row} for row in rows]


def results_of(
    program: Program, env_id: str, episodes: int, final: bool, all_semantics: Sequence[str]
) -> Iterable[Row]:
    """Run a program on the variations of its domain."""
    domain = find_domain(env_id)
    assert domain is not None
    sets = {"train": domain.trained, "validation": domain.validation, **({"unseen": domain.unseen} if final else {})}
    for kind, variations in sets.items():
        for semantics in all_semantics:
            for row in evaluate_program(
                program, env_id, variations, episodes, semantics=semantics, seed=EVALUATION_SEED
            ):
                yield {"set": kind, **_row(row)}


def _row(row: Evaluation) -> Row:
    return {
        "variation": ", ".join(f"{name}={value}" for name, value in row.variation.items()),
        "semantics": row.semantics,
        "episodes": row.episodes,
        "success_rate": row.success_rate,
        "steps_mean": round(row.steps_mean, 2),
        "ratio": "" if row.ratio is None else round(row.ratio, 3),
        "return_mean": "",
    }


def returns_of(program: Program, env_id: str, episodes: int) -> list[Row]:
    """Run a program on an environment that has returns and no variations."""
    rows = []
    for semantics in SEMANTICS:
        with Pool(env_id, min(episodes, 25), interaction=program.interaction) as pool:
            played = play(pool, [{}], episodes, EVALUATION_SEED, ProgramAct(program, len(pool), semantics))
        rows.append(
            {
                "set": "train",
                "variation": "",
                "semantics": semantics,
                "episodes": episodes,
                "success_rate": float(played.successes.mean()) if len(played.successes) else "",
                "steps_mean": round(float(played.steps.mean()), 2),
                "ratio": "",
                "return_mean": round(float(played.returns.mean()), 2),
            }
        )
    return rows


def run_at_last(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the programs that are to be run: the simplified ones, else the crisp ones."""
    return [row for row in rows if row["semantics"] == "simplified"] or [
        row for row in rows if row["semantics"] == "crisp"
    ]


def median_seed(rows: Sequence[Row]) -> int:
    """Return the seed whose program is the median by what it reached on the training variations."""
    merits: dict[int, list[tuple[float, float]]] = {}
    for row in run_at_last(rows):
        if row["set"] == "train":
            first = row["return_mean"] if row["success_rate"] == "" else row["success_rate"]
            merits.setdefault(row["seed"], []).append((float(first), -float(row["steps_mean"])))
    ranked = sorted(merits, key=lambda seed: tuple(np.mean(merits[seed], axis=0)))
    return ranked[len(ranked) // 2]


def plot(name: str, rows: Sequence[Row], title: str) -> None:
    """Draw what each seed's program reaches on each variation: success, and steps as a multiple of the planner's.

    Where there is no success, the return.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    crisp = run_at_last(rows)
    labels = list(dict.fromkeys((row["set"], row["variation"]) for row in crisp))
    columns = {"success_rate": "success", "ratio": "steps / planner's", "return_mean": "return"}
    shown = [name for name in columns if any(row[name] != "" for row in crisp)]
    height = 1.2 + 0.24 * len(labels)
    figure, all_axes = plt.subplots(
        1, len(shown), figsize=(3.6 + 3.2 * len(shown), height), layout="constrained", sharey=True, squeeze=False
    )
    colours = {"train": "#24598a", "validation": "#b9770e", "unseen": "#1e8449"}
    for axes, column in zip(all_axes[0], shown, strict=True):
        for place, (kind, variation) in enumerate(labels):
            here = [row[column] for row in crisp if (row["set"], row["variation"]) == (kind, variation)]
            values = [float(value) for value in here if value != ""]
            axes.plot(values, [place] * len(values), "o", color=colours[kind], alpha=0.45, markersize=5)
            if values:
                axes.plot(np.median(values), place, "|", color=colours[kind], markersize=14)
        axes.set(xlabel=columns[column], **({"xlim": (-0.03, 1.03)} if column == "success_rate" else {}))
        axes.grid(axis="x", color="#dde3ea", linewidth=0.6)
    all_axes[0][0].set_yticks(
        range(len(labels)), [f"{variation or 'as trained'}  ({kind})" for kind, variation in labels]
    )
    all_axes[0][0].invert_yaxis()
    figure.suptitle(title, fontsize=10)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=100)
    plt.close(figure)
    write_atomically(RESULTS / f"{name}.png", picture.getvalue())


def summarise(rows: Sequence[Row]) -> None:
    """Print for each variation what the programs reach."""
    crisp = run_at_last(rows)
    for kind, variation in dict.fromkeys((row["set"], row["variation"]) for row in crisp):
        here = [row for row in crisp if (row["set"], row["variation"]) == (kind, variation)]
        parts = []
        for column, form in (("success_rate", "{:.1%}"), ("ratio", "{:.2f}"), ("return_mean", "{:.1f}")):
            values = [float(row[column]) for row in here if row[column] != ""]
            if values:
                spread = ", ".join(form.format(value) for value in (min(values), np.median(values), max(values)))
                parts.append(f"{column} {spread}")
        print(f"{variation or 'as trained'} ({kind}): {'; '.join(parts)} (least, median, most)")


def ship(env_id: str, folder: Path, seed: int, simplified: bool) -> None:
    """Put the program of a seed into the package."""
    name = f"{env_id.rpartition(':')[2]}.json"
    target = Path(sb3_progpolicy.pretrained.__file__).with_name(name)
    shutil.copy(folder / f"seed_{seed}{SMALL if simplified else ''}.json", target)
    print(f"seed {seed} is shipped as {name}")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="environment id")
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds, from 0 on")
    parser.add_argument("--episodes", type=int, default=100, help="episodes on each variation")
    parser.add_argument("--workers", type=int, default=1, help="seeds trained at the same time")
    parser.add_argument("--final", action="store_true", help="look at the unseen variations, too")
    parser.add_argument("--ship", action="store_true", help="put the median seed's program into the package")
    parser.add_argument("--simplify", action="store_true", help="simplify each program, and run that, too")
    parser.add_argument("--name", help="name of the result files; that of the domain by default")
    parser.add_argument(
        "--hyperparams", nargs="*", default=[], metavar="KEY:VALUE", help="in place of the shipped ones"
    )
    options = parser.parse_args()
    spec_of(options.env)
    if options.simplify and find_domain(options.env) is None:
        parser.error(f"--simplify is for domains, whose variations it looks at; {options.env} is of none")
    origin = commit()  # of the code that is loaded now
    overrides = overrides_from(options.hyperparams)
    name = options.name or f"{options.env.rpartition(':')[2].rpartition('-')[0].lower()}_seeds"
    folder = Path("runs") / name
    common = (folder, overrides, options.episodes, options.final, options.simplify, origin)
    jobs = [Job(options.env, seed, *common) for seed in range(options.seeds)]
    with pool(options.workers) as workers:
        done = track(workers.imap(run_seed, jobs), "Seeds", total=len(jobs))
        rows = [row for seed_rows in done for row in seed_rows]
    write_results(name, COLUMNS, rows, overrides)
    kind = run_at_last(rows)[0]["semantics"]
    plot(name, rows, f"{options.env}: {options.seeds} seeds, {kind} programs, {options.episodes} episodes each")
    summarise(rows)
    print(f"the median seed by what was reached in training: {median_seed(rows)}")
    if options.ship:
        ship(options.env, folder, median_seed(rows), options.simplify)


if __name__ == "__main__":
    main()
