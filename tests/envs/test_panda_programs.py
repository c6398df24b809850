"""The hand-written Panda programs solve what their module says they solve."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import gymnasium as gym
import pytest

import progpolicy_envs

_SPEC = importlib.util.spec_from_file_location(
    "handwritten_panda", Path(__file__).parents[1] / "handwritten" / "panda.py"
)
assert _SPEC is not None
assert _SPEC.loader is not None
handwritten = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(handwritten)


@pytest.mark.parametrize(
    ("env_id", "size"),
    [("PandaReach-v0", 1), ("PandaReach-v0", 8), ("PandaPush-v0", 1), ("PandaPush-v0", 8), ("PandaStack-v0", 1)],
)
def test_program_solves(env_id, size):
    env = gym.make(env_id, disable_env_checker=True)
    for seed in range(3):
        observation, _ = env.reset(seed=seed, options={progpolicy_envs.get_domain(env_id).size: size})
        terminated = truncated = False
        while not (terminated or truncated):
            action = handwritten.act(handwritten.PROGRAMS[env_id], observation)
            observation, _, terminated, truncated, info = env.step(action)
        assert info["is_success"], seed
