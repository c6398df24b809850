"""Exploration that keeps its way: controllers that favour their previous action at the start."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_progpolicy import ReptilePPO

SMALL = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "n_epochs": 2, "seed": 0, "device": "cpu"}


class Idle(gym.Env):
    """Observes nothing and counts how often an action was the one before."""

    def __init__(self, action_space):
        self.observation_space, self.action_space = spaces.Box(-1, 1, (1,)), action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        return np.zeros(1, dtype=np.float32), 0.0, False, False, {}


def share_repeated(**policy_kwargs):
    model = ReptilePPO("ProgPolicy", Idle(spaces.Discrete(3)), n_steps=1000, policy_kwargs=policy_kwargs, seed=0)
    model.learn(1000)  # the rollout is collected before the first update
    actions = model.rollout_buffer.actions.ravel()
    return np.mean(actions[1:] == actions[:-1])


def test_actions_are_repeated_as_often_as_the_weight_says():
    assert share_repeated() == pytest.approx(1 / 3, abs=0.05)
    logit = 3.0
    assert share_repeated(persistence_init=logit) == pytest.approx(np.exp(logit) / (np.exp(logit) + 2), abs=0.05)


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.Box(-1, 1, (2,)), spaces.MultiDiscrete([2, 3])])
def test_weights_are_those_of_the_previous_action_alone(space):
    models = [
        ReptilePPO("ProgPolicy", Idle(space), seed=0, n_steps=16, policy_kwargs={"persistence_init": weight})
        for weight in (0.0, 2.0)
    ]
    plain, persistent = (model.policy.module.controllers.weight for model in models)
    n_outputs = models[0].policy.module.action.n_outputs
    added = (persistent - plain).detach().numpy().reshape(-1, n_outputs, 1 + n_outputs + 2)
    expected = np.zeros((n_outputs, 1 + n_outputs + 2))
    expected[:, 1 : 1 + n_outputs] = 2 * np.eye(n_outputs)
    assert np.allclose(added, expected, atol=1e-6)


def test_tied_weights_stay_tied():
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", symmetric=True, policy_kwargs={"persistence_init": 2.0}, **SMALL)
    program = model.program()
    first = program.input_names.index("previous move 0->1")
    block = np.array([controller.weights for controller in program.controllers])[0][:, first : first + 6]
    assert np.diag(block) == pytest.approx([block[0, 0]] * 6)
    assert block[0, 0] > 1.5 > np.abs(block - np.diag(np.diag(block))).max()


def test_loaded_model_keeps_what_training_made_of_it(tmp_path):
    model = ReptilePPO("ProgPolicy", "CartPole-v1", policy_kwargs={"persistence_init": 1.0}, **SMALL).learn(64)
    model.save(tmp_path / "model")
    assert ReptilePPO.load(tmp_path / "model").program() == model.program()


@pytest.mark.parametrize(
    ("weight", "arguments", "message"),
    [
        (1.0, {"interaction_history": False}, "does not see its previous action"),
        (float("nan"), {}, "it is a finite number"),
    ],
)
def test_values_that_are_not_accepted_are_named(weight, arguments, message):
    with pytest.raises(ValueError, match=message):
        ReptilePPO("ProgPolicy", "CartPole-v1", policy_kwargs={"persistence_init": weight}, **SMALL, **arguments)
