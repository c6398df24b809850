"""How often the scripted controllers solve the Panda tasks, at our time step and at panda-gym's.

``python benchmarks/panda_control.py --seeds 100 --physics ours`` prints one line per task and number of objects and,
with ``--output``, writes them as a Markdown table.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import gymnasium as gym
import numpy as np

import progpolicy_envs
from progpolicy_envs.panda import PANDA_GYM_PHYSICS, Physics
from progpolicy_envs.planners.panda import CONTROLLERS

PHYSICS = {"ours": Physics(), "panda-gym": PANDA_GYM_PHYSICS}


def solve(env: gym.Env, env_id: str, seed: int, size: int) -> int | None:
    """Return the number of steps in which the controller solves a variation, or ``None``."""
    domain = progpolicy_envs.get_domain(env_id)
    observation, _ = env.reset(seed=seed, options={domain.size: size})
    for step in range(1, 501):
        observation, _, terminated, truncated, info = env.step(CONTROLLERS[env_id](observation))
        if terminated or truncated:
            return step if info["is_success"] else None
    return None


def main() -> None:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 3, 5, 8])
    parser.add_argument("--tasks", nargs="+", default=list(CONTROLLERS))
    parser.add_argument("--physics", choices=list(PHYSICS), default="ours")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    rows = ["| Task | Objects | Solved | Steps, mean | Steps, most |", "|---|---|---|---|---|"]
    print(*rows, sep="\n")
    for env_id in arguments.tasks:
        env = gym.make(env_id, physics=PHYSICS[arguments.physics])
        for size in arguments.sizes:
            runs = [solve(env, env_id, seed, size) for seed in range(arguments.seeds)]
            steps = [run for run in runs if run is not None]
            mean, most = (f"{np.mean(steps):.0f}", max(steps)) if steps else ("-", "-")
            rows.append(f"| {env_id} | {size} | {len(steps)}/{arguments.seeds} | {mean} | {most} |")
            print(rows[-1], flush=True)
        env.close()
    if arguments.output:
        command = f"python benchmarks/panda_control.py --seeds {arguments.seeds} --physics {arguments.physics}"
        temporary = arguments.output.with_suffix(".tmp")
        temporary.write_text(f"`{command}`\n\n" + "\n".join(rows) + "\n", encoding="utf-8")
        os.replace(temporary, arguments.output)


if __name__ == "__main__":
    main()
