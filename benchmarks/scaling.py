"""Speed of meta-batches: the inner loops of several tasks one after another, in processes, and on Ray.

Engines take turns, so that noise on the machine meets all of them; the median of a meta-iteration counts. The start of
the processes is measured on its own.

    python benchmarks/scaling.py [--engines serial local ray] [--envs Hanoi-v0 PandaReach-v0]
"""

from __future__ import annotations

import argparse
import statistics
import time
from typing import Any

import torch as th
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.callbacks import BaseCallback

import progpolicy_envs  # noqa: F401  registers the domains
from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.vec_env.factory import simulations_in_this_process
from sb3_progpolicy.vec_env.grouped import usable_cores

ITERATIONS = 5  # of which the first is not counted


class Clock(BaseCallback):
    """Notes when meta-iterations begin and end."""

    def __init__(self) -> None:
        super().__init__()
        self.began: list[float] = []
        self.took: list[float] = []

    def _on_rollout_start(self) -> None:
        self.began.append(time.perf_counter())

    def _on_rollout_end(self) -> None:
        self.took.append(time.perf_counter() - self.began[-1])

    def _on_step(self) -> bool:
        return True


def measure(env: str, engine: str, batch: int) -> tuple[float, float]:
    """Return the seconds that the start of the processes costs, and those of a meta-iteration."""
    arguments: dict[str, Any] = {"meta_batch_size": batch, "engine": engine, "device": "cpu", "seed": 0}
    with simulations_in_this_process():
        model = ReptilePPO("ProgPolicy", env, n_steps=128, batch_size=2048, **arguments)
        per_iteration = model.n_steps * model.n_envs * model.inner_updates * batch
        clock = Clock()
        model.learn(ITERATIONS * per_iteration, callback=clock, log_interval=None)
    took = statistics.median(clock.took[1:])
    return max(0.0, clock.took[0] - took), took  # they are started with the first one


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engines", nargs="+", default=["serial", "local"], choices=["serial", "local", "ray"])
    parser.add_argument("--envs", nargs="+", default=["Hanoi-v0", "PandaReach-v0"])
    parser.add_argument("--batch", type=int, default=4, help="inner loops of a meta-iteration")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    th.set_num_threads(1)
    table = Table(title=f"meta_batch_size={options.batch}, {usable_cores()} cores")
    for name in ("environment", "engine", "start, s", "meta-iteration, s", "times serial"):
        table.add_column(name, justify="left" if name in ("environment", "engine") else "right")
    for env in options.envs:
        measured: dict[str, list[tuple[float, float]]] = {engine: [] for engine in options.engines}
        for _ in range(options.rounds):
            for engine in options.engines:
                measured[engine].append(measure(env, engine, options.batch))
        ratios = {
            engine: statistics.median(a[1] / b[1] for a, b in zip(measured[options.engines[0]], rows, strict=True))
            for engine, rows in measured.items()
        }
        for engine, rows in measured.items():
            start, took = (statistics.median(column) for column in zip(*rows, strict=True))
            table.add_row(env, engine, f"{start:.2f}", f"{took:.2f}", f"{ratios[engine]:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
