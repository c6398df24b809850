"""Steps per second of the planning domains: batched against single, and PDDLGym's Hanoi where it is installed.

    python benchmarks/envs_speed.py [--num-envs 1024] [--seconds 1.0] [--rounds 5]

Random actions, episodes restarted where they end. In every round each candidate runs for the given time, one after
the other, so that a busy machine slows all of them alike; the table shows medians over the rounds and ratios of them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import gymnasium as gym
import numpy as np

from progpolicy_envs import DOMAINS

#: Takes steps for about so many seconds and returns the steps per second.
Runner = Callable[[float], float]
IDS = [domain.id for domain in DOMAINS.values() if not domain.simulation]


def clocked(step: Callable[[int], object], steps_per_call: int) -> Runner:
    """Return a runner that calls ``step`` with a running number until the time is over."""

    def run(seconds: float) -> float:
        calls, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < seconds:
            step(calls)
            calls += 1
        return calls * steps_per_call / elapsed

    return run


def batched_runner(env_id: str, num_envs: int) -> Runner:
    """Return a runner of the batched form."""
    env = gym.make_vec(env_id, num_envs=num_envs, vectorization_mode="vector_entry_point")
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(env.single_action_space.n, size=(997, num_envs))  # type: ignore[attr-defined]
    return clocked(lambda call: env.step(actions[call % len(actions)]), num_envs)


def single_runner(env_id: str) -> Runner:
    """Return a runner of the single form, made as a user makes it."""
    env = gym.make(env_id)
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(env.action_space.n, size=997)  # type: ignore[attr-defined]

    def step(call: int) -> None:
        _, _, terminated, truncated, _ = env.step(actions[call % len(actions)])
        if terminated or truncated:
            env.reset()

    return clocked(step, 1)


def pddlgym_runner() -> Runner | None:
    """Return a runner of PDDLGym's Hanoi with three discs, or ``None`` where PDDLGym can't be imported."""
    try:
        import pddlgym
        from pddlgym.core import PDDLEnv
    except ImportError:
        return None
    folder = Path(pddlgym.__file__).parent / "pddl"
    env = PDDLEnv(str(folder / "hanoi.pddl"), str(folder / "hanoi"))
    env.fix_problem_index(0)
    state, _ = env.reset()
    (move,) = env.action_predicates
    places = sorted({place.name for place in state.objects})
    pairs = [(disc, place) for disc in places if disc.startswith("d") for place in places if disc != place]
    choices = np.random.default_rng(0).integers(len(pairs), size=997)

    def step(call: int) -> None:
        _, _, done, truncated, _ = env.step(move(*pairs[choices[call % len(choices)]]))
        if done or truncated:
            env.reset()

    return clocked(step, 1)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=1024, help="environments of the batched form")
    parser.add_argument("--seconds", type=float, default=1.0, help="how long each candidate runs in a round")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of which the median is taken")
    options = parser.parse_args()

    runners: dict[tuple[str, str], Runner] = {}
    for env_id in IDS:
        runners[env_id, "batched"] = batched_runner(env_id, options.num_envs)
        runners[env_id, "single"] = single_runner(env_id)
    peer = pddlgym_runner()
    if peer is not None:
        runners["Hanoi-v0", "PDDLGym"] = peer
    measured: dict[tuple[str, str], list[float]] = {key: [] for key in runners}
    for _ in range(options.rounds):
        for key, run in runners.items():
            measured[key].append(run(options.seconds))
    speed = {key: median(values) for key, values in measured.items()}

    print(f"steps/s, median of {options.rounds} interleaved rounds of {options.seconds:g} s, N = {options.num_envs}\n")
    print(f"{'domain':<24}{'batched':>12}{'single':>12}{'ratio':>8}{'PDDLGym':>12}{'ratio':>8}")
    for env_id in IDS:
        batched, single, other = speed[env_id, "batched"], speed[env_id, "single"], speed.get((env_id, "PDDLGym"))
        compared = f"{other:>12,.0f}{batched / other:>8,.0f}" if other else f"{'-':>12}{'-':>8}"
        print(f"{env_id:<24}{batched:>12,.0f}{single:>12,.0f}{batched / single:>8,.0f}{compared}")
    if peer is None:
        print("\nPDDLGym is not installed; its column is empty.")


if __name__ == "__main__":
    main()
