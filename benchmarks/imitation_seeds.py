"""Several seeds of imitating a domain's planner, or a network that PPO has trained (``teachers.yml``).

    python benchmarks/imitation_seeds.py --env PandaPush-v0 [--seeds 10] [--episodes 100] [--final]
    python benchmarks/imitation_seeds.py --env CartPole-v1 --network
    python benchmarks/imitation_seeds.py --env HikingEgo-v0 --interaction --set n_stars=1-4 layout=random

Each seed imitates from scratch, on training variations alone. Its program is then run crisp on these, on starts that
were not used before; with --final on the validation and the unseen ones too, which nothing is chosen by. The teacher's
own results are the rows of the seed "teacher".

Writes ``benchmarks/results/<name>.csv``, in which each row names the commit that learned it, a ``.json`` with command,
commit and versions, and the programs as ``benchmarks/results/programs/<name>_<seed>.json``. What is there for the same
arguments is not done again, and a seed that was interrupted goes on from its last round, kept in ``runs/``.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from rich.progress import track
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from study import RESULTS, commit, write_results

from progpolicy_envs import find_domain
from sb3_progpolicy.cli.parsing import parse_variations
from sb3_progpolicy.env_ids import spec_of
from sb3_progpolicy.imitation import Imitation, imitate, make_teacher
from sb3_progpolicy.imitation.rollouts import Episodes, Pool, ProgramAct, play
from sb3_progpolicy.programs import Program
from sb3_progpolicy.programs.files import write_atomically

COLUMNS = (
    *("seed", "set", "variation", "episodes", "success_rate", "steps_mean", "return_mean"),
    *("n_conditions", "n_numbers", "n_lines", "cpu_seconds", "learned_by", "commit"),
)
EVALUATION_SEED = 10_000
PROGRAMS = RESULTS / "programs"
TEACHERS = Path(__file__).with_name("teachers.yml")


def learn(teacher: Any, env_id: str, seed: int, folder: Path, arguments: dict[str, Any]) -> Program:
    """Return the program of one seed, learned now or by an earlier run with the same arguments.

    Its metadata hold the arguments, the commit and the seconds that it took, those of an interrupted run, too.
    """
    path, study = PROGRAMS / f"{folder.name}_{seed}.json", json.loads(json.dumps(arguments))
    if path.exists() and (program := Program.load(path)).metadata.get("study") == study:
        return program
    folder.mkdir(parents=True, exist_ok=True)
    state, clock = folder / f"seed_{seed}.state.npz", folder / f"seed_{seed}.seconds"
    before = float(clock.read_text()) if state.exists() and clock.exists() else 0.0
    started = time.process_time()

    def after_round(_: Imitation) -> None:
        write_atomically(clock, str(before + time.process_time() - started))

    program = imitate(teacher, env_id, seed=seed, checkpoint=state, callback=after_round, **arguments)
    seconds = round(before + time.process_time() - started, 1)
    state.unlink()
    clock.unlink()
    about = {"cpu_seconds": seconds, "study": study, "commit": commit()}
    program = dataclasses.replace(program, metadata={**program.metadata, **about})
    program.save(path)
    return program


Wanted = list[tuple[str, Any]]


def wanted_variations(env_id: str, final: bool, sizes: list[int] | None) -> Wanted:
    """Return the set and the variation of each row, of all sizes or of some."""
    domain = find_domain(env_id)
    if domain is None:
        return [("train", {})]
    parts = {"train": domain.train, **({"validation": domain.validation, "unseen": domain.unseen} if final else {})}
    return [
        (kind, variation)
        for kind, variations in parts.items()
        for variation in variations
        if sizes is None or variation[domain.size] in sizes
    ]


def known_rows(name: str, arguments: dict[str, Any], episodes: int, wanted: Wanted) -> dict[str, list[dict[str, Any]]]:
    """Return the rows that an earlier run of the same study has left, by seed."""
    table, origin = RESULTS / f"{name}.csv", RESULTS / f"{name}.json"
    if not (table.exists() and origin.exists()):
        return {}
    if json.loads(origin.read_text())["overrides"] != json.loads(json.dumps(arguments)):
        return {}
    with table.open(newline="") as lines:
        rows: list[dict[str, Any]] = list(csv.DictReader(lines))
    if not rows or tuple(rows[0]) != COLUMNS:
        return {}
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        for column in ("success_rate", "steps_mean", "return_mean"):
            row[column] = float(row[column]) if row[column] else ""
        found.setdefault(row["seed"], []).append(row)
    whole = [(kind, _named(variation)) for kind, variation in wanted]
    return {
        seed: own
        for seed, own in found.items()
        if whole == [(row["set"], row["variation"]) for row in own]
        and all(row["episodes"] == str(episodes) for row in own)
    }


def rows_of(
    seed: Any, env_id: str, teacher: Any, program: Program | None, episodes: int, wanted: Wanted
) -> list[dict[str, Any]]:
    """Run the program, or the teacher if there is none, on the variations."""
    rows: list[dict[str, Any]] = []
    about = {"seed": seed, "commit": commit(), **_about(program)}
    with Pool(env_id, min(episodes, 25), interaction=program is not None and program.interaction) as pool:
        judge = make_teacher(teacher, pool.envs[0])
        act = None if program is None else ProgramAct(program, len(pool))
        for kind, variation in wanted:
            played = play(pool, [variation], episodes, EVALUATION_SEED, act, judge)
            rows.append({"set": kind, **_row(variation, played), **about})
    return rows


def _row(variation: Any, played: Episodes) -> dict[str, Any]:
    return {
        "variation": _named(variation),
        "episodes": len(played.returns),
        "success_rate": float(played.successes.mean()) if len(played.successes) else "",
        "steps_mean": round(float(played.steps.mean()), 2),
        "return_mean": round(float(played.returns.mean()), 3),
    }


def _named(variation: Any) -> str:
    return ", ".join(f"{name}={value}" for name, value in variation.items())


def _about(program: Program | None) -> dict[str, Any]:
    if program is None:
        return {}
    from sb3_progpolicy.analysis.simplify import count_numbers

    return {
        "n_conditions": len(program.conditions),
        "n_numbers": count_numbers(program),
        "n_lines": sum(bool(line) for line in str(program).splitlines()),
        "cpu_seconds": program.metadata.get("cpu_seconds", ""),
        "learned_by": learned_by(program),
        "commit": program.metadata.get("commit", ""),
    }


def learned_by(program: Program) -> str:
    """Return how a program was learned, and what it was shown beyond the training variations."""
    augmentation = program.metadata.get("augment")
    return program.learned_by + (f", {augmentation}" if augmentation else "")


def trained_network(env_id: str, folder: Path) -> Any:
    """Return SB3's PPO as ``teachers.yml`` says, trained now with seed 0 or read from ``folder``.

    :raises ValueError: if it does not name the environment
    """
    known = yaml.safe_load(TEACHERS.read_text())
    if env_id not in known:
        raise ValueError(f"{TEACHERS.name} has no network for {env_id}; it has {', '.join(known)}")
    settings = dict(known[env_id])
    path, statistics = folder / "teacher.zip", folder / "teacher.pkl"
    n_timesteps, normalize = settings.pop("n_timesteps"), settings.pop("normalize", False)
    env: VecEnv = make_vec_env(env_id, settings.pop("n_envs"), seed=0)
    if path.exists():
        return PPO.load(path, VecNormalize.load(str(statistics), env) if normalize else env, device="cpu")
    folder.mkdir(parents=True, exist_ok=True)
    env = VecNormalize(env, gamma=settings["gamma"]) if normalize else env
    model = PPO("MlpPolicy", env, seed=0, device="cpu", **settings).learn(n_timesteps)
    if isinstance(env, VecNormalize):
        env.save(str(statistics))
    model.save(path.with_name("unfinished.zip"))
    path.with_name("unfinished.zip").replace(path)
    return model


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="environment id")
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds, from 0 on")
    parser.add_argument("--episodes", type=int, default=100, help="episodes on each variation")
    parser.add_argument("--n-timesteps", type=int, default=30_000, help="states to label")
    parser.add_argument("--max-conditions", type=int, default=11, help="of the program at most")
    parser.add_argument("--cell", default="affine", choices=("affine", "min"), help="of the conditions")
    parser.add_argument("--interaction", action="store_true", help="read the previous action, reward and done flag")
    parser.add_argument("--set", nargs="+", help="variations to learn on, as name=value; by default the training ones")
    parser.add_argument("--augment", help="more than the training variations: taller_towers or begun_towers")
    parser.add_argument("--network", action="store_true", help="imitate the network that teachers.yml describes")
    parser.add_argument("--final", action="store_true", help="look at the validation and the unseen variations, too")
    parser.add_argument("--sizes", type=int, nargs="+", help="sizes to run on; by default all")
    parser.add_argument("--name", help="name of the result files; that of the domain by default")
    options = parser.parse_args()
    th.set_num_threads(1)
    commit()  # of the code that is loaded now
    spec_of(options.env)
    PROGRAMS.mkdir(parents=True, exist_ok=True)
    suffix = "" if options.cell == "affine" else f"_{options.cell}"
    name = options.name or f"imitation_{options.env.rpartition('-')[0].lower()}{suffix}"
    folder = Path("runs") / name
    arguments: dict[str, Any] = {
        key: getattr(options, key) for key in ("n_timesteps", "max_conditions", "augment", "interaction")
    }
    if options.cell != "affine":
        arguments["cell"] = options.cell
    if options.set:
        arguments["tasks"] = parse_variations(options.set)
    teacher = trained_network(options.env, folder) if options.network else "planner"
    wanted = wanted_variations(options.env, options.final, options.sizes)
    known = known_rows(name, arguments, options.episodes, wanted)
    rows: list[dict[str, Any]] = []
    seeds = ["teacher", *map(str, range(options.seeds))]
    for seed in track(seeds, "Seeds"):
        if seed not in known:
            program = None if seed == "teacher" else learn(teacher, options.env, int(seed), folder, arguments)
            known[seed] = rows_of(seed, options.env, teacher, program, options.episodes, wanted)
        rows = [row for one in seeds if one in known for row in known[one]]
        write_results(name, COLUMNS, rows, arguments)
    for variation in dict.fromkeys(row["variation"] for row in rows):
        print(_sentence(variation, [row for row in rows if row["variation"] == variation]))
    print(f"median seed by what was reached in training: {median_seed(rows)}")


def median_seed(rows: list[dict[str, Any]]) -> str:
    """Return the seed in the middle by success on training variations, then by steps; the better of two."""

    def reached(seed: str) -> tuple[float, float]:
        own = [row for row in rows if str(row["seed"]) == seed and row["set"] == "train"]
        successes = [row["return_mean"] if row["success_rate"] == "" else row["success_rate"] for row in own]
        return float(np.mean(successes)), -float(np.mean([row["steps_mean"] for row in own]))

    ranked = sorted(dict.fromkeys(str(row["seed"]) for row in rows if row["seed"] != "teacher"), key=reached)
    return ranked[len(ranked) // 2]


def _sentence(variation: str, rows: list[dict[str, Any]]) -> str:
    (own, *seeds), what = rows, "success_rate" if rows[0]["success_rate"] != "" else "return_mean"
    values, steps = [row[what] for row in seeds], np.mean([row["steps_mean"] for row in seeds])
    summary = f"{what} median {np.median(values):.3g}, worst {min(values):.3g}, teacher {own[what]:.3g}"
    return f"{variation or 'as it is'} ({own['set']}): {summary}; {steps:.1f} steps, teacher {own['steps_mean']:.1f}"


if __name__ == "__main__":
    main()
