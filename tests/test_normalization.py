"""Running statistics of observations and rewards."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_progpolicy.normalization import NormalizingExtractor, RewardScaler
from tests.differentiable.test_module import CELLS, N_INPUTS, N_SEQUENCES, make_module, parameters_of


def make_extractor(n_features=N_INPUTS, n_batches=3):
    extractor = NormalizingExtractor(spaces.Box(-np.inf, np.inf, (n_features,)))
    rng = np.random.default_rng(0)
    shift, scale = rng.normal(size=n_features) * 3, rng.uniform(0.1, 10, size=n_features)
    seen = [rng.normal(size=(50 + 10 * i, n_features)) * scale + shift for i in range(n_batches)]
    for batch in seen:
        extractor.update(batch)
    return extractor, np.concatenate(seen)


def test_statistics_are_those_of_all_that_was_seen():
    extractor, seen = make_extractor()
    np.testing.assert_allclose(extractor.mean, seen.mean(0), rtol=1e-6)
    np.testing.assert_allclose(extractor.variance, seen.var(0), rtol=1e-6)
    normalised = extractor(th.as_tensor(seen, dtype=th.float32)).numpy()
    np.testing.assert_allclose(normalised.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(normalised.std(0), 1, atol=1e-4)


def test_numbers_are_unchanged_before_the_first_update_and_constants_only_shifted():
    extractor = NormalizingExtractor(spaces.Box(-1, 1, (2,)))
    np.testing.assert_allclose(extractor(th.tensor([[0.3, -0.5]])), [[0.3, -0.5]], atol=1e-6)
    extractor.update(np.tile([2.0, 1.0], (10, 1)))
    np.testing.assert_allclose(extractor(th.tensor([[2.0, 3.0]])), [[0.0, 2.0]], atol=1e-6)


def test_statistics_travel_with_the_state_dict():
    extractor, _ = make_extractor()
    other = NormalizingExtractor(spaces.Box(-np.inf, np.inf, (N_INPUTS,)))
    other.load_state_dict(extractor.state_dict())
    x = th.randn(3, N_INPUTS)
    th.testing.assert_close(other(x), extractor(x))


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("depth", [1, 3])
def test_normaliser_folds_exactly_into_the_program(cell, depth):
    extractor, seen = make_extractor()
    module = make_module("box", cell, depth=depth)
    n_steps = len(seen) // N_SEQUENCES
    raw = th.as_tensor(seen[: n_steps * N_SEQUENCES], dtype=th.float32).reshape(n_steps, N_SEQUENCES, N_INPUTS)
    expected = parameters_of(module, extractor(raw.flatten(0, 1)).reshape(raw.shape))
    assert not th.allclose(parameters_of(module, raw), expected, atol=0.1)
    extractor.fold_into(module)
    th.testing.assert_close(parameters_of(module, raw), expected, atol=1e-5, rtol=1e-5)


def test_rewards_are_scaled_as_vec_normalize_scales_them():
    rng, n_envs = np.random.default_rng(0), 4
    ours, theirs = RewardScaler(0.9), VecNormalize(make_vec_env("CartPole-v1", n_envs), norm_obs=False, gamma=0.9)
    for _ in range(200):
        rewards, dones = rng.exponential(size=n_envs), rng.random(n_envs) < 0.1
        scaled = ours(rewards, dones)
        theirs._update_reward(rewards)
        np.testing.assert_allclose(scaled, theirs.normalize_reward(rewards), rtol=1e-5)
        theirs.returns[dones] = 0
    assert scaled.dtype == np.float32


def test_first_rewards_of_equal_environments_do_not_explode():
    scaler = RewardScaler(0.99)
    assert np.abs(scaler(np.ones(32), np.zeros(32, bool))).max() <= 10


def test_a_new_task_starts_new_returns_and_keeps_the_statistics():
    scaler = RewardScaler(0.9)
    for _ in range(20):
        scaler(np.array([1.0, 5.0]), np.zeros(2, bool))
    variance, count = float(scaler.statistics.var), scaler.statistics.count
    scaler.reset_returns()
    assert float(scaler.statistics.var) == variance
    mean = float(scaler.statistics.mean)
    scaler(np.array([1.0, 5.0]), np.zeros(2, bool))
    # Two returns more, which are the rewards themselves.
    assert scaler.statistics.count == count + 2
    assert float(scaler.statistics.mean) == pytest.approx((mean * count + 1 + 5) / (count + 2))
