"""Training that is killed and resumed ends with the same bits as training that is not."""

import os
import signal
import subprocess
import sys

import pytest
import torch as th
from stable_baselines3.common.utils import LinearSchedule

from sb3_progpolicy import ReptileCheckpoint, ReptilePPO, TaskDistribution, load_last_good

TIMESTEPS = 8 * 32 * 2 * 8


def make(policy):
    """A search, an extraction, statistics of observations and rewards, a sampler and a meta-optimizer with memory."""
    return ReptilePPO(
        policy,
        "Hanoi-v0",
        n_envs=8,
        n_steps=32,
        batch_size=64,
        n_epochs=2,
        inner_updates=2,
        seed=3,
        tasks=TaskDistribution({"n_discs": [1, 2, 3]}, sampler="failure"),
        tasks_per_iteration=2,
        learning_rate=LinearSchedule(0.01, 0.0, 1.0),
        meta_learning_rate=0.05,
        meta_optimizer="adam",
        normalize_observations=policy == "ProgPolicy",
        scale_rewards=True,
        search_fraction=0.4,
    )


def train(model, path, checkpoint_class=ReptileCheckpoint, timesteps=TIMESTEPS):
    """Train to the end, with checkpoints, and return the final parameters by name."""
    checkpoint = checkpoint_class(path, save_freq=512)
    model.learn(timesteps - model.num_timesteps, checkpoint, reset_num_timesteps=model.num_timesteps == 0)
    model.save(path.with_suffix(".final.zip"))
    return parameters(path)


def parameters(path):
    return tensors(ReptilePPO.load(path.with_suffix(".final.zip")).get_parameters())


def start(call):
    """Run a piece of this module in a process of its own."""
    code = f"from pathlib import Path; import torch; torch.set_num_threads(1); from tests.test_resume import *; {call}"
    return subprocess.Popen([sys.executable, "-c", code])


@pytest.fixture
def one_thread():
    threads = th.get_num_threads()
    th.set_num_threads(1)
    yield
    th.set_num_threads(threads)


def tensors(value, place=""):
    """All tensors and numbers of nested state dicts, by where they are."""
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, (list, tuple)):
        items = enumerate(value)
    else:
        return {place: value}
    return {name: leaf for key, item in items for name, leaf in tensors(item, f"{place}/{key}").items()}


def assert_same_bits(expected, actual):
    assert set(expected) == set(actual)
    assert any("outer_optimizer" in name and "exp_avg" in name for name in expected)
    for name, value in expected.items():
        same = th.equal(value, actual[name]) if isinstance(value, th.Tensor) else value == actual[name]
        assert same, name


class Stop(Exception):
    pass


class StopAt(ReptileCheckpoint):
    """Fails in the middle of a rollout."""

    stop_at = TIMESTEPS // 2 + 100

    def _on_step(self):
        if self.num_timesteps >= self.stop_at:
            self.stop()
        return True

    def stop(self):
        raise Stop


class KillAt(StopAt):
    """Ends the whole process there, as ``kill -9`` does."""

    def stop(self):
        os.kill(os.getpid(), signal.SIGKILL)


def test_killed_and_resumed_training_ends_with_the_same_bits(tmp_path, one_thread):
    whole, killed = tmp_path / "whole.zip", tmp_path / "killed.zip"
    assert start(f"train(make('ProgPolicy'), Path({str(killed)!r}), KillAt)").wait(timeout=120) == -signal.SIGKILL
    assert 0 < ReptilePPO.load(killed).num_timesteps < TIMESTEPS
    assert not killed.with_suffix(".final.zip").exists()

    resumed = start(f"train(ReptilePPO.load({str(killed)!r}, env='Hanoi-v0'), Path({str(killed)!r}))")
    expected = train(make("ProgPolicy"), whole)
    assert resumed.wait(timeout=120) == 0
    assert_same_bits(expected, parameters(killed))


@pytest.mark.parametrize("policy", ["MlpPolicy", "PRLPolicy"])
def test_resumed_training_ends_with_the_same_bits_whatever_the_policy(policy, tmp_path, one_thread):
    stopped = StopAt(tmp_path / "stopped.zip")
    with pytest.raises(Stop):
        make(policy).learn(TIMESTEPS, stopped)
    actual = train(ReptilePPO.load(stopped.path, env="Hanoi-v0"), stopped.path)
    assert_same_bits(train(make(policy), tmp_path / "whole.zip"), actual)


def test_checkpoint_written_in_the_middle_of_a_task_holds_its_start(tmp_path):
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=8, n_steps=16, inner_updates=2, seed=0)
    checkpoint = StopAt(tmp_path / "model.zip", save_freq=10**9)
    checkpoint.stop_at = 8 * 16 * 5  # in the third task
    with pytest.raises(Stop):
        model.learn(10_000, checkpoint)
    assert not (tmp_path / "model.zip").exists()
    assert checkpoint.save()
    loaded = ReptilePPO.load(tmp_path / "model.zip")
    assert (loaded.meta_iteration, loaded.num_timesteps) == (2, 8 * 16 * 4)


@pytest.mark.parametrize("writer", ["model", "checkpoint"])
def test_save_that_fails_leaves_the_old_file_and_no_other(writer, tmp_path, monkeypatch):
    path = tmp_path / "model.zip"
    checkpoint = ReptileCheckpoint(path)
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=2, n_steps=16, inner_updates=1).learn(64, checkpoint)
    before, files = path.read_bytes(), sorted(os.listdir(tmp_path))

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    save = checkpoint.save if writer == "checkpoint" else lambda: model.save(path)
    with pytest.raises(OSError, match="disk full"):
        save()
    assert path.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == files


@pytest.mark.parametrize("damage", ["truncated", "changed", "missing"])
def test_damaged_checkpoint_is_replaced_by_the_one_before_which_is_said(damage, tmp_path):
    path = tmp_path / "model.zip"
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=2, n_steps=16, inner_updates=1, seed=0)
    model.learn(32 * 4, ReptileCheckpoint(path))  # at the boundaries 0, 32, 64 and 96
    assert load_last_good(path, ReptilePPO.load).num_timesteps == 96
    content = path.read_bytes()
    changed = content[:2000] + bytes([content[2000] ^ 1]) + content[2001:]
    path.unlink()
    if damage != "missing":
        path.write_bytes(content[:-100] if damage == "truncated" else changed)
    with pytest.warns(UserWarning, match=r"going on from .*model\.previous\.zip, step 64"):
        resumed = load_last_good(path, ReptilePPO.load, env="Hanoi-v0")
    resumed.learn(32, ReptileCheckpoint(path), reset_num_timesteps=False)
    # The checkpoint written anew has not pushed the good one out for the damaged one.
    assert ReptilePPO.load(tmp_path / "model.previous.zip").num_timesteps == 64
    assert ReptilePPO.load(path).num_timesteps == 64


def test_checkpoint_without_a_boundary_writes_nothing(tmp_path):
    assert not ReptileCheckpoint(tmp_path / "model.zip").save()
    assert not list(tmp_path.iterdir())


def test_checkpoint_refuses_a_negative_frequency(tmp_path):
    with pytest.raises(ValueError, match="save_freq=-1"):
        ReptileCheckpoint(tmp_path / "model.zip", save_freq=-1)
