"""What the baselines reach, next to Stable-Baselines3's nearest algorithm where there is one.

    python benchmarks/baselines.py cartpole [--seeds 3] [--steps 50000]
    python benchmarks/baselines.py maze [--seeds 3] [--steps 40000]
    python benchmarks/baselines.py reach [--seeds 3] [--steps 40000]

``cartpole`` compares DiscreteSAC with SB3's DQN, whose settings are rl-baselines3-zoo's, on CartPole-v1; ``maze``
compares HIRO with SB3's TD3 on a U-shaped corridor with its only reward at the far end (``point_maze.py``), both with
as many gradient steps, networks and random steps; ``reach`` trains HIRO on PandaReach-v0 with one target. Each seed is
evaluated on episodes never trained on, with the most likely actions; seconds are of this process, on one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from point_maze import PointMazeEnv
from stable_baselines3 import DQN, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv

from sb3_progpolicy import HIRO, DiscreteSAC, make_fast_vec_env

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
    "learning_starts": 1_000,
    "train_freq": 4,
    "gradient_steps": 4,
    "policy_kwargs": SMALL,
}
MAZE: dict[str, Any] = {"gradient_steps": 4, "batch_size": 128, "tau": 0.02, "policy_kwargs": SMALL}
RANDOM_STEPS = 10_000
HIRO_SETTINGS: dict[str, Any] = {**MAZE, "low_gamma": 0.9, "high_gradient_steps": 4, "reward_scale": 1.0}
MAZE_HIRO: dict[str, Any] = {**HIRO_SETTINGS, "high_learning_starts": RANDOM_STEPS}
REACH: dict[str, Any] = {
    **HIRO_SETTINGS,
    "goal_dims": [26, 27, 28],  # where the hand is
    "learning_starts": 2_000,
    "high_learning_starts": 6_000,
}

Make = Callable[[int], VecEnv]


class Contender(NamedTuple):
    """One algorithm on one task."""

    name: str
    algorithm: type[BaseAlgorithm]
    settings: dict[str, Any]


def maze_td3(noise: float) -> dict[str, Any]:
    """Return settings of TD3 with some exploration noise."""
    return {
        **MAZE,
        "learning_starts": RANDOM_STEPS,
        "action_noise": NormalActionNoise(np.zeros(2), np.full(2, noise)),
    }


def cartpole() -> tuple[Make, list[Contender]]:
    """DiscreteSAC and DQN on CartPole-v1."""
    contenders = [Contender("DiscreteSAC", DiscreteSAC, CARTPOLE_SAC), Contender("DQN", DQN, ZOO_DQN)]
    return lambda seed: make_vec_env("CartPole-v1", 1, seed=seed), contenders


def maze() -> tuple[Make, list[Contender]]:
    """HIRO and TD3 in the corridor."""
    contenders = [
        Contender("HIRO", HIRO, MAZE_HIRO),
        Contender("TD3, noise 0.1", TD3, maze_td3(0.1)),
        Contender("TD3, noise 0.5", TD3, maze_td3(0.5)),
    ]
    return lambda seed: make_vec_env(PointMazeEnv, 8, seed=seed), contenders


def reach() -> tuple[Make, list[Contender]]:
    """HIRO on PandaReach-v0."""
    return lambda seed: make_fast_vec_env("PandaReach-v0", 8, seed=seed, n_targets=1), [Contender("HIRO", HIRO, REACH)]


TASKS = {"cartpole": (cartpole, 50_000, 100), "maze": (maze, 40_000, 40), "reach": (reach, 40_000, 40)}


def evaluate(model: BaseAlgorithm, env: VecEnv, n_episodes: int) -> tuple[float, float, float]:
    """Return mean return, mean length and share of successes, NaN where the environment reports none."""
    successes: list[bool] = []

    def note(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"] and "is_success" in local["info"]:
            successes.append(bool(local["info"]["is_success"]))

    returns, lengths = evaluate_policy(
        model, env, n_episodes, deterministic=True, callback=note, return_episode_rewards=True, warn=False
    )
    return float(np.mean(returns)), float(np.mean(lengths)), float(np.mean(successes)) if successes else float("nan")


def main() -> None:
    """Train and evaluate every contender with every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds, from 0 on")
    parser.add_argument("--steps", type=int, help="environment steps of training; by default what the task needs")
    parser.add_argument("--episodes", type=int, help="episodes of evaluation")
    parser.add_argument("--only", help="contenders whose name starts so")
    parser.add_argument("--progress", action="store_true", help="show a progress bar of each training")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    build, steps, episodes = TASKS[arguments.task]
    make, contenders = build()
    print("| algorithm | seed | steps | return | length | success | seconds |", "|---" * 7 + "|", sep="\n", flush=True)
    for contender in contenders:
        if arguments.only and not contender.name.startswith(arguments.only):
            continue
        for seed in range(arguments.seeds):
            started = time.process_time()
            model = contender.algorithm("MlpPolicy", make(seed), seed=seed, device="cpu", **contender.settings)
            model.learn(arguments.steps or steps, progress_bar=arguments.progress)
            seconds = time.process_time() - started
            scores = evaluate(model, make(10_000 + seed), arguments.episodes or episodes)
            cells = [contender.name, seed, model.num_timesteps, *(f"{score:.2f}" for score in scores), f"{seconds:.0f}"]
            print("| " + " | ".join(map(str, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
