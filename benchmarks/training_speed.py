"""Training speed of ReptilePPO("ProgPolicy") next to Stable-Baselines3's own algorithms, and the cost of one action.

All train on the same Hanoi-v0 task with the same rollouts and number of gradient steps, on one torch thread. The
algorithms take turns within each round, so that noise on the machine meets all of them; the median counts.

    python benchmarks/training_speed.py
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from rich.console import Console
from rich.table import Table
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import progpolicy_envs  # noqa: F401  registers Hanoi-v0
from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.programs import export_python

ENV, TASK = "Hanoi-v0", {"n_discs": 3}
N_ENVS, N_STEPS = 32, 128
COMMON: dict[str, Any] = {"n_steps": N_STEPS, "n_epochs": 4, "batch_size": 2048, "seed": 0, "device": "cpu"}

# ReptilePPO("ProgPolicy") in its phases: while W is searched for, all conditions are computed and every second update
# moves W alone; after that phi is trained, with the conditions of the extracted program.
OURS: dict[str, Callable[[], OnPolicyAlgorithm]] = {
    "ours, searching": lambda: _ours(),
    "ours, 2 conditions": lambda: _ours(n_conditions=2),
    "ours, 0 conditions": lambda: _ours(n_conditions=0),
}
# Stock RecurrentPPO("MlpLstmPolicy") and PPO("MlpPolicy"), each with the factor that is the goal.
PEERS: dict[str, tuple[float, Callable[[], OnPolicyAlgorithm]]] = {
    "RecurrentPPO": (10, lambda: RecurrentPPO("MlpLstmPolicy", _stock_env(), **COMMON)),
    "RecurrentPPO, LSTM of 16": (
        5,
        lambda: RecurrentPPO("MlpLstmPolicy", _stock_env(), policy_kwargs={"lstm_hidden_size": 16}, **COMMON),
    ),
    "PPO": (2, lambda: PPO("MlpPolicy", _stock_env(), **COMMON)),
}


def _stock_env() -> Any:
    """Make the environments as SB3's documentation does."""
    return make_vec_env(ENV, n_envs=N_ENVS, seed=0, env_kwargs=TASK)


def _ours(n_conditions: int | None = None) -> ReptilePPO:
    """Make our algorithm in the middle of its search, or past it, with a program of ``n_conditions``."""
    model = ReptilePPO("ProgPolicy", ENV, tasks=[TASK], n_envs=N_ENVS, search_fraction=1.0, **COMMON)
    if n_conditions is not None:
        model.search.select(n_conditions)
    return model


def training_speed(model: OnPolicyAlgorithm, n_rollouts: int) -> float:
    """Return environment steps per second over ``n_rollouts`` rollouts, each with its update."""
    steps = n_rollouts * N_ENVS * N_STEPS
    start = time.perf_counter()
    model.learn(steps)
    return steps / (time.perf_counter() - start)


def measure_training(n_rounds: int, n_rollouts: int) -> dict[str, float]:
    """Return the median speed of every algorithm over interleaved rounds."""
    makers = {**OURS, **{name: make for name, (_, make) in PEERS.items()}}
    models = {name: make() for name, make in makers.items()}
    for model in models.values():
        model.learn(N_ENVS * N_STEPS)  # warm up
    speeds: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(n_rounds):
        for name, model in models.items():
            speeds[name].append(training_speed(model, n_rollouts))
    return {name: statistics.median(values) for name, values in speeds.items()}


def microseconds(call: Callable[[], Any], n_calls: int) -> float:
    """Return the mean time of a call in microseconds."""
    start = time.perf_counter()
    for _ in range(n_calls):
        call()
    return 1e6 * (time.perf_counter() - start) / n_calls


def measure_actions(n_rounds: int, n_calls: int = 500) -> dict[str, float]:
    """Return the median microseconds of one action for one environment."""
    model = ReptilePPO("ProgPolicy", ENV, tasks=[TASK], n_envs=N_ENVS, search_fraction=0.0, seed=0, device="cpu")
    # Two conditions at their start values: a larger program than the search usually keeps.
    model.search.select(len(model.search.logits))
    namespace: dict[str, Any] = {}
    exec(compile(str(export_python(model.program())), "exported.py", "exec"), namespace)
    exported = namespace["ProgramPolicy"]()
    lstm = RecurrentPPO("MlpLstmPolicy", _stock_env(), **COMMON)
    observation = np.array([-1, -1, 0, 1, 1, 1, 1, -1, 1], dtype=np.float32)
    numbers = observation.tolist()
    joined = np.concatenate((observation, np.zeros(8, dtype=np.float32)))
    calls: dict[str, Callable[[], Any]] = {
        "exported Python program": lambda: exported.act(numbers, 1, -0.01, False),
        'model.predict, ReptilePPO("ProgPolicy")': lambda: model.predict(joined, deterministic=True),
        'model.predict, RecurrentPPO("MlpLstmPolicy")': lambda: lstm.predict(observation, deterministic=True),
    }
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(n_rounds):
        for name, call in calls.items():
            times[name].append(microseconds(call, n_calls))
    return {name: statistics.median(values) for name, values in times.items()}


def main() -> None:
    """Measure and print two tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="interleaved measurements of each, of which the median")
    parser.add_argument("--rollouts", type=int, default=4, help="rollouts of 4096 steps in one measurement")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    console = Console()

    speeds = measure_training(arguments.rounds, arguments.rollouts)
    table = Table(title=f"Training on Hanoi-v0, 3 discs, steps/s and ratios; median of {arguments.rounds}")
    for column in ("algorithm", "steps/s", *(name.partition(", ")[2] for name in OURS), "goal"):
        table.add_column(column, justify="left" if column == "algorithm" else "right")
    for name in OURS:
        table.add_row(name, f"{speeds[name]:,.0f}")
    for name, (goal, _) in PEERS.items():
        ratios = [f"{speeds[ours] / speeds[name]:.1f}x" for ours in OURS]
        table.add_row(name, f"{speeds[name]:,.0f}", *ratios, f"{goal:g}x")
    console.print(table)

    times = measure_actions(arguments.rounds)
    reference = times["exported Python program"]
    table = Table(title=f"One action for one environment; median of {arguments.rounds}")
    for column in ("policy", "microseconds", "ratio"):
        table.add_column(column, justify="left" if column == "policy" else "right")
    for name, value in times.items():
        table.add_row(name, f"{value:.1f}", f"{value / reference:.1f}x")
    console.print(table)


if __name__ == "__main__":
    main()
