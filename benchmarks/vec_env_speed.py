"""Steps per second of many environments in few processes, against SB3's one process per environment.

    python benchmarks/vec_env_speed.py [--env PandaReach-v0] [--num-envs 16] [--workers 2] [--seconds 2.0] [--rounds 5]

Random actions, environments seeded alike. In every round each candidate runs for the given time, one after the other,
so that a busy machine slows all of them alike; the table shows medians over the rounds and ratios of them.
"""

from __future__ import annotations

import argparse
import time
from statistics import median

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

import progpolicy_envs  # noqa: F401 (registers the ids)
from sb3_progpolicy.grouped import GroupedSubprocVecEnv


def steps_per_second(env: VecEnv, seconds: float) -> float:
    """Step with random actions for about so many seconds; return steps of all environments per second."""
    rng = np.random.default_rng(0)
    low, high = getattr(env.action_space, "low", None), getattr(env.action_space, "high", None)
    steps, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        if low is None:
            actions = np.array([env.action_space.sample() for _ in range(env.num_envs)])
        else:
            actions = rng.uniform(low, high, (env.num_envs, *low.shape)).astype(np.float32)
        env.step(actions)
        steps += env.num_envs
    return steps / elapsed


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="PandaReach-v0", help="environment id")
    parser.add_argument("--num-envs", type=int, default=16, help="environments")
    parser.add_argument("--workers", type=int, default=2, help="processes of the grouped form")
    parser.add_argument("--seconds", type=float, default=2.0, help="how long each candidate runs in a round")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of which the median is taken")
    options = parser.parse_args()

    envs: dict[str, VecEnv] = {}
    measured: dict[str, list[float]] = {}
    forms: dict[str, tuple[type[VecEnv], dict[str, int]]] = {
        "DummyVecEnv": (DummyVecEnv, {}),
        "SubprocVecEnv": (SubprocVecEnv, {}),
        "GroupedSubprocVecEnv": (GroupedSubprocVecEnv, {"n_workers": options.workers}),
    }
    try:
        for name, (form, arguments) in forms.items():
            envs[name] = make_vec_env(options.env, options.num_envs, seed=0, vec_env_cls=form, vec_env_kwargs=arguments)
            envs[name].reset()
            measured[name] = []
        for _ in range(options.rounds):
            for name, env in envs.items():
                measured[name].append(steps_per_second(env, options.seconds))
    finally:
        for env in envs.values():
            env.close()

    speed = {name: median(values) for name, values in measured.items()}
    print(
        f"{options.env}, {options.num_envs} environments, median of {options.rounds} interleaved rounds of "
        f"{options.seconds:g} s\n"
    )
    print(f"{'form':<24}{'processes':>10}{'steps/s':>12}{'ratio':>8}")
    processes = {"DummyVecEnv": 1, "SubprocVecEnv": options.num_envs, "GroupedSubprocVecEnv": options.workers}
    for name, value in speed.items():
        print(f"{name:<24}{processes[name]:>10}{value:>12,.0f}{value / speed['SubprocVecEnv']:>8.2f}")


if __name__ == "__main__":
    main()
