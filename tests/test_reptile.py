"""Reptile with stock algorithms: the update, its schedule, and what a task switch does."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_progpolicy import RecurrentProgrammaticPolicy, ReptilePPO, ReptileWrapper, TaskDistribution

LENGTHS = (0.25, 0.75)
TASKS = {"length": list(LENGTHS)}


class Descent(PPO):
    """Inner updates are steps of gradient descent on half the squared distance to the task's pole length."""

    step_size = 0.5

    def train(self):
        optimum = float(np.mean([env.unwrapped.length for env in self.env.envs]))
        self.optima = [*getattr(self, "optima", []), optimum]
        with th.no_grad():
            for parameter in self.policy.parameters():
                parameter.add_(self.step_size * (optimum - parameter))


def make(algorithm=PPO, policy="MlpPolicy", n_envs=2, **kwargs):
    env = make_vec_env("CartPole-v1", n_envs)
    return algorithm(
        policy, env, **{"n_steps": 8, "batch_size": 8, "n_epochs": 1, "seed": 0, "device": "cpu", **kwargs}
    )


def by_attribute(**kwargs):
    return TaskDistribution(TASKS, apply="attributes", **kwargs)


def flat(model):
    return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()


class Starts(BaseCallback):
    """Parameters, and what is logged, at the start of every rollout and at the end of the training."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_rollout_start(self):
        self.seen.append((flat(self.model), dict(self.logger.name_to_value)))

    _on_training_end = _on_rollout_start

    def _on_step(self):
        return True


def learn(model, n_tasks, inner_updates, reptile=None):
    """Train; return theta, theta_hat, the next theta, and the logged beta and norm of every meta-step."""
    starts, ends, train = Starts(), [], model.train

    def watched(**arguments):
        train(**arguments)
        ends.append(flat(model))

    model.train = watched
    callbacks = [starts] if reptile is None else [reptile, starts]
    model.learn(n_tasks * inner_updates * model.n_steps * model.n_envs, callbacks)
    seen, ends = starts.seen[::inner_updates], ends[inner_updates - 1 :: inner_updates]
    assert len(seen) == n_tasks + 1
    return [
        (theta, theta_hat, new, logged["reptile/meta_learning_rate"], logged["reptile/meta_step_norm"])
        for (theta, _), theta_hat, (new, logged) in zip(seen[:-1], ends, seen[1:], strict=True)
    ]


@pytest.mark.parametrize(("algorithm", "policy"), [(PPO, "MlpPolicy"), (RecurrentPPO, "MlpLstmPolicy")])
def test_meta_step_goes_from_theta_towards_theta_hat(algorithm, policy):
    options = {"inner_updates": 2, "meta_learning_rate": 0.25}
    if algorithm is ReptilePPO:
        tasks = learn(make(algorithm, policy, tasks=by_attribute(), interaction_history=False, **options), 3, 2)
    else:
        tasks = learn(make(algorithm, policy), 3, 2, ReptileWrapper(by_attribute(), **options))
    for theta, theta_hat, new, beta, norm in tasks:
        assert beta == 0.25
        assert (theta_hat - theta).norm() > 1e-4
        th.testing.assert_close(new, theta + 0.25 * (theta_hat - theta))
        assert norm == pytest.approx(float((new - theta).norm()), rel=1e-4)


def test_callback_of_one_model_trains_a_second_one_afresh():
    def trained(reptile):
        model = make()
        model.learn(64, callback=reptile)
        return flat(model)

    used = ReptileWrapper(by_attribute(), 1, meta_learning_rate=0.02, meta_optimizer="adam")
    first, second = trained(used), trained(used)
    th.testing.assert_close(second, first, rtol=0, atol=0)
    assert (first - flat(make())).norm() > 1e-3


def test_algorithm_with_reptile_built_in_is_refused():
    model = ReptilePPO("MlpPolicy", make_vec_env("CartPole-v1", 2), n_steps=8, batch_size=8)
    with pytest.raises(TypeError, match="has Reptile built in"):
        model.learn(32, callback=ReptileWrapper(by_attribute()))


def test_adam_steps_on_the_pseudo_gradient():
    reptile = ReptileWrapper(by_attribute(), inner_updates=1, meta_learning_rate=0.02, meta_optimizer="adam")
    tasks = learn(make(), 5, 1, reptile)
    parameter = th.nn.Parameter(tasks[0][0].clone())
    optimizer = th.optim.Adam([parameter], lr=0.02)
    for theta, theta_hat, new, *_ in tasks:
        th.testing.assert_close(parameter.detach(), theta)
        parameter.grad = theta - theta_hat
        optimizer.step()
        th.testing.assert_close(parameter.detach(), new)


def test_without_the_meta_update_training_goes_on_from_theta_hat():
    model, reptile = make(Descent), ReptileWrapper(by_attribute(), 2, meta_update=False)
    start = flat(model)
    model.learn(96, callback=reptile)
    for optimum in model.optima:
        start = start + 0.5 * (optimum - start)
    th.testing.assert_close(flat(model), start)
    assert reptile.meta_iteration == 3
    assert "reptile/meta_step_norm" not in model.logger.name_to_value


def test_fixed_point_of_equally_curved_losses_is_the_mean_of_their_optima():
    model, n_tasks = make(Descent), 12
    model.step_size = 1.0  # theta_hat is the optimum of its task
    # Steps of 1/t make theta the mean of the first t optima.
    reptile = ReptileWrapper(by_attribute(), 1, meta_learning_rate=lambda left: 1 / round(n_tasks * (1 - left)))
    model.learn(n_tasks * 16, callback=reptile)
    assert set(model.optima) == set(LENGTHS)
    th.testing.assert_close(flat(model), th.full_like(flat(model), float(np.mean(model.optima))))


def test_reptile_contracts_by_the_rate_of_the_formula():
    model = make(Descent)
    start = flat(model)
    tasks = TaskDistribution({"length": [0.5]}, apply="attributes")
    model.learn(5 * 3 * 16, callback=ReptileWrapper(tasks, inner_updates=3, meta_learning_rate=0.2))
    # Three inner steps leave 1/8 of the distance, and theta takes a fifth of the way: five times.
    rate = (1 - 0.2 * (1 - 0.5**3)) ** 5
    th.testing.assert_close(flat(model), 0.5 + rate * (start - 0.5))


def test_meta_learning_rate_follows_its_schedule():
    tasks = learn(make(Descent), 4, 1, ReptileWrapper(by_attribute(), 1, meta_learning_rate=lambda left: 0.8 * left))
    assert [beta for *_, beta, _ in tasks] == pytest.approx([0.6, 0.4, 0.2, 0.0])


class Watch(BaseCallback):
    """Pole lengths and LSTM states at the first and the last step of every rollout."""

    def _on_training_start(self):
        self.lengths, self.first, self.last = [], [], []

    def _on_rollout_start(self):
        self.lengths.append([env.unwrapped.length for env in self.training_env.envs])
        states = getattr(self.model, "_last_lstm_states", None)
        self.first.append(None if states is None else states.pi[0].clone())

    def _on_step(self):
        return True


def test_tasks_of_an_iteration_are_dealt_out_over_the_environments():
    tasks = TaskDistribution({"length": [0.1, 0.2, 0.3, 0.4, 0.5]}, apply="attributes")
    watch = Watch()
    make(n_envs=4).learn(128, callback=[ReptileWrapper(tasks, 2, tasks_per_iteration=2), watch])
    assert watch.lengths[0] == watch.lengths[1]
    assert watch.lengths[2] == watch.lengths[3]
    for a, b, c, d in watch.lengths:
        assert (a, b) == (c, d)
        assert a != b


@pytest.mark.parametrize("policy", ["MlpLstmPolicy", RecurrentProgrammaticPolicy])
def test_states_in_recurrent_ppo_are_zeroed_at_a_task_switch_only(policy):
    watch = Watch()
    make(RecurrentPPO, policy).learn(96, callback=[ReptileWrapper(by_attribute(), inner_updates=2), watch])
    assert [bool((state == 0).all()) for state in watch.first] == [True, False] * 3


def test_tasks_and_training_follow_from_the_seed():
    def trained(seed):
        model = make(seed=seed)
        model.learn(128, callback=ReptileWrapper(by_attribute(), 1))
        return flat(model)

    th.testing.assert_close(trained(1), trained(1), rtol=0, atol=0)
    assert (trained(1) != trained(2)).any()


def test_a_second_training_starts_at_the_beginning_of_the_curriculum():
    tasks = TaskDistribution({"length": [0.1, 0.2, 0.3, 0.4, 0.5]}, sampler="curriculum", apply="attributes")
    model, watch = make(), Watch()
    reptile = ReptileWrapper(tasks, 1)
    model.learn(160, callback=reptile)
    model.learn(160, callback=[reptile, watch])
    assert watch.lengths[0] == [0.1] * 2


def test_success_and_length_of_episodes_are_logged_per_variation():
    tasks = TaskDistribution({"n_discs": [1]})
    model = PPO("MlpPolicy", make_vec_env("Hanoi-v0", 4), n_steps=128, batch_size=128, n_epochs=1, seed=0)
    logged = {}

    class Keep(BaseCallback):
        def _on_rollout_end(self):
            logged.update(self.logger.name_to_value)

        def _on_step(self):
            return True

    model.learn(1024, callback=[ReptileWrapper(tasks, 1), Keep()])
    label = tasks.label(0)
    assert logged[f"success/{label}"] == 1.0
    assert logged[f"steps/{label}"] >= 1
    assert {"reptile/meta_iteration", "reptile/meta_step_norm", "reptile/meta_learning_rate"} <= set(logged)
    assert tasks.success_rates[0] == 1.0


@pytest.mark.slow
def test_cartpole_of_any_length_and_force_is_learned_by_stock_ppo():
    tasks = TaskDistribution({"length": [0.25, 0.5, 1.0], "force_mag": [7.0, 14.0]}, apply="attributes")
    model = make(n_envs=6, n_steps=128, batch_size=192, n_epochs=8, learning_rate=3e-3, gamma=0.98, ent_coef=0.0)
    model.learn(24_000, callback=ReptileWrapper(tasks, inner_updates=2, tasks_per_iteration=6))
    for length, force in ((0.25, 14.0), (0.75, 10.0), (1.0, 7.0)):
        env = gym.make("CartPole-v1")
        env.unwrapped.length, env.unwrapped.force_mag = length, force
        assert evaluate_policy(model, env, 2, warn=False)[0] >= 195


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"inner_updates": 0}, "inner_updates=0"),
        ({"tasks_per_iteration": 0}, "tasks_per_iteration=0"),
        ({"meta_optimizer": "rmsprop"}, "known: sgd, adam"),
    ],
)
def test_values_that_are_not_accepted_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        ReptileWrapper(by_attribute(), **arguments)


def test_off_policy_algorithms_are_refused():
    model = DQN("MlpPolicy", "CartPole-v1", buffer_size=100)
    with pytest.raises(TypeError, match="on-policy"):
        model.learn(10, callback=ReptileWrapper(by_attribute()))
