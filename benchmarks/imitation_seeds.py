"""Several seeds of imitating a domain's planner, or a network that PPO has trained.

    python benchmarks/imitation_seeds.py --env PandaPush-v0 [--seeds 10] [--episodes 100] [--final]
    python benchmarks/imitation_seeds.py --env CartPole-v1 --ppo 60000

Each seed imitates from scratch, on training variations alone. Its program is then run crisp on these, on starts that
were not used before; with --final on the validation and the unseen ones too, which nothing is chosen by. The teacher's
own results are the rows of the seed "teacher". A finished seed is kept in ``runs/``: an interrupted study goes on.

Writes ``benchmarks/results/<name>.csv`` and a ``.json`` with command, commit and versions.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from rich.progress import track
from study import write_results

from progpolicy_envs import find_domain
from sb3_progpolicy.evaluation import spec_of
from sb3_progpolicy.imitation import imitate, make_teacher
from sb3_progpolicy.imitation.rollouts import Episodes, Pool, play, program_act
from sb3_progpolicy.programs import Program

COLUMNS = (
    *("seed", "set", "variation", "episodes", "success_rate", "steps_mean", "return_mean"),
    *("n_conditions", "n_numbers", "n_lines", "cpu_seconds"),
)
EVALUATION_SEED = 10_000


def learn(teacher: Any, env_id: str, seed: int, folder: Path, arguments: dict[str, Any]) -> Program:
    """Return the program of one seed, learned now or read from ``folder``; its metadata hold the seconds it took."""
    path = folder / f"seed_{seed}.json"
    if path.exists():
        return Program.load(path)
    folder.mkdir(parents=True, exist_ok=True)
    started = time.process_time()
    program = imitate(teacher, env_id, seed=seed, **arguments)
    seconds = round(time.process_time() - started, 1)
    program = dataclasses.replace(program, metadata={**program.metadata, "cpu_seconds": seconds})
    program.save(path)
    return program


def rows_of(seed: Any, env_id: str, teacher: Any, program: Program | None, episodes: int, final: bool) -> list[Any]:
    """Run the program, or the teacher if there is none, on the variations."""
    domain, rows = find_domain(env_id), []
    sets = [("train", domain.train if domain is not None else ({},))]
    if domain is not None and final:
        sets += [("validation", domain.validation), ("unseen", domain.unseen)]
    pool = Pool(env_id, min(episodes, 24), interaction=program is not None and program.interaction)
    judge = make_teacher(teacher, pool.envs[0])
    act = None if program is None else program_act(program, len(pool))
    for kind, variations in sets:
        for variation in variations:
            played = play(pool, [variation], episodes, EVALUATION_SEED, act, judge)
            rows.append({"seed": seed, "set": kind, **_row(variation, played), **_about(program)})
    pool.close()
    return rows


def _row(variation: Any, played: Episodes) -> dict[str, Any]:
    return {
        "variation": ", ".join(f"{name}={value}" for name, value in variation.items()),
        "episodes": len(played.returns),
        "success_rate": float(played.successes.mean()) if len(played.successes) else "",
        "steps_mean": round(float(played.steps.mean()), 2),
        "return_mean": round(float(played.returns.mean()), 3),
    }


def _about(program: Program | None) -> dict[str, Any]:
    if program is None:
        return {}
    from sb3_progpolicy.analysis.simplify import count_numbers

    return {
        "n_conditions": len(program.conditions),
        "n_numbers": count_numbers(program),
        "n_lines": sum(bool(line) for line in str(program).splitlines()),
        "cpu_seconds": program.metadata.get("cpu_seconds", ""),
    }


def trained_ppo(env_id: str, n_timesteps: int, folder: Path) -> Any:
    """Return SB3's PPO with an ``MlpPolicy``, trained now with its default settings or read from ``folder``."""
    from stable_baselines3 import PPO

    path = folder / f"ppo_{n_timesteps}.zip"
    if path.exists():
        return PPO.load(path, device="cpu")
    folder.mkdir(parents=True, exist_ok=True)
    model = PPO("MlpPolicy", env_id, seed=0, device="cpu").learn(n_timesteps)
    model.save(path)
    return model


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="environment id")
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds, from 0 on")
    parser.add_argument("--episodes", type=int, default=100, help="episodes on each variation")
    parser.add_argument("--n-timesteps", type=int, default=24_000, help="states to label")
    parser.add_argument("--max-conditions", type=int, default=11, help="of the program at most")
    parser.add_argument("--interaction", action="store_true", help="read the previous action, reward and done flag")
    parser.add_argument("--augment", help="label states that were not visited, too: taller_towers")
    parser.add_argument("--ppo", type=int, help="imitate a network that PPO has trained for so many steps")
    parser.add_argument("--final", action="store_true", help="look at the validation and the unseen variations, too")
    parser.add_argument("--name", help="name of the result files; that of the domain by default")
    options = parser.parse_args()
    th.set_num_threads(1)
    spec_of(options.env)
    name = options.name or f"imitation_{options.env.rpartition('-')[0].lower()}"
    folder = Path("runs") / name
    arguments = {key: getattr(options, key) for key in ("n_timesteps", "max_conditions", "augment", "interaction")}
    teacher = trained_ppo(options.env, options.ppo, folder) if options.ppo else "planner"
    rows = rows_of("teacher", options.env, teacher, None, options.episodes, options.final)
    for seed in track(range(options.seeds), "Seeds"):
        program = learn(teacher, options.env, seed, folder, arguments)
        rows += rows_of(seed, options.env, teacher, program, options.episodes, options.final)
        write_results(name, COLUMNS, rows, arguments)
    for variation in dict.fromkeys(row["variation"] for row in rows):
        print(_sentence(variation, [row for row in rows if row["variation"] == variation]))


def _sentence(variation: str, rows: list[dict[str, Any]]) -> str:
    (own, *seeds), what = rows, "success_rate" if rows[0]["success_rate"] != "" else "return_mean"
    values, steps = [row[what] for row in seeds], np.mean([row["steps_mean"] for row in seeds])
    summary = f"{what} median {np.median(values):.3g}, worst {min(values):.3g}, teacher {own[what]:.3g}"
    return f"{variation or 'as it is'} ({own['set']}): {summary}; {steps:.1f} steps, teacher {own['steps_mean']:.1f}"


if __name__ == "__main__":
    main()
