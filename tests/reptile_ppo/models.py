"""Small models and environments to train."""

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from sb3_progpolicy import ReptilePPO

POLICIES = ("ProgPolicy", "PRLPolicy", "MlpPolicy", "MlpLstmPolicy")


PARTS_OF_LOSS = ("loss", "policy_gradient_loss", "entropy_loss", "value_loss")


def make(policy="ProgPolicy", env="Hanoi-v0", **kwargs):
    if isinstance(env, str):
        kwargs.setdefault("n_envs", 4)
    return ReptilePPO(
        policy, env, device="cpu", **{"n_steps": 16, "batch_size": 32, "n_epochs": 2, "seed": 0, **kwargs}
    )


def weights(model):
    return th.cat([tensor.flatten().double() for tensor in model.policy.state_dict().values()])


class Each(BaseCallback):
    """Calls a function at every step."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        self.function(self.model, self.locals)
        return True


class OneStep(gym.Env):
    """Every episode is one step long; the right action is the sign of the observation."""

    observation_space = spaces.Box(-1, 1, (3,), np.float64)

    def __init__(self, action_space=None):
        self.action_space = action_space or spaces.Discrete(2, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seen = self.np_random.uniform(-1, 1, size=3)
        return self.seen, {}

    def step(self, action):
        assert self.action_space.contains(action), action
        right = isinstance(self.action_space, spaces.Discrete) and action - self.action_space.start == (
            self.seen[0] > 0
        )
        return self.reset()[0], float(right), True, False, {"is_success": bool(right)}
