"""Models that Stable-Baselines3 and sb3-contrib have saved, outside of a run folder."""

import json
import zipfile

import pytest
import sb3_contrib
import stable_baselines3

from sb3_progpolicy.cli import run
from sb3_progpolicy.experiment.folder import load_model
from sb3_progpolicy.policies import RecurrentProgrammaticPolicy

DISCRETE = {
    stable_baselines3.PPO: {"n_steps": 8, "batch_size": 8},
    stable_baselines3.A2C: {},
    stable_baselines3.DQN: {"buffer_size": 10},
    sb3_contrib.QRDQN: {"buffer_size": 10},
    sb3_contrib.TRPO: {"n_steps": 8, "batch_size": 8},
    sb3_contrib.ARS: {},
}
BOX = (stable_baselines3.SAC, stable_baselines3.TD3, stable_baselines3.DDPG, sb3_contrib.TQC, sb3_contrib.CrossQ)


@pytest.mark.parametrize(
    ("algorithm", "policy", "env_id", "arguments"),
    [
        *((algorithm, "MlpPolicy", "CartPole-v1", arguments) for algorithm, arguments in DISCRETE.items()),
        *((algorithm, "MlpPolicy", "Pendulum-v1", {"buffer_size": 10}) for algorithm in BOX),
        (sb3_contrib.RecurrentPPO, "MlpLstmPolicy", "CartPole-v1", {}),
        (sb3_contrib.RecurrentPPO, RecurrentProgrammaticPolicy, "CartPole-v1", {}),
    ],
)
def test_file_is_loaded_by_the_algorithm_that_saved_it(tmp_path, algorithm, policy, env_id, arguments):
    path = tmp_path / "model.zip"
    model = algorithm(policy, env_id, device="cpu", seed=0, **arguments)
    model.save(path)
    with pytest.raises(ValueError, match="is saved with pickle: loading it runs the code"):
        load_model(path)
    loaded = load_model(path, allow_pickle=True, device="cpu")
    assert isinstance(model, type(loaded))  # DDPG is a TD3
    observation = model.observation_space.sample()
    expected = model.predict(observation, deterministic=True)[0]
    assert (loaded.predict(observation, deterministic=True)[0] == expected).all()


def test_file_of_an_unknown_algorithm_is_named(tmp_path):
    path = tmp_path / "model.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps({"policy_class": {"__module__": "mine.policies"}}))
        archive.writestr("policy.pth", b"")
    with pytest.raises(ValueError, match=r"an algorithm that is not known, with a policy of mine\.policies"):
        load_model(path, allow_pickle=True)


def test_command_line_evaluates_a_saved_model(tmp_path, capsys):
    path = tmp_path / "a2c.zip"
    stable_baselines3.A2C("MlpPolicy", "CartPole-v1", device="cpu", seed=0).save(path)
    arguments = ["evaluate", str(path), "--env", "CartPole-v1", "--episodes", "2"]
    assert run(arguments) == 2
    assert "--allow-pickle" in capsys.readouterr().err
    assert run([*arguments, "--allow-pickle"]) == 0
    assert "return" in capsys.readouterr().out
