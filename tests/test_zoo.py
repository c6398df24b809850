"""rl-baselines3-zoo as a client: training with evaluation, then playing what was saved."""

import argparse
import subprocess
import sys

import pytest
import yaml

from sb3_progpolicy.experiment.methods import METHODS
from sb3_progpolicy.hyperparams import load_entries
from sb3_progpolicy.zoo import main, zoo_hyperparams

OURS = [name for name, method in METHODS.items() if method.has_reptile]


def zoo(*arguments):
    command = [sys.executable, "-W", "ignore", "-m", "sb3_progpolicy.zoo", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_train_with_evaluation_and_enjoy(tmp_path):
    pytest.importorskip("rl_zoo3")
    run = ["--algo", "reptile_ppo", "--env", "Hanoi-v0", "-f", str(tmp_path)]
    small = ["n_envs:4", "n_steps:16", "batch_size:16", "n_epochs:1", "temperature:'lin_1_0.5'"]
    zoo("train", *run, "-n", "256", "--eval-freq", "128", "--eval-episodes", "1", "--seed", "1", "-params", *small)
    folder = tmp_path / "reptile_ppo" / "Hanoi-v0_1"
    assert {path.name for path in folder.glob("*.zip")} == {"best_model.zip", "Hanoi-v0.zip"}
    assert "Mean reward" in zoo("enjoy", *run, "-n", "600", "--no-render")


@pytest.mark.parametrize("algo", OURS)
def test_hyperparameters_are_ours_in_values_that_the_zoo_accepts(algo):
    ours, translated = load_entries(algo), zoo_hyperparams(algo)
    assert set(translated) == set(ours)
    for env_id, entry in translated.items():
        assert entry["interaction_history"] is False
        assert set(entry) - set(ours[env_id]) <= {"env_wrapper", "interaction_history"}
        own = {name: value for name, value in ours[env_id].items() if name != "interaction_history"}
        limit = own.pop("max_episode_steps", None)  # the zoo makes the environments
        own |= {"env_kwargs": {**own["env_kwargs"], "max_episode_steps": limit}} if limit else {}
        assert own.items() <= entry.items()
    assert yaml.safe_load(yaml.safe_dump(translated)) == translated


def test_schedule_that_the_zoo_has_no_form_for_is_refused(monkeypatch):
    entry = {"policy": "ProgPolicy", "n_timesteps": 1, "learning_rate": "lin_0.5_0.1"}
    monkeypatch.setattr("sb3_progpolicy.zoo.load_entries", lambda _: {"default": entry})
    with pytest.raises(ValueError, match=r"default: learning_rate='lin_0.5_0.1' has no form in the zoo"):
        zoo_hyperparams("reptile_ppo")


@pytest.mark.parametrize("option", [["--conf-file=mine.yml"], ["--conf", "mine.yml"], ["-conf", "mine.yml"]])
@pytest.mark.parametrize("algo", [["--algo", "reptile_ppo"], ["--algo=reptile_ppo"], ["--alg", "reptile_ppo"]])
def test_the_users_own_file_is_read_in_place_of_ours(algo, option, monkeypatch):
    seen = []

    class Command:
        @staticmethod
        def train():
            parser = argparse.ArgumentParser()
            parser.add_argument("--algo")
            parser.add_argument("-conf", "--conf-file")
            seen.append(parser.parse_args())

    monkeypatch.setattr("sb3_progpolicy.zoo.register", lambda: None)
    monkeypatch.setattr("sb3_progpolicy.zoo.import_module", lambda _: Command)
    monkeypatch.setattr(sys, "argv", [])
    main(["train", *algo, *option])
    main(["train", *algo])
    assert seen[0].conf_file == "mine.yml"
    assert seen[1].conf_file.endswith("reptile_ppo.yml")


# In a process of its own: importing the zoo changes Gymnasium's TimeLimit.
SCHEDULE = """
import sys
from rl_zoo3 import ALGOS
from rl_zoo3.utils import SimpleLinearSchedule
from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.zoo import register

register()
rate = SimpleLinearSchedule(0.5)
model = ALGOS["reptile_ppo"]("ProgPolicy", "Hanoi-v0", n_envs=2, n_steps=8, learning_rate=rate, seed=0)
model.learn(16).save(sys.argv[1])
print([ReptilePPO.load(sys.argv[1]).lr_schedule(left) for left in (1.0, 0.5, 0.0)])
"""


def test_model_with_a_schedule_of_the_zoos_own_kind_is_saved_and_loaded(tmp_path):
    command = [sys.executable, "-W", "ignore", "-c", SCHEDULE, str(tmp_path / "model")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.stdout.splitlines()[-1:] == ["[0.5, 0.25, 0.0]"], done.stderr


def test_algorithms_of_others_and_other_commands_are_refused():
    with pytest.raises(ValueError, match="unknown algorithm 'ppo'"):
        zoo_hyperparams("ppo")
    with pytest.raises(SystemExit, match=r"train\|enjoy"):
        main(["plot"])
