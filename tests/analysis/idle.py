"""A program that always does the same."""

import gymnasium as gym

from sb3_progpolicy.programs import Controller, Program
from sb3_progpolicy.spaces import action_spec


def idle(env_id, interaction=False):
    """A program for an environment that reads everything and heeds nothing."""
    env = gym.make(env_id)
    n, spec = env.observation_space.shape[0], action_spec(env.action_space)
    n_inputs = n + (spec.interaction_size if interaction else 0)
    controller = Controller(((0.0,) * n_inputs,) * spec.n_outputs, tuple(map(float, range(spec.n_outputs))))
    names = tuple(f"x{i}" for i in range(n_inputs)), tuple(f"a{i}" for i in range(spec.n_outputs))
    return Program(controller, n, spec, interaction, *names)
