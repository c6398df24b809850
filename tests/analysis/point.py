"""A point in the plane that is to be moved to the origin: the smallest domain with continuous actions."""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from progpolicy_envs import DOMAINS, register_domain
from progpolicy_envs.symmetry import Permutation, Symmetry
from sb3_progpolicy.programs import ActionSpec, Condition, Controller, IfThenElse, Program

ID = "Point-v0"
NAMES = ("x", "y", "noise")
#: Both directions are alike.
SWAP = Symmetry("directions", Permutation.of((1, 0, 2)), Permutation.of((1, 0)))


class PointEnv(gym.Env):
    """Starts ``distance`` away, moves by a tenth of the action, and has arrived within 0.05."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_names = NAMES
    action_names = ("move_x", "move_y")

    def __init__(self, distance=1.0, render_mode=None):
        self.distance = distance
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def _observation(self):
        return np.array([*self.place, self.np_random.normal()], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.distance = (options or {}).get("distance", self.distance)
        angle = self.np_random.uniform(0, 2 * np.pi)
        self.place = self.distance * np.array([np.cos(angle), np.sin(angle)])
        return self._observation(), {}

    def step(self, action):
        before = np.linalg.norm(self.place)
        self.place = self.place + 0.1 * np.clip(action, -1, 1)
        after = np.linalg.norm(self.place)
        arrived = bool(after < 0.05)
        return self._observation(), float(before - after) - 0.02, arrived, False, {"is_success": arrived}


@contextlib.contextmanager
def registered():
    """Make the domain known for a while."""
    gym.register(ID, entry_point=PointEnv, max_episode_steps=60)
    train = [{"distance": distance} for distance in (0.5, 1.0)]
    register_domain(ID, "distance", train, [{"distance": 1.5}], [{"distance": 2.0}])
    try:
        yield
    finally:
        del DOMAINS[ID], gym.registry[ID]


def slow(gain=-1.0, **fields):
    """Moves by a share of the distance, so that it takes ever smaller steps; the inner branch is never reached."""
    towards = Controller(((gain, 0.0, 0.0), (0.0, gain, 0.0)), (0.0, 0.0))
    always = Condition("affine", (), (), (), (), (0.0, 0.0, 0.0), 1.0)
    body = IfThenElse(always, towards, Controller(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (0.0, 0.0)))
    spec = ActionSpec("box", (2,), (-1.0, -1.0), (1.0, 1.0))
    metadata = {"env": ID, "learned_by": "imitation"}
    return Program(body, 3, spec, False, NAMES, ("move_x", "move_y"), metadata=metadata, **fields)
