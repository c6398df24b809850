"""A small suite, and a result as a cell has it."""

from pathlib import Path

from sb3_progpolicy.benchmark.cell import CellResult

SUITES = Path(__file__).parents[2] / "benchmarks" / "suites"


SMALL = {
    "name": "small",
    "methods": {"ppo": {"n_envs": 4, "n_steps": 32, "batch_size": 64, "n_timesteps": 256}},
    "domains": {"Hanoi-v0": {"max_steps": 20}},
    "seeds": [0, 1],
    "episodes": 1,
    "curve_points": 2,
    "curve_episodes": 1,
}


ROW = {
    "set": "unseen",
    "relation": "extrapolated",
    "variation": {"n_discs": 6},
    "semantics": "crisp",
    "episodes": 1,
    "success_rate": 1.0,
    "steps_mean": 63.0,
    "steps_std": 0.0,
    "optimal_steps_mean": 63.0,
}


RESULT = CellResult(rows=[ROW], timesteps=256, versions={"python": "3"}, commit="abc")
