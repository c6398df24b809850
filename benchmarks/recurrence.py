"""The recurrence of this package's GRU conditions next to ``torch.nn.GRU``, forwards and backwards.

128 steps of 16 sequences, as in training; 2 hidden units are two conditions of size 1, 6 are two of size 3.

    python benchmarks/recurrence.py
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch as th
from rich.console import Console
from rich.table import Table

from sb3_progpolicy.differentiable.recurrence import scan

N_STEPS, N_SEQUENCES, N_INPUTS = 128, 16, 17
HIDDEN_SIZES = (2, 6)


def passes(hidden_size: int) -> dict[str, Callable[[], None]]:
    """Return one forward and backward pass of each implementation, on the same weights and inputs."""
    th.manual_seed(0)
    gru = th.nn.GRU(N_INPUTS, hidden_size)
    inputs, hidden = th.randn(N_STEPS, N_SEQUENCES, N_INPUTS), th.zeros(1, N_SEQUENCES, hidden_size)

    def ours() -> th.Tensor:
        gates = th.nn.functional.linear(inputs, gru.weight_ih_l0, gru.bias_ih_l0)
        return scan("gru", gates, gru.weight_hh_l0, gru.bias_hh_l0, hidden[0])

    def torchs() -> th.Tensor:
        return gru(inputs, hidden)[0]

    if not th.allclose(ours(), torchs(), atol=1e-5):
        raise RuntimeError("the two recurrences disagree")

    def both_ways(forward: Callable[[], th.Tensor]) -> Callable[[], None]:
        def run() -> None:
            gru.zero_grad()
            forward().square().sum().backward()

        return run

    return {"ours": both_ways(ours), "torch.nn.GRU": both_ways(torchs)}


def milliseconds(run: Callable[[], None], n_calls: int) -> float:
    """Return the mean time of a call."""
    start = time.perf_counter()
    for _ in range(n_calls):
        run()
    return 1e3 * (time.perf_counter() - start) / n_calls


def main() -> None:
    """Measure in turns and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="interleaved measurements of each, of which the median")
    parser.add_argument("--calls", type=int, default=50, help="passes in one measurement")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    table = Table(title=f"GRU forwards and backwards, {N_STEPS} steps of {N_SEQUENCES} sequences; milliseconds")
    for column in ("hidden units", "ours", "torch.nn.GRU", "ratio"):
        table.add_column(column, justify="right")
    for hidden_size in HIDDEN_SIZES:
        runs = passes(hidden_size)
        times: dict[str, list[float]] = {name: [] for name in runs}
        for run in runs.values():
            run()  # warm up
        for _ in range(arguments.rounds):
            for name, run in runs.items():
                times[name].append(milliseconds(run, arguments.calls))
        ours, torchs = (statistics.median(values) for values in times.values())
        table.add_row(str(hidden_size), f"{ours:.2f}", f"{torchs:.2f}", f"{torchs / ours:.1f}x")
    Console().print(table)


if __name__ == "__main__":
    main()
