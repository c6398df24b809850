"""What algorithms, policies and their programs must not do without a word."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_progpolicy import (
    ProgrammaticPolicy,
    RecurrentProgrammaticPolicy,
    ReptilePPO,
    evaluate_model,
    evaluate_program,
    extract_program,
    holds_program,
)
from sb3_progpolicy.interaction import InteractionHistory, VecInteractionHistory
from sb3_progpolicy.normalization import NormalizingExtractor
from sb3_progpolicy.programs.validation import _count_numbers, check_size
from sb3_progpolicy.spaces import action_spec

SMALL = {"n_steps": 16, "batch_size": 32, "n_epochs": 1, "seed": 0, "device": "cpu"}
RATE = {"lr_schedule": lambda _: 1e-3}
BOX = spaces.Box(-1, 1, (4,), np.float32)


class Offset(gym.Env):
    """Its actions begin at 1."""

    observation_space = BOX
    action_space = spaces.Discrete(3, start=1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(4, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return np.zeros(4, np.float32), 0.0, False, False, {}


def cartpole(n_envs=2):
    return make_vec_env("CartPole-v1", n_envs, seed=0)


def test_a_policy_that_forgets_at_an_episodes_start_is_no_program():
    kwargs = {"reset_state_at_episode_start": True}
    model = RecurrentPPO(RecurrentProgrammaticPolicy, cartpole(), policy_kwargs=kwargs, **SMALL)
    assert not holds_program(model)
    with pytest.raises(ValueError, match="reset_state_at_episode_start=True cannot be extracted"):
        extract_program(model)
    for kept in ({}, {**kwargs, "cell": "affine"}):
        model = RecurrentPPO(RecurrentProgrammaticPolicy, cartpole(), policy_kwargs=kept, **SMALL)
        assert holds_program(model)
        extract_program(model)
    with pytest.raises(ValueError, match="reset_state_at_episode_start=True is not accepted; in ReptilePPO"):
        ReptilePPO("ProgPolicy", "CartPole-v1", policy_kwargs=kwargs, **SMALL)


def test_a_model_of_before_that_asked_for_it_is_loaded(tmp_path, monkeypatch):
    kwargs = {"reset_state_at_episode_start": True}
    with monkeypatch.context() as before:
        before.setattr("sb3_progpolicy.reptile_ppo.algorithm.complete_policy_kwargs", lambda given, *_: given)
        plain = {"normalize_observations": False, "policy_kwargs": kwargs}
        model = ReptilePPO("ProgPolicy", "CartPole-v1", n_envs=2, **plain, **SMALL)
        model.save(tmp_path / "model")
    loaded = ReptilePPO.load(tmp_path / "model", device="cpu")
    assert loaded.program().controllers


@pytest.mark.parametrize("wrapped", ["around", "single"])
def test_vec_normalize_around_the_history_is_evaluated_and_extracted(wrapped):
    if wrapped == "around":
        venv = VecInteractionHistory(cartpole())
    else:
        venv = make_vec_env("CartPole-v1", 2, seed=0, wrapper_class=InteractionHistory)
    normalized = VecNormalize(venv, clip_obs=1e9)  # of the history, too, which has rewards as they are
    model = PPO(ProgrammaticPolicy, normalized, policy_kwargs={"depth": 1}, **SMALL).learn(64)
    (of_model,) = evaluate_model(model, "CartPole-v1", n_episodes=3)
    (of_program,) = evaluate_program(extract_program(model), "CartPole-v1", n_episodes=3)
    assert of_program.return_mean == of_model.return_mean


def test_only_a_history_of_scaled_rewards_is_refused():
    around = VecNormalize(VecInteractionHistory(cartpole()))
    ReptilePPO("PRLPolicy", around, **SMALL).learn(32).program()
    beneath = VecInteractionHistory(VecNormalize(cartpole()))
    with pytest.raises(ValueError, match="VecNormalize with norm_reward=True is not accepted"):
        ReptilePPO("PRLPolicy", beneath, **SMALL)
    with pytest.raises(ValueError, match="cannot be trained on rewards that VecNormalize scales"):
        extract_program(PPO(ProgrammaticPolicy, beneath, **SMALL))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"depth": 70}, "a program of 69 conditions is not accepted; it has at most 64"),
        ({"depth": 40, "condition_size": 60}, "weights and constants is not accepted; it has at most 250000"),
        ({"depth": 2.5}, "depth=2.5 is not accepted; it is a whole number of at least 1"),
        ({"condition_size": 1.5}, "condition_size=1.5 is not accepted; it is a whole number"),
        ({"n_conditions": -1}, "n_conditions=-1 is not accepted; it is a whole number of at least 0"),
        ({"cell": 3}, "cell=3 is not accepted; known cells: affine"),
        ({"net_arch": 64}, "net_arch=64 is not accepted; it is a list of layer sizes"),
        ({"net_arch": [64, "64"]}, "net_arch=.* is not accepted; it is a list of layer sizes"),
        ({"net_arch": {"critic": [8]}}, "by network"),
        ({"activation_fn": "relu"}, "activation_fn='relu' is not accepted; it is a class of torch.nn"),
        ({"persistence_init": 1.0}, "the last inputs are not the previous action, reward and done flag"),
        ({"features_extractor_class": NormalizingExtractor}, "only ReptilePPO updates its statistics"),
    ],
)
def test_a_policys_arguments_are_checked_by_name(arguments, message):
    with pytest.raises(ValueError, match=message):
        RecurrentProgrammaticPolicy(BOX, spaces.Discrete(2), **RATE, **arguments)


def test_wide_inputs_are_refused_before_training():
    with pytest.raises(ValueError, match="a program of 40000 inputs is not accepted; it has at most 32768"):
        ProgrammaticPolicy(spaces.Box(-1, 1, (40_000,)), spaces.Discrete(2), **RATE)


@pytest.mark.parametrize("cell", ["gru", "lstm", "rnn", "affine", "min"])
def test_the_size_that_is_checked_is_that_of_the_program(cell, monkeypatch):
    kwargs = {"cell": cell, "condition_size": 3, "n_conditions": 2}
    program = RecurrentProgrammaticPolicy(BOX, spaces.Discrete(3), **RATE, **kwargs).program()
    for n_numbers in (_count_numbers(program), _count_numbers(program) - 1):
        monkeypatch.setattr("sb3_progpolicy.programs.validation.MAX_NUMBERS", n_numbers)
        if n_numbers == _count_numbers(program):
            check_size(4, program.action, 2, cell, 3)
        else:
            with pytest.raises(ValueError, match=f"a program of {n_numbers + 1} weights"):
                check_size(4, program.action, 2, cell, 3)


def test_persistence_is_for_policies_that_see_their_previous_action():
    kwargs = {"persistence_init": 1.0}
    for venv in (VecInteractionHistory(cartpole()), make_vec_env("Pendulum-v1", wrapper_class=InteractionHistory)):
        PPO(ProgrammaticPolicy, venv, policy_kwargs=kwargs, **SMALL)
    with pytest.raises(ValueError, match="the last inputs are not"):
        PPO(ProgrammaticPolicy, cartpole(), policy_kwargs=kwargs, **SMALL)


def test_actions_that_do_not_start_at_0_are_for_reptile_ppo(tmp_path):
    with pytest.raises(ValueError, match=r"actions from 0 on, where the program acts from 1 on"):
        PPO(ProgrammaticPolicy, Offset(), **SMALL)
    with pytest.raises(ValueError, match="are not accepted; they are from 1 to 3"):
        PPO("MlpPolicy", VecInteractionHistory(make_vec_env(Offset, 2)), **SMALL).learn(32)
    model = ReptilePPO("ProgPolicy", make_vec_env(Offset, 2), **SMALL).learn(32)
    assert action_spec(model.action_space).start == model.program().action.start == 1
    model.policy.save(tmp_path / "policy")
    loaded = RecurrentProgrammaticPolicy.load(tmp_path / "policy")
    assert isinstance(loaded.features_extractor, NormalizingExtractor)
    assert all(th.equal(one, other) for one, other in zip(loaded.parameters(), model.policy.parameters(), strict=True))
