"""The standalone Python file against the torch module it came from, on recorded Hanoi states."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.programs import export_python

N_STATES = 10_000


def briefly_trained(cell, depth):
    """A program with its conditions kept, some updates away from its random start."""
    model = ReptilePPO(
        "ProgPolicy",
        "Hanoi-v0",
        n_envs=16,
        n_steps=32,
        learning_rate=0.02,
        length_coef=0.0,
        normalize_observations=False,
        policy_kwargs={"depth": depth, "cell": cell, "condition_size": 2},
        seed=0,
        device="cpu",
    )
    model.learn(16 * 32 * 8)
    model.policy.module.search.select(depth - 1)
    return model


@pytest.mark.parametrize(("cell", "depth"), [("gru", 3), ("lstm", 2), ("rnn", 3), ("affine", 2), ("gru", 1)])
def test_exported_python_acts_as_the_crisp_torch_program_on_ten_thousand_hanoi_states(cell, depth):
    model = briefly_trained(cell, depth)
    namespace = {}
    exec(export_python(model.program()), namespace)  # our own text, just written
    standalone = namespace["ProgramPolicy"]()
    env = gym.make("Hanoi-v0")
    rng = np.random.default_rng(0)
    observation, _ = env.reset(options={"n_discs": 1})
    action, reward, done = None, 0.0, False
    inputs, actions = [], []
    for _ in range(N_STATES):
        one_hot = np.eye(6)[action] if action is not None else np.zeros(6)
        inputs.append(np.concatenate((observation, one_hot, [reward, done])))
        actions.append(standalone.act(observation.tolist(), action, reward, done))
        # Now and then another action, so that more states are seen than the program's own path.
        action = actions[-1] if rng.random() < 0.7 else int(rng.integers(6))
        observation, reward, terminated, truncated, _ = env.step(action)
        done = terminated or truncated
        if done:
            observation, _ = env.reset(options={"n_discs": int(rng.integers(1, 9))})
    module, x = model.policy.module.double(), th.as_tensor(np.array(inputs))[:, None]
    with th.no_grad():
        parameters, _ = module(x, module.initial_state(1), crisp=True)
    assert actions == parameters[:, 0].argmax(-1).tolist()
    assert len(set(actions)) > 1
