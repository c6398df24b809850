"""Discrete soft actor-critic: its equations, what it shares with SB3's algorithms, and that it learns."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger

from sb3_progpolicy import DiscreteSAC
from sb3_progpolicy.baselines.discrete_sac.update import ent_coef_loss, mean_entropy, policy_loss, soft_value

SMALL = {"learning_starts": 32, "batch_size": 16, "policy_kwargs": {"net_arch": [16]}, "device": "cpu", "seed": 0}


class Bandit(gym.Env):
    """One step; the action that the observation names pays 1."""

    observation_space = spaces.Box(0, 1, (3,), np.float32)

    def __init__(self, start=5, reward=1.0):
        self.action_space = spaces.Discrete(3, start=start)
        self.reward = reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.right = int(self.np_random.integers(3))
        return np.eye(3, dtype=np.float32)[self.right], {}

    def step(self, action):
        assert self.action_space.contains(action)
        won = int(action) - self.action_space.start == self.right
        return np.eye(3, dtype=np.float32)[self.right], self.reward * won, True, False, {}


class Corridor(gym.Env):
    """Six places in a row; the last pays 1 and ends the episode. Truncated after 30 steps."""

    observation_space = spaces.Box(0, 1, (6,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = 0, 0
        return np.eye(6, dtype=np.float32)[0], {}

    def step(self, action):
        self.place = max(0, self.place + (1 if action else -1))
        self.steps += 1
        there = self.place == 5
        return np.eye(6, dtype=np.float32)[self.place], float(there), there, not there and self.steps == 30, {}


class Records(Logger):
    """A logger that keeps what it is given."""

    def __init__(self):
        super().__init__(None, [])
        self.kept = {}

    def record(self, key, value, exclude=None):
        self.kept[key] = value


def test_soft_value_is_the_mean_q_and_the_entropy():
    log_probs, q = th.tensor([[0.25, 0.75]]).log(), th.tensor([[4.0, 8.0]])
    entropy = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75))
    assert soft_value(log_probs, q, th.tensor(0.5)).item() == pytest.approx(7 + 0.5 * entropy)
    assert mean_entropy(log_probs).item() == pytest.approx(entropy)
    assert policy_loss(log_probs, q, th.tensor(0.0)).item() == pytest.approx(-7)


def test_entropy_coefficient_rises_while_the_entropy_is_below_its_target():
    log_ent_coef = th.zeros(1, requires_grad=True)
    ent_coef_loss(log_ent_coef, th.tensor(0.2), 0.6).backward()
    assert log_ent_coef.grad.item() == pytest.approx(-0.4)


def test_policy_loss_leaves_the_critics_alone():
    q = th.zeros(1, 2, requires_grad=True)
    logits = th.zeros(1, 2, requires_grad=True)
    policy_loss(th.log_softmax(logits, 1), q + 1, th.tensor(0.1)).backward()
    assert q.grad is None
    assert logits.grad is not None


def test_learns_a_bandit_whose_actions_do_not_start_at_zero():
    model = DiscreteSAC("MlpPolicy", make_vec_env(Bandit, 4, seed=0), **{**SMALL, "learning_rate": 1e-2})
    model.learn(480)
    assert evaluate_policy(model, make_vec_env(Bandit, 1, seed=1), 30, deterministic=True)[0] == 1
    drawn = model.predict(np.eye(3, dtype=np.float32)[np.zeros(500, dtype=int)], deterministic=False)[0]
    assert drawn.min() >= 5
    assert set(drawn) <= {5, 6, 7}
    assert len(set(drawn)) > 1


def test_learns_what_pays_only_later():
    settings = {**SMALL, "learning_rate": 1e-2, "ent_coef": 0.02, "gamma": 0.9, "tau": 0.05}
    model = DiscreteSAC("MlpPolicy", make_vec_env(Corridor, 4, seed=0), **settings).learn(800)
    _, lengths = evaluate_policy(model, make_vec_env(Corridor, 1, seed=1), 1, return_episode_rewards=True)
    assert lengths == [5]


@pytest.mark.slow
def test_learns_to_balance_a_pole():
    model = DiscreteSAC(
        "MlpPolicy",
        make_vec_env("CartPole-v1", 4, seed=0),
        learning_rate=2e-3,
        learning_starts=500,
        batch_size=64,
        policy_kwargs={"net_arch": [64, 64], "optimizer_kwargs": {"fused": True}},
        seed=0,
        device="cpu",
    ).learn(5_000)
    mean, _ = evaluate_policy(model, make_vec_env("CartPole-v1", 10, seed=100), 10, deterministic=True)
    assert mean > 100  # 22 at random, 9 of a constant action


def test_logs_what_sac_logs():
    model = DiscreteSAC("MlpPolicy", "CartPole-v1", **SMALL)
    model.set_logger(Records())
    model.learn(64)
    names = {"actor_loss", "critic_loss", "ent_coef", "ent_coef_loss", "n_updates", "learning_rate"}
    assert {f"train/{name}" for name in names} <= set(model.logger.kept)


@pytest.mark.parametrize("ent_coef", ["auto_0.1", 0.2])
def test_saved_model_predicts_and_learns_on_alike(tmp_path, ent_coef):
    model = DiscreteSAC("MlpPolicy", "CartPole-v1", ent_coef=ent_coef, **SMALL).learn(80)
    model.save(tmp_path / "model")
    loaded = DiscreteSAC.load(tmp_path / "model", env=gym.make("CartPole-v1"), device="cpu")
    observations = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )
    with th.no_grad():
        assert th.equal(
            loaded.critic_target(th.tensor(observations))[1], model.critic_target(th.tensor(observations))[1]
        )
    if ent_coef == 0.2:
        assert loaded.ent_coef_tensor.item() == pytest.approx(0.2)
    else:
        assert loaded.log_ent_coef.item() == model.log_ent_coef.item() != pytest.approx(np.log(0.1), abs=1e-6)
    other = DiscreteSAC("MlpPolicy", "CartPole-v1", ent_coef=ent_coef, **{**SMALL, "seed": 9})
    other.set_parameters(model.get_parameters())
    np.testing.assert_array_equal(
        other.predict(observations, deterministic=True)[0], model.predict(observations, deterministic=True)[0]
    )
    loaded.learn(80, reset_num_timesteps=False)
    assert loaded.num_timesteps == 160


def test_targets_wait_for_their_interval_across_updates_of_one_gradient_step():
    model = DiscreteSAC("MlpPolicy", "CartPole-v1", target_update_interval=8, tau=1.0, **SMALL)
    model.learn(SMALL["learning_starts"] + 1)  # the first gradient step also updates the targets
    moved = []
    for _ in range(17):
        before = [parameter.clone() for parameter in model.critic_target.parameters()]
        model.train(1, 16)
        after = model.critic_target.parameters()
        moved.append(not all(th.equal(one, other) for one, other in zip(before, after, strict=True)))
    assert [step for step, has_moved in enumerate(moved, 1) if has_moved] == [8, 16]


def test_same_seed_trains_the_same():
    first, second = (DiscreteSAC("MlpPolicy", "CartPole-v1", **SMALL).learn(100).get_parameters() for _ in range(2))
    assert all(th.equal(first["policy"][key], second["policy"][key]) for key in first["policy"])


def test_images_and_dictionaries_have_policies():
    class Images(Bandit):
        observation_space = spaces.Dict(
            {"image": spaces.Box(0, 255, (3, 36, 36), np.uint8), "vector": spaces.Box(0, 1, (2,), np.float32)}
        )

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.observation_space.sample(), {}

        def step(self, action):
            return self.observation_space.sample(), *super().step(action)[1:]

    settings = {**SMALL, "buffer_size": 100, "policy_kwargs": {"share_features_extractor": True}}
    model = DiscreteSAC("MultiInputPolicy", Images(), **settings).learn(40)
    optimized = {id(p) for group in model.critic.optimizer.param_groups for p in group["params"]}
    assert not optimized & {id(p) for p in model.critic.features_extractor.parameters()}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ent_coef": "automatic"}, "ent_coef='automatic' is not accepted; it is a number"),
        ({"ent_coef": "auto_"}, "ent_coef='auto_' is not accepted"),
        ({"n_steps": 0}, "n_steps=0 is not accepted; it is at least 1"),
        ({"ent_coef": "auto_-1"}, "ent_coef='auto_-1' is not accepted"),
        ({"ent_coef": -1.0}, "ent_coef=-1.0 is not accepted; it is at least 0"),
        ({"target_entropy": 0.7}, "target_entropy=0.7 is not accepted; it is at least 0 and at most 0.693147"),
        ({"target_entropy": "auto_1.5"}, "target_entropy=1.03"),
        ({"tau": 1.5}, "tau=1.5 is not accepted; it is at least 0 and at most 1"),
        ({"gamma": float("nan")}, "gamma=nan is not accepted"),
        ({"batch_size": 0}, "batch_size=0 is not accepted; it is at least 1"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        DiscreteSAC("MlpPolicy", "CartPole-v1", **arguments)


def test_continuous_actions_are_refused():
    with pytest.raises(ValueError, match="DiscreteSAC takes Discrete actions; the environment has Box"):
        DiscreteSAC("MlpPolicy", "Pendulum-v1")


def test_training_stops_at_a_reward_that_is_not_finite():
    model = DiscreteSAC("MlpPolicy", make_vec_env(lambda: Bandit(reward=np.nan), 2, seed=0), **SMALL)
    with pytest.raises(FloatingPointError, match=r"reward of environment \d is not finite"):
        model.learn(50)


def test_loss_that_is_not_finite_does_not_reach_the_parameters():
    model = DiscreteSAC("MlpPolicy", make_vec_env(lambda: Bandit(reward=1e25), 2, seed=0), **SMALL)
    with pytest.raises(FloatingPointError, match="the loss is not finite"):
        model.learn(50)  # the square of the reward is too large for a float
    assert all(bool(th.isfinite(parameter).all()) for parameter in model.policy.parameters())


def test_no_action_follows_from_an_observation_that_is_not_finite():
    model = DiscreteSAC("MlpPolicy", "CartPole-v1", **SMALL)
    with pytest.raises(FloatingPointError, match="probabilities of actions are not finite"):
        model.predict(np.array([np.nan, 0, 0, 0], dtype=np.float32), deterministic=True)
