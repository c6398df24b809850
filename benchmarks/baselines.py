"""What the baselines reach, next to Stable-Baselines3's nearest algorithm where there is one.

    python benchmarks/baselines.py [cartpole] [maze] [reach] [--seeds 3]

``cartpole`` compares DiscreteSAC with SB3's DQN, whose settings are rl-baselines3-zoo's, on CartPole-v1; ``maze``
compares HIRO with SB3's TD3 on a U-shaped corridor with its only reward at the far end (``point_maze.py``), both with
as many gradient steps, networks and random steps; ``reach`` trains HIRO on PandaReach-v0 with one target. Each seed is
evaluated on episodes never trained on, with the most likely actions; seconds are of the processor, on one thread. All
go to ``results/baselines.csv``. A finished seed is kept in ``runs/``, so that an interrupted study goes on where it
was.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from point_maze import PointMazeEnv
from stable_baselines3 import DQN, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from study import write_results

from sb3_progpolicy import HIRO, DiscreteSAC, make_fast_vec_env
from sb3_progpolicy.programs.files import write_atomically

COLUMNS = ("task", "algorithm", "seed", "steps", "return", "length", "success", "train_seconds")

SMALL: dict[str, Any] = {"net_arch": [64, 64], "optimizer_kwargs": {"fused": True}}

# rl-baselines3-zoo, hyperparams/dqn.yml
ZOO_DQN: dict[str, Any] = {
    "learning_rate": 2.3e-3,
    "batch_size": 64,
    "buffer_size": 100_000,
    "learning_starts": 1_000,
    "gamma": 0.99,
    "target_update_interval": 10,
    "train_freq": 256,
    "gradient_steps": 128,
    "exploration_fraction": 0.16,
    "exploration_final_eps": 0.04,
    "policy_kwargs": {"net_arch": [256, 256]},
}
CARTPOLE_SAC: dict[str, Any] = {
    "learning_rate": 1e-3,
    "batch_size": 128,
    "tau": 0.01,
    "gamma": 0.98,
    "learning_starts": 1_000,
    "gradient_steps": 8,  # as many as environments
    "policy_kwargs": SMALL,
}
MAZE: dict[str, Any] = {"gradient_steps": 2, "batch_size": 64, "tau": 0.02, "policy_kwargs": SMALL}
RANDOM_STEPS = 10_000
HIRO_SETTINGS: dict[str, Any] = {**MAZE, "low_gamma": 0.9, "high_gradient_steps": 4, "reward_scale": 1.0}
MAZE_HIRO: dict[str, Any] = {**HIRO_SETTINGS, "high_learning_starts": RANDOM_STEPS}
REACH: dict[str, Any] = {
    **HIRO_SETTINGS,
    "goal_dims": [0, 1, 2],  # where the gripper is
    "goal_period": 5,  # steps of 5 cm
    "goal_scale": 1.0,
    "gradient_steps": 4,
    "high_gradient_steps": 2,
    "learning_starts": 1_000,
    "high_learning_starts": 3_000,
}

EVALUATION_ENVS = 10
EVALUATION_SEED = 10_000


class Contender(NamedTuple):
    """One algorithm on one task."""

    name: str
    algorithm: type[BaseAlgorithm]
    settings: dict[str, Any]
    n_envs: int


class Task(NamedTuple):
    """Environments, given a number of them and a seed, steps of training, episodes of evaluation, and who trains."""

    make: Callable[[int, int], VecEnv]
    steps: int
    episodes: int
    contenders: list[Contender]


def maze_td3(noise: float) -> Contender:
    """Return TD3 with some exploration noise."""
    settings = {
        **MAZE,
        "learning_starts": RANDOM_STEPS,
        "action_noise": NormalActionNoise(np.zeros(2), np.full(2, noise)),
    }
    return Contender(f"TD3, noise {noise:g}", TD3, settings, 8)


def make_reach(n_envs: int, seed: int) -> VecEnv:
    """Return PandaReach-v0 with one target, 50 steps at most, and observations in units of 20 cm."""
    env = make_fast_vec_env("PandaReach-v0", n_envs, seed=seed, n_targets=1, max_episode_steps=50)
    scaled = VecNormalize(env, training=False, norm_reward=False)
    scaled.obs_rms.var[:] = 0.2**2  # its mean stays 0
    return scaled


TASKS = {
    "cartpole": Task(
        lambda n_envs, seed: make_vec_env("CartPole-v1", n_envs, seed=seed),
        steps=50_000,
        episodes=100,
        contenders=[Contender("DiscreteSAC", DiscreteSAC, CARTPOLE_SAC, 8), Contender("DQN", DQN, ZOO_DQN, 1)],
    ),
    "maze": Task(
        lambda n_envs, seed: make_vec_env(PointMazeEnv, n_envs, seed=seed),
        steps=40_000,
        episodes=50,
        contenders=[Contender("HIRO", HIRO, MAZE_HIRO, 8), maze_td3(0.5)],
    ),
    "reach": Task(
        make_reach,
        steps=20_000,
        episodes=50,
        contenders=[Contender("HIRO", HIRO, REACH, 8)],
    ),
}


def evaluate(model: BaseAlgorithm, env: VecEnv, n_episodes: int) -> dict[str, float | None]:
    """Return mean return, mean length and share of successes, the last ``None`` where the environment reports none."""
    successes: list[bool] = []

    def note(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"] and "is_success" in local["info"]:
            successes.append(bool(local["info"]["is_success"]))

    returns, lengths = evaluate_policy(
        model, env, n_episodes, deterministic=True, callback=note, return_episode_rewards=True, warn=False
    )
    return {
        "return": round(float(np.mean(returns)), 2),
        "length": round(float(np.mean(lengths)), 1),
        "success": round(float(np.mean(successes)), 3) if successes else None,
    }


def run_seed(
    task: str, contender: Contender, seed: int, folder: Path, *, finished_only: bool = False
) -> dict[str, Any] | None:
    """Return the row of one seed, trained now or read from ``folder``.

    :param task: one of ``TASKS``
    :param contender: that is trained
    :param seed: of training; episodes of evaluation have another
    :param folder: where rows are kept, so that an interrupted study goes on where it was
    :param finished_only: whether nothing is trained; ``None`` is returned where there is no row
    """
    make, steps, episodes, _ = TASKS[task]
    path = folder / f"{task}_{contender.name.lower().replace(', ', '_').replace(' ', '_')}_{seed}.json"
    settings = f"{contender.n_envs} {steps} {episodes} {contender.settings}"
    if path.exists() and (kept := json.loads(path.read_text()))["settings"] == settings:
        row: dict[str, Any] = kept["row"]
        return row
    if finished_only:
        return None
    started = time.process_time()
    model = contender.algorithm(
        "MlpPolicy", make(contender.n_envs, seed), seed=seed, device="cpu", **contender.settings
    )
    model.learn(steps)
    seconds = round(time.process_time() - started, 1)
    scores = evaluate(model, make(EVALUATION_ENVS, EVALUATION_SEED + seed), episodes)
    row = {"task": task, "algorithm": contender.name, "seed": seed, "steps": model.num_timesteps}
    row = {**row, **scores, "train_seconds": seconds}
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, json.dumps({"settings": settings, "row": row}))
    return row


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "tasks", nargs="*", default=list(TASKS), metavar="task", help=f"of {', '.join(TASKS)}; all by default"
    )
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds, from 0 on")
    parser.add_argument("--only", default="", help="contenders whose name starts so")
    parser.add_argument("--finished", action="store_true", help="train nothing; write what is finished")
    parser.add_argument("--name", default="baselines", help="name of the result files")
    options = parser.parse_args()
    if unknown := set(options.tasks) - set(TASKS):
        parser.error(f"there is no task {', '.join(sorted(unknown))}; there are {', '.join(TASKS)}")
    th.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for task in options.tasks:
        chosen = [contender for contender in TASKS[task].contenders if contender.name.startswith(options.only)]
        for contender, seed in itertools.product(chosen, range(options.seeds)):
            folder = Path("runs") / options.name
            row = run_seed(task, contender, seed, folder, finished_only=options.finished)
            if row is not None:
                rows.append(row)
                print(*(f"{key}={value}" for key, value in row.items()), flush=True)
                write_results(options.name, COLUMNS, rows, {})


if __name__ == "__main__":
    main()
