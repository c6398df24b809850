"""Steps per second of many environments in few processes, against SB3's one process per environment.

    python benchmarks/vec_env_speed.py [--env PandaReach-v0 ...] [--num-envs 16] [--rounds 5]

Random actions, environments seeded alike. In every round each candidate runs for the given time, one after the other;
the table shows medians over the rounds and ratios of them. On a machine that does other work as well, sixteen processes
get a larger share of it than two do. The processor time that all processes together spend on a step, read from /proc
where there is one, does not depend on that.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, cast

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from progpolicy_envs import DOMAINS
from sb3_progpolicy.vec_env import GroupedSubprocVecEnv, make_fast_vec_env

TASKS = [domain.id for domain in DOMAINS.values() if domain.simulation]


def workers(env: VecEnv) -> list[Any]:
    """Return the processes beside this one in which environments run."""
    return list(getattr(env.unwrapped, "processes", []))


def processor_seconds(env: VecEnv) -> float:
    """Return the processor time that this process and the workers of an environment have used so far."""
    ticks = 0
    for process in workers(env):
        stat = Path(f"/proc/{process.pid}/stat")
        if stat.exists():
            user, system = stat.read_text().rpartition(")")[2].split()[11:13]
            ticks += int(user) + int(system)
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def measure(env: VecEnv, seconds: float) -> tuple[float, float]:
    """Step with random actions for so many seconds; return steps per second and processor seconds per step."""
    rng = np.random.default_rng(0)
    low, high = getattr(env.action_space, "low", None), getattr(env.action_space, "high", None)
    steps, used, start = 0, processor_seconds(env), time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        if low is None:
            actions = np.array([env.action_space.sample() for _ in range(env.num_envs)])
        else:
            actions = rng.uniform(low, high, (env.num_envs, *low.shape)).astype(np.float32)
        env.step(actions)
        steps += env.num_envs
    return steps / elapsed, (processor_seconds(env) - used) / steps


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=list(TASKS), help="environment ids")
    parser.add_argument("--num-envs", type=int, default=16, help="environments")
    parser.add_argument("--seconds", type=float, default=2.0, help="how long each candidate runs in a round")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of which the median is taken")
    options = parser.parse_args()
    print(
        f"{options.num_envs} environments, median of {options.rounds} interleaved rounds of {options.seconds:g} s\n\n"
        f"{'':<16}{'form':<24}{'processes':>10}{'steps/s':>10}{'ratio':>8}{'processor, ms/step':>20}{'ratio':>8}"
    )
    for env_id in options.env:
        print_rows(env_id, options)


def print_rows(env_id: str, options: argparse.Namespace) -> None:
    """Measure the forms with one environment id and print a row for each."""
    envs: dict[str, VecEnv] = {}
    measured: dict[str, list[tuple[float, float]]] = {}
    forms: dict[str, Callable[[], VecEnv]] = {
        "DummyVecEnv": partial(make_vec_env, env_id, options.num_envs, seed=0),
        "SubprocVecEnv": partial(make_vec_env, env_id, options.num_envs, seed=0, vec_env_cls=SubprocVecEnv),
        "GroupedSubprocVecEnv": partial(
            make_vec_env, env_id, options.num_envs, seed=0, vec_env_cls=cast(Any, GroupedSubprocVecEnv)
        ),
        "make_fast_vec_env": partial(make_fast_vec_env, env_id, options.num_envs, seed=0),
    }
    try:
        for name, make in forms.items():
            envs[name] = make()
            envs[name].reset()
            measured[name] = []
        for _ in range(options.rounds):
            for name, env in envs.items():
                measured[name].append(measure(env, options.seconds))
    finally:
        for env in envs.values():
            env.close()
    # SubprocVecEnv leaves this process nothing to do but to wait.
    processes = {name: len(workers(env)) + (name != "SubprocVecEnv") for name, env in envs.items()}
    results = {name: [median(values) for values in zip(*rounds, strict=True)] for name, rounds in measured.items()}
    speed, used = results["SubprocVecEnv"]
    for name, (steps, seconds) in results.items():
        print(
            f"{env_id:<16}{name:<24}{processes[name]:>10}{steps:>10,.0f}{steps / speed:>8.2f}"
            f"{1000 * seconds:>20.2f}{seconds / used:>8.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
