"""``InteractionEvalCallback``: what a model reads in training it reads when it is evaluated, on a plain environment."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_progpolicy import InteractionEvalCallback, InteractionHistory, ReptilePPO, VecInteractionHistory
from sb3_progpolicy.interaction import appends_history


def cartpole():
    return Monitor(gym.make("CartPole-v1"))


def hanoi():
    return Monitor(gym.make("Hanoi-v0", n_discs=1, max_episode_steps=20))


def make(env="Hanoi-v0", policy="ProgPolicy", **kwargs):
    if isinstance(env, str):
        kwargs.setdefault("n_envs", 2)
    return ReptilePPO(policy, env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu", **kwargs)


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy", "MlpPolicy", "MlpLstmPolicy"])
def test_a_plain_environment_is_evaluated_as_one_with_the_history(tmp_path, policy):
    model = make(policy=policy, learning_rate=0.0, normalize_observations=False)
    callback = InteractionEvalCallback(
        hanoi(), n_eval_episodes=3, eval_freq=16, log_path=tmp_path, best_model_save_path=tmp_path, verbose=0
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(64, callback=callback)
    expected = evaluate_policy(
        model, VecInteractionHistory(DummyVecEnv([hanoi])), 3, return_episode_rewards=True
    )  # fmt: skip
    with np.load(tmp_path / "evaluations.npz") as saved:
        assert saved["timesteps"].tolist() == [32, 64]
        np.testing.assert_allclose(saved["results"], [expected[0]] * 2)
        assert saved["ep_lengths"].tolist() == [expected[1]] * 2
        assert saved["successes"].shape == (2, 3)
    assert ReptilePPO.load(tmp_path / "best_model").interaction_history


def test_sb3s_own_callback_says_what_a_plain_environment_lacks():
    with pytest.warns(UserWarning, match="not of the same type"), pytest.raises(ValueError, match="InteractionHistory"):
        make().learn(64, callback=EvalCallback(hanoi(), eval_freq=16, verbose=0))


def test_history_and_states_start_at_zero_and_survive_the_end_of_an_episode(monkeypatch):
    model = make()
    seen = []
    predict = model.predict
    monkeypatch.setattr(
        model, "predict", lambda obs, state=None, **kw: seen.append((obs.copy(), state)) or predict(obs, state, **kw)
    )
    model.learn(64, callback=InteractionEvalCallback(hanoi(), n_eval_episodes=3, eval_freq=16, verbose=0))
    starts = [index for index, (_, state) in enumerate(seen) if state is None]
    assert len(starts) == 2
    history = np.stack([obs[0, 9:] for obs, _ in seen])
    assert not history[starts].any()
    ends = [history[start:end, -1].sum() for start, end in zip(starts, [starts[1], len(seen)], strict=True)]
    assert ends == [2, 2], "the first observations of the second and third episode show the end of the one before"


@pytest.mark.parametrize(("learner", "policy"), [(PPO, "MlpPolicy"), (RecurrentPPO, "MlpLstmPolicy")])
@pytest.mark.parametrize("history", [False, True])
def test_stock_algorithms_get_what_they_were_trained_with(learner, policy, history):
    env = DummyVecEnv([cartpole])
    model = learner(policy, VecInteractionHistory(env) if history else env, n_steps=16, batch_size=16, n_epochs=1)
    callback = InteractionEvalCallback(cartpole(), n_eval_episodes=1, eval_freq=8, verbose=0)
    model.learn(16, callback=callback)
    assert appends_history(callback.eval_env) == history
    assert callback.last_mean_reward > 0


def test_one_callback_serves_models_with_and_without_the_history():
    callback = InteractionEvalCallback(hanoi(), n_eval_episodes=1, eval_freq=16, verbose=0)
    for history in (True, False, True):
        make(interaction_history=history).learn(32, callback=callback)
        assert appends_history(callback.eval_env) == history


@pytest.mark.parametrize(
    "given", [lambda: VecInteractionHistory(DummyVecEnv([hanoi])), lambda: InteractionHistory(hanoi())]
)
def test_a_history_that_is_there_is_not_appended_again(given):
    callback = InteractionEvalCallback(given(), n_eval_episodes=1, eval_freq=16, verbose=0)
    model = make()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Training and eval env are not of the same type")
        model.learn(32, callback=callback)
    assert callback.eval_env.observation_space == model.observation_space


def test_statistics_of_vec_normalize_are_taken_over():
    training, evaluation = (VecNormalize(DummyVecEnv([cartpole]), training=t) for t in (True, False))
    model = make(training, "MlpPolicy")
    model.learn(32, callback=InteractionEvalCallback(evaluation, n_eval_episodes=1, eval_freq=32, verbose=0))
    np.testing.assert_array_equal(evaluation.obs_rms.mean, training.obs_rms.mean)
    assert evaluation.obs_rms.mean.any()


def test_what_is_evaluated_and_saved_is_the_policy_between_two_tasks(tmp_path):
    model = make(inner_updates=3, meta_learning_rate=0.1)
    callback = InteractionEvalCallback(
        hanoi(), n_eval_episodes=1, eval_freq=40, log_path=tmp_path, best_model_save_path=tmp_path, verbose=0
    )
    model.learn(96 * 2, callback=callback)  # two tasks of three rollouts of 32 steps; due after 80 and 160 steps
    with np.load(tmp_path / "evaluations.npz") as saved:
        assert saved["timesteps"].tolist() == [98, 192], "the first step of the second task, and the end"
    callback = InteractionEvalCallback(
        hanoi(), n_eval_episodes=1, eval_freq=40, best_model_save_path=tmp_path, verbose=0
    )
    model.learn(96, callback=callback)
    best = ReptilePPO.load(tmp_path / "best_model").policy.state_dict()
    for name, value in model.policy.state_dict().items():
        np.testing.assert_array_equal(best[name], value, err_msg=name)


def test_without_a_step_between_tasks_nothing_waits(tmp_path):
    model = make(inner_updates=3, meta_update=False)
    model.learn(
        96, callback=InteractionEvalCallback(hanoi(), n_eval_episodes=1, eval_freq=20, log_path=tmp_path, verbose=0)
    )
    with np.load(tmp_path / "evaluations.npz") as saved:
        assert saved["timesteps"].tolist() == [40, 80]


def test_a_callback_after_an_evaluation_that_waited_ends_the_training():
    model = make(inner_updates=3)
    stop = StopTrainingOnRewardThreshold(-1e9, verbose=0)
    model.learn(10_000, InteractionEvalCallback(hanoi(), stop, n_eval_episodes=1, eval_freq=20, verbose=0))
    assert model.num_timesteps == 98
