"""ReptilePPO: seeds, saving, statistics, logs, and SB3's manners."""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_progpolicy import ReptilePPO, VecInteractionHistory
from sb3_progpolicy.normalization import RewardScaler
from sb3_progpolicy.programs import ProgramRunner
from tests.reptile_ppo.models import POLICIES, Each, make, weights


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy", "MlpLstmPolicy"])
def test_equal_seeds_give_equal_runs(policy):
    runs = [weights(make(policy, seed=seed).learn(192)) for seed in (3, 3, 4)]
    assert th.equal(runs[0], runs[1])
    assert not th.equal(runs[0], runs[2])


@pytest.mark.parametrize("policy", POLICIES)
def test_saved_and_loaded_model_is_the_same_and_trains_on(policy, tmp_path):
    options = {"normalize_observations": True, "scale_rewards": True, "meta_optimizer": "adam"}
    model = make(policy, **options, meta_learning_rate=0.01).learn(192)
    model.save(tmp_path / "folder" / "model")
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["model.zip"]
    loaded = ReptilePPO.load(tmp_path / "folder" / "model", "Hanoi-v0", device="cpu")
    assert th.equal(weights(loaded), weights(model))
    assert loaded.reward_scaler.statistics.var == model.reward_scaler.statistics.var
    assert loaded.meta_iteration == model.meta_iteration > 0
    assert loaded.n_envs == model.n_envs
    observation = np.ones((4, 17), np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )
    other = make(policy, **options, seed=9)
    other.set_parameters(model.get_parameters())
    assert th.equal(weights(other), weights(model))
    if policy in ("ProgPolicy", "PRLPolicy"):
        assert loaded.program().body == model.program().body
    # Both go on alike, the meta-optimizer included.
    for going_on in (model, loaded):
        going_on.learn(128, reset_num_timesteps=False)
    assert th.equal(weights(loaded), weights(model))


def test_model_without_an_environment_predicts(tmp_path):
    make().learn(64).save(tmp_path / "model")
    model = ReptilePPO.load(tmp_path / "model")
    assert model.get_env() is None
    states, observation = None, np.ones(17, np.float32)
    for start in (True, False, True):
        action, states = model.predict(observation, states, np.array([start]), deterministic=True)
        assert action in range(6)
    fresh = model.predict(observation, None)[1]
    assert (states[0] != fresh[0]).any(), "the state survives the start of an episode"


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy"])
def test_normaliser_folds_into_the_program_that_is_extracted(policy):
    model = make(policy, "Pendulum-v1", normalize_observations=True, search_fraction=0.0).learn(192)
    assert float((model.policy.features_extractor.mean).abs().max()) > 0.01
    env = model.get_env()
    observation, states = env.reset(), None
    runner = ProgramRunner(model.program(), env.num_envs, "soft")
    for _ in range(20):
        actions, states = model.predict(observation, states, deterministic=True)
        np.testing.assert_allclose(runner.act(observation), actions, atol=1e-5)
        observation, *_ = env.step(actions)


def test_scaled_rewards_are_trained_on_and_true_ones_are_seen():
    raw = []
    model = make(env="Pendulum-v1", scale_rewards=True, n_epochs=1)
    model.learn(64, callback=Each(lambda _, local: raw.append(local["rewards"].copy())))
    scaled, raw = model.rollout_buffer.rewards.reshape(16, 4), np.array(raw)
    assert (np.abs(scaled) < np.abs(raw)).all()
    x = model.rollout_buffer.observations.reshape(16, 4, -1)
    np.testing.assert_allclose(x[1:, :, -2], raw[:-1], rtol=1e-5)


def test_returns_by_which_rewards_are_scaled_start_anew_with_a_task():
    model, expected = make(env="Pendulum-v1", scale_rewards=True, inner_updates=1), RewardScaler(0.99)

    def take_in(_, local):
        last = (model.num_timesteps // 4) % model.n_steps == 0
        expected(local["rewards"].copy(), np.full(4, last))

    model.learn(64 * 3, callback=Each(take_in))
    assert model.reward_scaler.statistics.mean == pytest.approx(expected.statistics.mean)
    assert model.reward_scaler.statistics.var == pytest.approx(expected.statistics.var)


def test_program_has_the_names_of_the_environment():
    program = make().program(note="hi")
    assert program.input_names[:3] == ("rank[0]", "colour[0]", "empty[0]")
    assert program.output_names[0] == "move 0->1"
    assert program.interaction
    assert program.n_observations == 9
    assert program.metadata["env"] == "Hanoi-v0"
    assert program.metadata["note"] == "hi"


def test_everything_that_is_promised_is_logged(tmp_path):
    model = make(tasks=[{"n_discs": 1}], n_steps=128, tensorboard_log=str(tmp_path), inner_updates=1)
    model.set_logger(configure(str(tmp_path / "csv"), ["csv"]))
    model.learn(1024)
    keys = set((tmp_path / "csv" / "progress.csv").read_text().splitlines()[0].split(","))
    label = model.tasks.label(0)
    promised = {f"success/{label}", f"steps/{label}", "reptile/meta_step_norm", "program/search_entropy"}
    promised |= {f"program/prob_{n}_conditions" for n in range(3)}
    promised |= {f"program/branch_{name}" for name in ("then_1", "then_2", "last_1", "last_2", "last_3")}
    promised |= {"train/approx_kl", "train/value_loss", "rollout/ep_len_mean", "time/total_timesteps"}
    assert promised <= keys


def test_tensorboard_progress_bar_and_callbacks_work_as_in_sb3(tmp_path):
    pytest.importorskip("tensorboard")
    initialised = []

    class Count(BaseCallback):
        def _init_callback(self):
            initialised.append(self)

        def _on_step(self):
            return True

    model = make(tensorboard_log=str(tmp_path / "logs"))
    model.learn(128, callback=[Count(), CheckpointCallback(16, str(tmp_path / "saved"))], progress_bar=True)
    assert list((tmp_path / "logs").glob("ReptilePPO_1/events*"))
    assert list((tmp_path / "saved").glob("*.zip"))
    assert len(initialised) == 1
    model.learn(128, callback=lambda local, _: False)
    assert model.num_timesteps == 4, "a callback ends the training"


def test_set_env_appends_the_history():
    model = make()
    model.set_env(make_vec_env("Hanoi-v0", 4))
    assert isinstance(model.get_env(), VecInteractionHistory)
    model.learn(64)
