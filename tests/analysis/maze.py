"""A corridor with a cue at its beginning that is to be remembered to its end: the smallest task that needs a memory."""

from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from progpolicy_envs import DOMAINS, register_domain
from sb3_progpolicy.programs import ActionSpec, Condition, Controller, IfThenElse, Program

ID = "Corridor-v0"
NAMES = ("cue_left", "cue_right", "at_end", "light")
MOVES = ("forward", "left", "right")
FORWARD, LEFT, RIGHT = range(3)


class CorridorEnv(gym.Env):
    """The cue is seen at the first step only; at the end the agent turns to the side that it has named."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_names = NAMES
    action_names = MOVES

    def __init__(self, length=3, render_mode=None):
        self.length = length
        self.observation_space = spaces.Box(-1, 1, (4,), np.float32)
        self.action_space = spaces.Discrete(3)

    def _observation(self):
        cue = (self.side == LEFT, self.side == RIGHT) if self.place == 0 else (0, 0)
        return np.array([*cue, self.place == self.length, self.np_random.integers(2)], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.length = (options or {}).get("length", self.length)
        self.side, self.place = int(self.np_random.integers(LEFT, RIGHT + 1)), 0
        return self._observation(), {}

    def step(self, action):
        at_end = self.place == self.length
        solved = bool(at_end and action == self.side)
        over = solved or action != FORWARD
        self.place += int(not over and not at_end)
        return self._observation(), float(solved), bool(over), False, {"is_success": solved}


@contextlib.contextmanager
def registered():
    """Make the domain known for a while."""
    gym.register(ID, entry_point=CorridorEnv, max_episode_steps=20)
    register_domain(ID, "length", [{"length": 2}, {"length": 3}], [{"length": 4}], [{"length": 6}])
    try:
        yield
    finally:
        del DOMAINS[ID], gym.registry[ID]


def program(memory: Condition) -> Program:
    """Turns right at the end while the memory is on, and left while it is off."""

    def turning(side):
        rows = [[0.0] * 4 for _ in MOVES]
        rows[side][NAMES.index("at_end")] = 2.0
        return Controller(tuple(map(tuple, rows)), (1.0, 0.0, 0.0))

    body = IfThenElse(memory, turning(RIGHT), turning(LEFT))
    return Program(body, 4, ActionSpec("discrete", (3,)), False, NAMES, MOVES, metadata={"env": ID})


#: Tanh of one unit that is kept by its own weight, and set by the cues: a switch in all but its form.
LATCH = Condition("rnn", ((-7.3, 6.1, 0.02, 0.01),), ((3.4,),), (-0.1,), (0.0,), (1.7,), 0.3)
#: It turns with every step, whatever it reads.
TURNS = Condition("rnn", ((0.0, 0.0, 0.0, 0.0),), ((-3.0,),), (1.0,), (0.0,), (1.0,), 0.0)
#: The switch, written by hand.
SWITCH = Condition(
    "switch", ((0.0, 1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), ((0.0,), (0.0,)), (-1.0, -1.0), (0.0, 0.0), (1.0,), -0.5
)
