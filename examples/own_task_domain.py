"""Your own task domain: CartPole with poles of different lengths and a motor of varying force.

Nothing here is specific to this package's environments. A variation is set on any Gymnasium environment in one of three
ways: by attribute, as here, by ``reset(options=...)``, or by constructor arguments.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_progpolicy import ReptilePPO, ReptileWrapper, TaskDistribution, VecInteractionHistory

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--timesteps", type=int, default=200_000, help="environment steps of each training")
arguments = parser.parse_args()


class PoleCart(gym.Wrapper):
    """CartPole whose dynamics follow its pole: CartPole derives one number from the length and keeps it."""

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Recompute what depends on the length, then reset."""
        cart = self.unwrapped
        cart.polemass_length = cart.masspole * cart.length
        return super().reset(**kwargs)


def make_env() -> gym.Env:
    """Make one environment; its episodes end after 500 steps."""
    return PoleCart(gym.make("CartPole-v1"))


# Every combination of three half-lengths (metres) with a force (newtons) drawn anew each time. A list, a range or a
# callable that is given a generator: all are accepted.
tasks = TaskDistribution(
    {"length": [0.3, 0.5, 0.8], "force_mag": lambda rng: float(rng.uniform(8, 12))},
    apply="attributes",
    sampler="failure",  # what fails is drawn more often; CartPole reports no success, so that all are equally likely
)


def mean_length_of_episodes(model: BaseAlgorithm, length: float, n_episodes: int = 5) -> float:
    """Run the model on one pole length. ReptilePPO has seen its previous action, reward and done flag."""
    env: VecEnv = make_vec_env(make_env, n_envs=1, seed=1)
    env.env_method("set_wrapper_attr", "length", length)
    if isinstance(model, ReptilePPO):
        env = VecInteractionHistory(env)
    lengths: list[int] = []
    observation, state, start = env.reset(), None, np.ones(1, dtype=bool)
    while len(lengths) < n_episodes:
        action, state = model.predict(observation, state, start, deterministic=True)
        observation, _, start, infos = env.step(action)
        lengths += [info["episode"]["l"] for info in infos if "episode" in info]
    return float(np.mean(lengths))


# 1. A stock algorithm, made to train across the tasks by a callback.
stock = PPO("MlpPolicy", make_vec_env(make_env, n_envs=8, seed=0), n_steps=128, batch_size=256, seed=0, device="cpu")
stock.learn(arguments.timesteps, callback=ReptileWrapper(tasks, inner_updates=2, tasks_per_iteration=4))

# 2. The same tasks, a readable program instead of a network.
readable = ReptilePPO(
    "ProgPolicy",
    make_vec_env(make_env, n_envs=8, seed=0),
    tasks=tasks,
    inner_updates=2,
    n_epochs=10,
    batch_size=256,
    learning_rate=0.003,
    policy_kwargs={"depth": 2},
    seed=0,
    device="cpu",
)
readable.learn(arguments.timesteps)
print(readable.program())

# 0.65 m lies between the lengths of the training; 1.2 m is beyond them.
print("mean length of episodes, at most 500")
for length in (0.3, 0.5, 0.8, 0.65, 1.2):
    print(
        f"half-length {length} m: network {mean_length_of_episodes(stock, length):.0f}, "
        f"program {mean_length_of_episodes(readable, length):.0f}"
    )
