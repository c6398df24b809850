"""ReptilePPO: states in rollouts, and what is noted for training."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_progpolicy.reptile_ppo.rollout import PolicyActor
from sb3_progpolicy.vec_env import make_fast_vec_env
from tests.reptile_ppo.models import Each, OneStep, make, weights


@pytest.mark.parametrize("policy", ["ProgPolicy", "MlpLstmPolicy"])
def test_hidden_state_survives_episode_end_but_not_task_switch(policy):
    kwargs = {"n_steps": 8, "batch_size": 16, "inner_updates": 2, "search_fraction": 1.0}
    model = make(policy, DummyVecEnv([OneStep] * 2), **kwargs)
    at_start = []

    class Watch(BaseCallback):
        def _on_rollout_start(self):
            at_start.append(bool((self.model._last_lstm_states.pi[0] == 0).all()))

        def _on_step(self):
            assert self.locals["dones"].all()
            return True

    model.learn(64, callback=Watch())
    assert at_start == [True, False, True, False]
    # Every episode ends after one step: a state that did not survive would depend on the last X alone.
    buffer = model.rollout_buffer
    x = th.as_tensor(buffer.observations.reshape(8, 2, -1)[-1])
    alone = model.policy.predict(x.numpy(), None)[1][0]
    assert np.abs(model._last_lstm_states.pi[0].numpy() - alone).max() > 1e-4


def log_ratios(model):
    """Of all the transitions in the first epoch, before any parameter has moved."""
    captured = []
    evaluate = model.adapter.evaluate

    def watched(batch):
        values, log_prob, entropy = evaluate(batch)
        # An update of W evaluates no values.
        difference = th.zeros(1) if values is None else batch["values"].flatten() - values.flatten()
        captured.append((batch["log_probs"].flatten() - log_prob.detach(), difference))
        return values, log_prob, entropy

    model.learning_rate, model.lr_schedule = 0.0, lambda _: 0.0
    model.adapter.evaluate = watched
    model.learn(2 * model.n_steps * model.n_envs)
    del model.adapter.evaluate
    assert sum(len(ratio) for ratio, _ in captured) == 2 * model.n_steps * model.n_envs
    return captured


@pytest.mark.parametrize("batch_size", [64, 8])
@pytest.mark.parametrize("env_id", ["Hanoi-v0", "Pendulum-v1"])
@pytest.mark.parametrize(
    ("policy", "policy_kwargs"),
    [
        *(("ProgPolicy", {"cell": cell, "condition_size": 2}) for cell in ("gru", "lstm", "rnn", "affine")),
        ("PRLPolicy", {}),
        ("MlpLstmPolicy", {"lstm_hidden_size": 4}),
    ],
)
def test_first_epoch_starts_at_the_log_probabilities_of_the_rollout(policy, policy_kwargs, env_id, batch_size):
    model = make(policy, env_id, n_steps=32, batch_size=batch_size, n_epochs=1, policy_kwargs=policy_kwargs)
    for ratio, values in log_ratios(model):
        assert ratio.abs().max() < 1e-5
        assert values.abs().max() < 1e-4


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch")
def test_where_the_batch_size_does_not_divide_the_rollout_sequences_are_shorter_and_a_warning_says_so():
    with pytest.warns(UserWarning, match="n_steps=16: gradient steps are made on 1 sequences of 8 steps"):
        model = make(batch_size=12, n_epochs=1)
    ratios = [ratio for ratio, _ in log_ratios(model)]
    assert {len(ratio) for ratio in ratios} == {8}
    assert max(ratio.abs().max() for ratio in ratios) < 1e-5


@pytest.mark.parametrize("cell", ["gru", "lstm", "rnn"])
def test_rollout_of_the_sampler_is_that_of_the_policy_stepped_by_hand(cell):
    kwargs = {"inner_updates": 1, "n_epochs": 1, "learning_rate": 0.0, "normalize_observations": False}
    model = make(policy_kwargs={"cell": cell}, **kwargs)
    model.learn(64)
    buffer, state = model.rollout_buffer, model.policy.module.initial_state(4)
    observations = th.as_tensor(buffer.observations.reshape(16, 4, -1))
    actions = th.as_tensor(buffer.actions.reshape(16, 4))
    for t in range(16):
        distribution, state = model.policy.get_distribution(observations[t], state, th.ones(4))
        expected = distribution.log_prob(actions[t]).detach()
        th.testing.assert_close(th.as_tensor(buffer.log_probs.reshape(16, 4)[t]), expected, atol=1e-5, rtol=1e-5)
    th.testing.assert_close(model._last_lstm_states.pi[0], state[0].detach(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("policy", "cell", "space"),
    [
        *(("ProgPolicy", cell, spaces.Discrete(2, start=5)) for cell in ("gru", "lstm", "rnn", "affine")),
        ("ProgPolicy", "gru", spaces.Box(-1, 1, (2,))),
        ("ProgPolicy", "gru", spaces.MultiDiscrete([2, 3])),
        ("ProgPolicy", "gru", spaces.MultiBinary(2)),
        ("PRLPolicy", "affine", spaces.Discrete(2, start=5)),
    ],
)
def test_policies_train_without_the_sampler(policy, cell, space):
    env = DummyVecEnv([lambda: OneStep(space)] * 4)
    model = make(policy, env, n_epochs=1, search_fraction=1.0, policy_kwargs={"cell": cell})
    # As on a GPU, where the policy itself acts in rollouts.
    model.adapter.make_actor = lambda states, buffer, n_steps, rng: PolicyActor(model.policy, states, buffer)
    # Rollouts for an update of phi and one of W, each from parameters that have not moved since.
    for ratio, values in log_ratios(model):
        assert ratio.abs().max() < 1e-5
        assert values.abs().max() < 1e-4
    assert isinstance(model._actor, PolicyActor)
    before = weights(model)
    model.lr_schedule = lambda _: 0.01
    model.learn(model.n_steps * model.n_envs * 2)
    assert (weights(model) != before).any()


@pytest.mark.parametrize(
    ("env", "bootstrapped"),
    [
        (lambda: make_fast_vec_env("Pendulum-v1", 2), [199]),  # cut off after 200 steps
        (lambda: DummyVecEnv([OneStep] * 2), []),  # every step ends an episode
    ],
)
def test_truncated_episodes_are_bootstrapped_and_ended_ones_are_not(env, bootstrapped):
    model = make(env=env(), n_steps=256, batch_size=256, gamma=0.5, n_epochs=1)
    raw = []
    model.learn(512, callback=Each(lambda _, local: raw.append(local["rewards"].copy())))
    extra = model.rollout_buffer.rewards.reshape(256, 2) - np.array(raw)
    assert np.flatnonzero(np.abs(extra).sum(1)).tolist() == bootstrapped


class Endless(gym.Env):
    """Nothing happens, and every step is worth 1."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(2, np.float32), {}

    def step(self, action):
        return np.ones(2, np.float32), 1.0, False, False, {"is_success": False}


@th.no_grad()
def critic(model, observation):
    return model._predict_values(th.as_tensor(observation[None], dtype=th.float32), [0]).item()


@pytest.mark.parametrize(
    ("env", "policy"),
    [
        (lambda: make_fast_vec_env("Hanoi-v0", 2, n_discs=12, max_episode_steps=5), "ProgPolicy"),
        (lambda: make_fast_vec_env("Hanoi-v0", 2, n_discs=12, max_episode_steps=5), "MlpPolicy"),
        (lambda: DummyVecEnv([lambda: gym.wrappers.TimeLimit(Endless(), 5)] * 2), "ProgPolicy"),
    ],
)
def test_after_a_time_limit_nothing_is_earned_where_timeouts_are_terminal(env, policy):
    gamma, n_steps, limit = 0.5, 16, 5
    kwargs = {"gamma": gamma, "n_steps": n_steps, "gae_lambda": 1.0, "n_epochs": 1, "tasks": [{}]}
    kwargs |= {"learning_rate": 0.0, "normalize_observations": False}  # so that the critic stays what it is
    for timeouts in ("bootstrap", "terminal"):
        model = make(policy, env(), timeouts=timeouts, **kwargs)
        rewards, after = [], []

        def record(model, local, rewards=rewards, after=after):
            rewards.append(local["rewards"].copy())
            ends = [info.get("terminal_observation") for info in local["infos"]]
            assert (ends[0] is not None) == (len(rewards) % limit == 0)
            after.append([0.0 if end is None else critic(model, end) for end in ends])

        model.learn(n_steps * model.n_envs, callback=Each(record))
        expected, follows = np.zeros((n_steps, 2)), np.array([critic(model, obs) for obs in model._last_obs])
        for step in reversed(range(n_steps)):
            if (step + 1) % limit == 0:
                follows = np.array(after[step]) if timeouts == "bootstrap" else np.zeros(2)
            expected[step] = follows = rewards[step] + gamma * follows
        buffer = model.rollout_buffer
        np.testing.assert_allclose(buffer.returns, expected, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(buffer.advantages, expected - buffer.values, rtol=1e-4, atol=1e-4)
        ends = np.arange(n_steps) % limit == limit - 1
        same = np.isclose(buffer.returns[ends], np.array(rewards)[ends])
        assert same.all() if timeouts == "terminal" else not same.any()
