"""Programmatic policies in the stock algorithms of SB3 and sb3-contrib."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_progpolicy import ProgrammaticPolicy, RecurrentProgrammaticPolicy

BOTH = pytest.mark.parametrize(
    ("algorithm", "policy"), [(RecurrentPPO, RecurrentProgrammaticPolicy), (PPO, ProgrammaticPolicy)]
)
CARTPOLE = {"gamma": 0.98, "gae_lambda": 0.9, "n_epochs": 5, "batch_size": 128, "learning_rate": 0.02}
PENDULUM = {"gamma": 0.9, "gae_lambda": 0.95, "n_epochs": 8, "batch_size": 256, "learning_rate": 0.01}


class Copy(gym.Env):
    """The trivial rule: do what the observation says, one component at a time."""

    def __init__(self, action_space):
        self.action_space, self.observation_space = action_space, spaces.Box(0, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.wanted = 0, self.np_random.integers(2, size=2)
        return self.wanted.astype(np.float32), {}

    def step(self, action):
        reward = float((np.asarray(action) == self.wanted).sum())
        self.t, self.wanted = self.t + 1, self.np_random.integers(2, size=2)
        return self.wanted.astype(np.float32), reward, self.t == 10, False, {}


def make(algorithm, policy, env, **kwargs):
    return algorithm(policy, env, seed=0, device="cpu", **{"n_steps": 64, "policy_kwargs": {"depth": 2}, **kwargs})


def mean_return(model, env_id, episodes=10):
    return evaluate_policy(model, make_vec_env(env_id, 5, seed=100), episodes)[0]


@BOTH
def test_cartpole_is_solved(algorithm, policy):
    model = make(algorithm, policy, make_vec_env("CartPole-v1", 8), **CARTPOLE).learn(8_000)
    assert mean_return(model, "CartPole-v1") >= 195


@pytest.mark.slow
@BOTH
def test_pendulum_is_learned(algorithm, policy):
    model = make(algorithm, policy, make_vec_env("Pendulum-v1", 16), **PENDULUM, policy_kwargs={"depth": 3})
    before = mean_return(model, "Pendulum-v1")
    model.learn(22_000)
    # Random actions and a policy that stands still both get about -1200.
    assert before < -900
    assert mean_return(model, "Pendulum-v1") > -700


@BOTH
@pytest.mark.parametrize("space", [spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)])
def test_trivial_rule_is_learned_with_several_actions_at_once(algorithm, policy, space):
    env = DummyVecEnv([lambda: Copy(space)] * 8)
    model = make(algorithm, policy, env, n_steps=32, batch_size=64, n_epochs=6, gamma=0.0, learning_rate=0.03).learn(
        2_000
    )
    assert evaluate_policy(model, DummyVecEnv([lambda: Copy(space)]), 3, warn=False)[0] == 20


@BOTH
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_saved_and_loaded_model_acts_alike_and_trains_on(algorithm, policy, env_id, tmp_path):
    env = make_vec_env(env_id, 2)
    model = make(algorithm, policy, env, n_steps=16, batch_size=16, policy_kwargs={"depth": 4, "temperature": 0.5})
    model.learn(64)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env, device="cpu")
    other = make(algorithm, policy, env, n_steps=16, batch_size=16, policy_kwargs={"depth": 4}, learning_rate=1.0)
    other.learn(64)
    other.set_parameters(model.get_parameters())
    observation = env.reset()
    for copy in (loaded, other):
        for mine, theirs in zip(model.policy.state_dict().values(), copy.policy.state_dict().values(), strict=True):
            th.testing.assert_close(mine, theirs, rtol=0, atol=0)
        np.testing.assert_array_equal(
            model.predict(observation, deterministic=True)[0], copy.predict(observation, deterministic=True)[0]
        )
    loaded.learn(64)


@BOTH
def test_policy_alone_is_saved_and_loaded(algorithm, policy, tmp_path):
    kwargs = {"depth": 3, "condition_size": 2, "net_arch": [8], "temperature": 0.3}
    model = make(algorithm, policy, "Pendulum-v1", policy_kwargs=kwargs)
    model.policy.save(tmp_path / "policy.pth")
    loaded = policy.load(tmp_path / "policy.pth", device="cpu")
    observation = np.ones((4, 3), np.float32)
    np.testing.assert_array_equal(
        model.policy.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
    )
    assert loaded.program_kwargs == model.policy.program_kwargs


@pytest.mark.parametrize("cell", ["rnn", "gru", "lstm"])
def test_predict_keeps_the_state_across_episodes_and_zeroes_it_only_for_state_none(cell):
    model = make(RecurrentPPO, RecurrentProgrammaticPolicy, "CartPole-v1", policy_kwargs={"cell": cell})
    observation = np.ones((2, 4), np.float32)
    _, first = model.predict(observation, state=None, episode_start=np.ones(2, bool))
    _, going_on = model.predict(observation, first, np.zeros(2, bool))
    _, after_episode = model.predict(observation, first, np.ones(2, bool))
    _, afresh = model.predict(observation, None, np.zeros(2, bool))
    np.testing.assert_array_equal(after_episode, going_on)
    np.testing.assert_array_equal(afresh, first)
    assert (going_on[0] != first[0]).any()


@pytest.mark.parametrize("cell", ["rnn", "gru", "lstm"])
def test_state_is_zeroed_at_episode_starts_where_asked_for(cell):
    kwargs = {"cell": cell, "reset_state_at_episode_start": True}
    model = make(RecurrentPPO, RecurrentProgrammaticPolicy, "CartPole-v1", policy_kwargs=kwargs)
    observation = np.ones((2, 4), np.float32)
    _, first = model.predict(observation)
    _, second = model.predict(observation, first, np.array([True, False]))
    np.testing.assert_array_equal(second[0][:, 0], first[0][:, 0])
    assert (second[0][:, 1] != first[0][:, 1]).all()


@pytest.mark.parametrize("cell", ["rnn", "gru", "lstm"])
def test_gradients_flow_through_time_where_states_are_zeroed_at_episode_starts(cell):
    kwargs = {"cell": cell, "reset_state_at_episode_start": True}
    policy = make(RecurrentPPO, RecurrentProgrammaticPolicy, "CartPole-v1", policy_kwargs=kwargs).policy
    observations = th.randn(6, 4, requires_grad=True)
    zero = policy.module.initial_state(1)
    starts = th.tensor([1.0, 0, 0, 1.0, 0, 0])
    _, log_probs, _ = policy.evaluate_actions(observations, th.zeros(6), RNNStates(zero, zero), starts)
    log_probs[-1].backward()
    reached = observations.grad.abs().sum(1) > 0
    assert reached.tolist() == [False] * 3 + [True] * 3


@BOTH
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_training_starts_at_the_log_probabilities_of_the_rollout(algorithm, policy, env_id):
    model = make(algorithm, policy, make_vec_env(env_id, 2), n_steps=128, batch_size=64, n_epochs=1, learning_rate=0.0)
    model.learn(256)
    assert abs(model.logger.name_to_value["train/approx_kl"]) < 1e-6
    assert model.logger.name_to_value["train/clip_fraction"] == 0


def test_critic_has_no_state():
    policy = make(RecurrentPPO, RecurrentProgrammaticPolicy, "CartPole-v1").policy
    observation, starts = th.ones(2, 4), th.zeros(2)
    states = [(value * th.ones(1, 2, 1), value * th.ones(1, 2, 1)) for value in (0.0, 1.0)]
    th.testing.assert_close(*(policy.predict_values(observation, state, starts) for state in states))


def test_program_of_a_policy_reads_what_the_policy_reads():
    model = make(PPO, ProgrammaticPolicy, "CartPole-v1")
    program = model.policy.program()
    assert program.n_inputs == program.n_observations == 4
    assert program.input_names[0] == "x[0]"
    assert "x[1]" in str(program)


@pytest.mark.parametrize(
    ("policy", "arguments", "message"),
    [
        (RecurrentProgrammaticPolicy, {"cell": "transformer"}, "known cells"),
        (ProgrammaticPolicy, {"cell": "gru"}, "RecurrentProgrammaticPolicy"),
        (ProgrammaticPolicy, {"depth": 0}, "depth=0"),
        (ProgrammaticPolicy, {"temperature": 0.0}, "temperature=0.0"),
        (RecurrentProgrammaticPolicy, {"condition_size": 0}, "condition_size=0"),
        (RecurrentProgrammaticPolicy, {"use_sde": True}, "use_sde=True"),
    ],
)
def test_values_that_are_not_accepted_are_named(policy, arguments, message):
    box = spaces.Box(-1, 1, (2,))
    with pytest.raises(ValueError, match=message):
        policy(box, spaces.Discrete(2), lambda _: 1e-3, **arguments)


def test_observations_that_a_program_cannot_read_are_refused():
    with pytest.raises(ValueError, match="FlattenObservation"):
        PPO(ProgrammaticPolicy, "FrozenLake-v1")
