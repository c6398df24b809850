"""How often the scripted controllers solve the Panda tasks, at our time step and at panda-gym's.

    python benchmarks/panda_control.py [--seeds 100] [--physics both] [--output benchmarks/results/panda_control.md]

Prints one line per task and number of objects; the same seeds, so the same starts and targets, for both. Ours is
120 Hz with 4 physics steps for each action and a solver of few iterations, twice as fine with many iterations while
something is held or off the table, and bodies that sleep; panda-gym's is 500 Hz with 20, a solver of fifty iterations
and all bodies awake.
"""

from __future__ import annotations

import argparse
import os
import platform
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import gymnasium as gym
import numpy as np

from progpolicy_envs import DOMAINS
from progpolicy_envs.panda import PANDA_GYM_PHYSICS, Physics

PHYSICS = {"ours": Physics(), "panda-gym": PANDA_GYM_PHYSICS}
IDS = [domain.id for domain in DOMAINS.values() if domain.simulation]
LIBRARIES = ("numpy", "pybullet", "gymnasium")


def solve(env: gym.Env, env_id: str, seed: int, size: int) -> int | None:
    """Return the number of steps in which the controller solves a variation, or ``None``."""
    env.reset(seed=seed, options={DOMAINS[env_id].size: size})
    for step, action in enumerate(env.unwrapped.plan(), start=1):  # type: ignore[attr-defined]
        _, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return step if info["is_success"] else None
    return None


def cells(env: gym.Env, env_id: str, seeds: int, size: int) -> list[str]:
    """Return the solved share, and the mean and largest number of steps in which that was done."""
    runs = [solve(env, env_id, seed, size) for seed in range(seeds)]
    steps = [run for run in runs if run is not None]
    return [f"{len(steps)}/{seeds}", *((f"{np.mean(steps):.0f}", f"{max(steps)}") if steps else ("-", "-"))]


def origin() -> str:
    """Return in one line what the figures come from: the commit and the versions."""
    here = Path(__file__).parent
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--exclude=*"], cwd=here, capture_output=True, text=True, check=False
    )
    commit = git.stdout.strip() or "unknown"
    versions = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return f"Commit {commit}; Python {platform.python_version()}, {versions}."


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100, help="episodes for each task and number of objects")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 3, 5, 8], help="numbers of objects")
    parser.add_argument("--tasks", nargs="+", choices=IDS, default=IDS)
    parser.add_argument("--physics", choices=[*PHYSICS, "both"], default="both")
    parser.add_argument("--output", type=Path, help="Markdown file for the table")
    arguments = parser.parse_args()
    chosen = list(PHYSICS) if arguments.physics == "both" else [arguments.physics]
    source = origin()
    columns = ["Task", "Objects"]
    for name in chosen:
        columns += [f"Solved, {name}", "Steps, mean", "Steps, most"]
    rows = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    print(source, "", *rows, sep="\n", flush=True)
    for env_id in arguments.tasks:
        envs = [gym.make(env_id, physics=PHYSICS[name]) for name in chosen]
        for size in arguments.sizes:
            row = [cell for env in envs for cell in cells(env, env_id, arguments.seeds, size)]
            rows.append("| " + " | ".join([env_id, str(size), *row]) + " |")
            print(rows[-1], flush=True)
        for env in envs:
            env.close()
    if arguments.output:
        command = shlex.join(["python", "benchmarks/panda_control.py", *sys.argv[1:]])
        temporary = arguments.output.with_suffix(".tmp")
        temporary.write_text(f"`{command}`\n\n{source}\n\n" + "\n".join(rows) + "\n", encoding="utf-8")
        os.replace(temporary, arguments.output)


if __name__ == "__main__":
    main()
