"""What is kept in a run folder, whatever ends the training: resume, signals, kills, dead workers, a full disk."""

import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

from sb3_progpolicy import load_pretrained
from sb3_progpolicy.cli import run
from sb3_progpolicy.experiment import run as runs
from sb3_progpolicy.experiment.folder import locked, timesteps_of
from sb3_progpolicy.experiment.sources import find_source
from sb3_progpolicy.programs import load_program
from sb3_progpolicy.vec_env import WorkerDiedError

SMALL = ["--hyperparams", "n_envs:4", "n_steps:16", "batch_size:16", "n_epochs:1", "inner_updates:2", "--verbose", "0"]
CALL = [sys.executable, "-c", "from sb3_progpolicy.cli import main; main()"]


def start(folder, *options):
    return subprocess.Popen(
        [*CALL, "train", "-f", str(folder), "--seed", "5", *options, *SMALL], stderr=subprocess.PIPE, text=True
    )


def train(folder, *options):
    assert run(["train", "-f", str(folder), "--seed", "5", *options, *SMALL]) == 0
    return folder / "reptile_ppo" / "Hanoi-v0_1"


def wait_for(process, file):
    while not file.exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


def steps(folder):
    saved = timesteps_of(folder / "model.zip")
    assert load_program(folder / "program.json").metadata["timesteps"] == saved
    return saved


@pytest.fixture
def options_of_training(monkeypatch):
    """Trains nothing and returns the options that it was to be done with."""
    given = []
    monkeypatch.setattr(runs, "train", lambda *arguments: given.append((arguments[1].n_timesteps, arguments[-1])))
    return given


def test_resume_that_is_refused_leaves_the_run_as_it_was(tmp_path, capsys):
    folder = train(tmp_path, "-n", "512")
    before = (folder / "config.yml").read_bytes()
    assert run(["train", "--resume", str(folder), "-n", "256"]) == 2
    assert "trained already: 512 of 256 steps" in capsys.readouterr().err
    assert (folder / "config.yml").read_bytes() == before


def test_training_starts_from_a_program(tmp_path, capsys):
    program = dataclasses.replace(load_pretrained("Hanoi-v0"), metadata={"learned_by": "imitation"})
    program.save(tmp_path / "start.json")
    options = ("-n", "512", "--init-program", str(tmp_path / "start.json"), "--hyperparams", "symmetric:False")
    folder = train(tmp_path, *options)
    learned = load_program(folder / "program.json")
    assert learned.learned_by == "imitation+reinforcement"
    assert len(learned.conditions) == len(program.conditions)
    np.testing.assert_allclose(learned.controllers[0].weights, program.controllers[0].weights, atol=0.4)
    again = train(tmp_path / "again", "-n", "64", "-i", str(folder), *options[4:])
    assert load_program(again / "program.json").learned_by == "imitation+reinforcement", "-i takes it over"
    assert run(["train", "-f", str(tmp_path), "--init-program", "Hanoi-v9"]) == 2
    assert "Hanoi-v0" in capsys.readouterr().err
    assert run(["train", "--resume", str(folder), *options[2:4]]) == 2
    assert "--init-program is not accepted with --resume" in capsys.readouterr().err


def test_resume_keeps_what_it_was_given_for_the_next(tmp_path, options_of_training):
    folder = train(tmp_path, "-n", "512", "--save-freq", "100", "--eval-freq", "200", "--eval-episodes", "2")
    resume = ["train", "--resume", str(folder), "--verbose", "0"]
    for more in ([], ["-n", "1024", "--save-freq", "77"], [], ["--eval-freq", "-1"], []):
        assert run([*resume, *more]) == 0
    kept = [(n, options.save_freq, options.eval_freq, options.eval_episodes) for n, options in options_of_training]
    assert kept == [
        (512, 100, 200, 2),
        (512, 100, 200, 2),
        (1024, 77, 200, 2),
        (1024, 77, 200, 2),
        (1024, 77, -1, 2),
        (1024, 77, -1, 2),
    ]
    assert yaml.safe_load((folder / "config.yml").read_text())["hyperparams"]["n_timesteps"] == 1024


@pytest.mark.parametrize("damage", ["- 1", "save_freq: x", "log_interval: 0", "trained_agent: [1]", "a: ["])
def test_damaged_options_are_refused(damage, tmp_path, options_of_training, capsys):
    folder = train(tmp_path, "-n", "512")
    (folder / "args.yml").write_text(damage)
    assert run(["train", "--resume", str(folder)]) == 2
    assert "args.yml" in capsys.readouterr().err


def test_run_without_a_checkpoint_is_resumed_from_step_0(tmp_path):
    first = train(tmp_path / "first", "-n", "256")
    whole = train(tmp_path / "whole", "-n", "512", "-i", str(first))
    killed = train(tmp_path / "killed", "-n", "512", "-i", str(first))
    for file in ("model.zip", "program.json"):
        (killed / file).unlink()
    assert run(["train", "--resume", str(killed), "--verbose", "0"]) == 0
    assert (killed / "program.json").read_bytes() == (whole / "program.json").read_bytes()


def test_second_process_in_a_run_folder_refuses_and_the_lock_dies_with_its_process(tmp_path, capsys):
    process = start(tmp_path, "-n", "1000000", "--save-freq", "0")
    folder = tmp_path / "reptile_ppo" / "Hanoi-v0_1"
    wait_for(process, folder / "program.json")
    assert run(["train", "--resume", str(folder), "-n", "2000000"]) == 2
    assert "another process trains in it" in capsys.readouterr().err
    process.kill()
    process.communicate()
    with locked(folder):
        pass


def test_model_and_program_of_a_killed_run_are_of_the_same_step(tmp_path):
    folder = train(tmp_path, "-n", "512")
    assert steps(folder) == 512
    process = subprocess.Popen([*CALL, "train", "--resume", str(folder), "-n", "1000000", "--save-freq", "0"])
    while load_program(folder / "program.json").metadata["timesteps"] < 2000:
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert find_source(str(folder)).program.metadata["timesteps"] == timesteps_of(folder / "model.zip") >= 2000


def test_program_of_another_step_than_its_model_is_not_read(tmp_path, capsys):
    old, new = train(tmp_path / "old", "-n", "256"), train(tmp_path / "new", "-n", "512")
    (old / "model.zip").write_bytes((new / "model.zip").read_bytes())  # as if killed between the two
    printed = []
    for folder in (old, new):
        capsys.readouterr()
        assert run(["evaluate", str(folder), "--set", "n_discs=1,2", "--json"]) == 0
        printed.append(json.loads(capsys.readouterr().out))
    assert printed[0] == printed[1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_save_and_say_how_to_go_on(number, tmp_path):
    process = start(tmp_path, "-n", "1000000", "--save-freq", "0")
    folder = tmp_path / "reptile_ppo" / "Hanoi-v0_1"
    wait_for(process, folder / "program.json")
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert f"saved at step {steps(folder)} in" in said
    assert "Traceback" not in said


@pytest.mark.parametrize("moment", ["build_model", "save"])
def test_a_request_to_terminate_ends_training_at_any_moment(moment, tmp_path, monkeypatch, capsys):
    saved = []

    def terminated(*_, **__):
        if not saved:
            saved.append(True)
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.1)

    if moment == "build_model":
        monkeypatch.setattr(runs, "build_model", terminated)
    else:
        monkeypatch.setattr(runs.Program, "save", lambda self, path: (path.write_text("whole"), terminated()))
    before = signal.getsignal(signal.SIGTERM)
    assert run(["train", "-f", str(tmp_path), "-n", "2000", "--save-freq", "0", *SMALL]) == 130
    assert signal.getsignal(signal.SIGTERM) is before
    assert "interrupted" in capsys.readouterr().err.lower()


def test_dead_worker_is_one_line_that_says_what_is_saved_and_how_to_go_on(tmp_path, monkeypatch, capsys):
    def dies(self, *_):
        if self.num_timesteps >= 300:
            raise WorkerDiedError("worker 0, which ran environments 2 to 3, has died with exit code -9; all are closed")
        return True

    monkeypatch.setattr(runs._RunCheckpoint, "_on_step", dies)
    assert run(["train", "-f", str(tmp_path), "-n", "2000", *SMALL]) == 1
    folder = tmp_path / "reptile_ppo" / "Hanoi-v0_1"
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"saved at step {steps(folder)} in {folder}. To go on: progpolicy train --resume {folder}" in said


@pytest.mark.parametrize("algo", ["reptile_ppo", "sac"])
def test_training_that_diverges_keeps_what_was_finite(algo, tmp_path, monkeypatch, capsys):
    def diverges(what, values, timesteps):
        if timesteps >= 300:
            raise FloatingPointError(f"the reward is not finite (NaN or infinite) at step {timesteps}")

    place = "reptile_ppo.sequence_ppo" if algo == "reptile_ppo" else "baselines.discrete_sac.algorithm"
    monkeypatch.setattr(f"sb3_progpolicy.{place}.check_step", diverges)
    small = SMALL if algo == "reptile_ppo" else ["--algo", "sac", "--env", "Hanoi-v0", "--seed", "1"]
    assert run(["train", "-f", str(tmp_path), "-n", "2000", *small]) == 2
    folder = tmp_path / algo / "Hanoi-v0_1"
    said = capsys.readouterr().err.splitlines()[-1]
    assert "the reward is not finite" in said
    saved = timesteps_of(folder / "model.zip")
    assert f"saved at step {saved} in {folder}. To train from there with other hyperparameters: progpolicy" in said
    assert f"-i {folder}" in said
    assert saved > 0


def test_parameters_that_are_not_finite_are_not_saved(tmp_path, monkeypatch, capsys):
    def diverges(self, total_timesteps, **_):
        next(iter(self.policy.parameters())).data.fill_(float("nan"))
        raise FloatingPointError("parameter w is not finite")

    monkeypatch.setattr("sb3_progpolicy.baselines.discrete_sac.DiscreteSAC.learn", diverges)
    assert run(["train", "-f", str(tmp_path), "--algo", "sac", "--env", "Hanoi-v0", "-n", "10"]) == 2
    assert "the parameters are not saved" in capsys.readouterr().err
    assert not (tmp_path / "sac" / "Hanoi-v0_1" / "model.zip").exists()


def test_full_disk_is_one_line_that_names_the_file(tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert run(["show", "Hanoi-v0", "-o", str(tmp_path / "a.txt")]) == 2
    said = capsys.readouterr().err
    assert str(tmp_path / "a.txt") in said
    assert "No space left" in said
    assert not list(tmp_path.iterdir())


OWN = """
import gymnasium as gym
from progpolicy_envs.hanoi import HanoiEnv

class Own(HanoiEnv):
    def __init__(self, n_discs=2, render_mode=None):
        super().__init__(n_discs=n_discs, render_mode=render_mode)

gym.register("Own-v0", entry_point=Own, max_episode_steps=50)
"""


def test_own_environment_of_a_module_in_the_working_directory(tmp_path, monkeypatch, capsys):
    (tmp_path / "own_envs.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    arguments = ["train", "--env", "own_envs:Own-v0", "-f", "runs", "-n", "128", *SMALL]
    assert run([*arguments, "--env-kwargs", "n_disc:3"]) == 2
    assert "nearest: n_discs" in capsys.readouterr().err
    assert run([*arguments, "--env-kwargs", "n_discs:3"]) == 0
    folder = "runs/reptile_ppo/Own-v0_1"
    assert run(["evaluate", folder, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["env"] == "own_envs:Own-v0"
    assert run(["evaluate", "Hanoi-v0", "--env", "own_envs:Own-v0"]) == 0
    assert run(["train", "--resume", folder, "-n", "256", "--verbose", "0"]) == 0
    assert run(["train", "--env", "own_env:Own-v0"]) == 2
    assert "module 'own_env' cannot be imported" in capsys.readouterr().err


def test_id_with_a_module_prefix_is_the_same_environment(tmp_path):
    plain = train(tmp_path / "a", "-n", "128")
    train(tmp_path / "c", "-n", "128", "--env", "progpolicy_envs:Hanoi-v0")
    programs = [load_program(folder / "program.json") for folder in (plain, tmp_path / "c/reptile_ppo/Hanoi-v0_1")]
    assert programs[0].controllers == programs[1].controllers
