"""How many conditions a program gets, and what they are worth: growth, gradient search and fixed numbers, over seeds.

    python benchmarks/growth.py [--env Pendulum-v1 CartPole-v1 Acrobot-v1 HikingEgo-v0] [--seeds 3] [--methods ...]

Each program is trained from scratch with the settings below, which differ in nothing but how the number of conditions
is found. It is then run crisp, on starts that training did not use: on the environment as it is, or on the training and
validation variations of a domain, never on those that are unseen. A finished seed is kept in ``runs/``.

Writes ``benchmarks/results/growth_<env>.csv`` and a ``.json`` with command, commit and versions.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from study import commit, train, write_results

from progpolicy_envs import find_domain
from sb3_progpolicy.programs import Program, ProgramRunner
from sb3_progpolicy.programs.interpreter import join_inputs
from sb3_progpolicy.vec_env import make_fast_vec_env

EVALUATION_SEED, EPISODES = 10_000, 100
COLUMNS = ("method", "seed", "variations", "episodes", "return_mean", "return_std", "success_rate", "n_conditions")
COLUMNS += ("tried", "kept", "timesteps")
_PENDULUM = {
    "n_timesteps": 400_000,
    "n_envs": 32,
    "n_steps": 64,
    "batch_size": None,
    "learning_rate": 0.01,
    "gamma": 0.9,
    "scale_rewards": True,
    "action_std": "lin_1_0.1",
    "temperature": "lin_1_0.1",
    "inner_updates": 1,
    "search_fraction": 0.7,
    "policy_kwargs": {"depth": 5, "cell": "affine", "semantics": "branches"},
}
_HIKING = {
    "n_timesteps": 4_000_000,
    "n_envs": 256,
    "n_steps": 64,
    "batch_size": 4096,
    "n_epochs": 5,
    "inner_updates": 1,
    "tasks_per_iteration": 12,
    "learning_rate": "lin_0.03",
    "gamma": 0.97,
    "ent_coef": 0.01,
    "action_temperature": "lin_1_0.02",
    "symmetric": True,
    "normalize_observations": False,
    "policy_kwargs": {"depth": 4},
}
#: By environment what differs from ``sb3_progpolicy/hyperparams/reptile_ppo.yml``.
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "Pendulum-v1": _PENDULUM,
    "CartPole-v1": {"n_timesteps": 300_000, "policy_kwargs": {"depth": 4}},
    "Acrobot-v1": {"n_timesteps": 300_000, "policy_kwargs": {"depth": 4}},
    "HikingEgo-v0": _HIKING,
}
_OF_ENV = {"Pendulum-v1": (0, 2, 4), "CartPole-v1": (0, 2), "Acrobot-v1": (0, 2), "HikingEgo-v0": (0, 2)}


def overrides_of(env_id: str, method: str) -> dict[str, Any]:
    """Return the hyperparameters of a method.

    :param env_id: a key of :data:`SETTINGS`
    :param method: ``"growth"``, ``"gradient"``, ``"gradient_free"`` (no price) or ``"n_conditions=<k>"``
    """
    settings = dict(SETTINGS[env_id])
    if method == "growth":
        return {**settings, "search_method": "growth"}
    if method == "gradient_free":
        return {**settings, "length_coef": 0.0}
    if method.startswith("n_conditions="):
        fixed = {**settings["policy_kwargs"], "n_conditions": int(method.partition("=")[2])}
        return {**settings, "policy_kwargs": {name: value for name, value in fixed.items() if name != "depth"}}
    return settings


def crisp_returns(program: Program, env_id: str, variations: Any) -> tuple[list[float], list[float]]:
    """Run whole episodes of the crisp program; return their returns, and successes where the environment tells them."""
    n_envs = EPISODES // len(variations) * len(variations) or len(variations)
    env = make_fast_vec_env(env_id, n_envs)
    env.seed(EVALUATION_SEED)
    if variations[0]:
        env.set_options([dict(variations[row % len(variations)]) for row in range(n_envs)])
    observations: Any = env.reset()
    runner = ProgramRunner(program, n_envs)
    actions, rewards, dones = None, np.zeros(n_envs), np.zeros(n_envs, dtype=bool)
    running, over = np.zeros(n_envs), np.zeros(n_envs, dtype=bool)
    successes = np.full(n_envs, np.nan)
    while not over.all():
        actions = runner.act(join_inputs(program, observations, actions, rewards, dones))
        observations, rewards, dones, infos = env.step(actions)
        running += np.where(over, 0, rewards)
        for row in np.flatnonzero(dones & ~over):
            successes[row] = infos[row].get("is_success", np.nan)
        over |= dones
    env.close()
    return running.tolist(), successes[np.isfinite(successes)].tolist()


def run(env_id: str, method: str, seed: int) -> list[dict[str, Any]]:
    """Train and evaluate one seed of a method."""
    program = train(env_id, seed, Path("runs") / f"growth_{env_id}" / method, overrides_of(env_id, method))
    domain = find_domain(env_id)
    sets: Mapping[str, Any] = (
        {"as it is": [{}]} if domain is None else {"train": domain.train, "validation": domain.validation}
    )
    trials = program.metadata.get("growth", [])
    rows = []
    for name, variations in sets.items():
        returns, successes = crisp_returns(program, env_id, variations)
        rows.append(
            {
                "method": method,
                "seed": seed,
                "variations": name,
                "episodes": len(returns),
                "return_mean": round(float(np.mean(returns)), 2),
                "return_std": round(float(np.std(returns)), 2),
                "success_rate": round(float(np.mean(successes)), 3) if successes else "",
                "n_conditions": len(program.conditions),
                "tried": len(trials),
                "kept": sum(trial["kept"] for trial in trials),
                "timesteps": program.metadata["timesteps"],
            }
        )
        print(*rows[-1].values(), flush=True)
    return rows


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", choices=list(SETTINGS), default=list(SETTINGS), help="environment ids")
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds, from 0 on")
    parser.add_argument("--methods", nargs="+", help="growth, gradient, gradient_free or n_conditions=<k>")
    options = parser.parse_args()
    commit()  # of the code that is run, whatever is checked out when it is through
    for env_id in options.env:
        fixed = [f"n_conditions={k}" for k in _OF_ENV[env_id]]
        methods = options.methods or ["growth", "gradient", "gradient_free", *fixed]
        rows = [row for method in methods for seed in range(options.seeds) for row in run(env_id, method, seed)]
        write_results(f"growth_{env_id.rpartition('-')[0].lower()}", COLUMNS, rows, SETTINGS[env_id])


if __name__ == "__main__":
    main()
