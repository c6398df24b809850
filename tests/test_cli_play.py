"""``progpolicy play`` with piped and typed keys, and ``progpolicy render --planner`` and ``envs`` for every domain."""

import contextlib
import io
import os
import subprocess
import sys
from importlib.util import find_spec

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from progpolicy_envs import DOMAINS
from sb3_progpolicy.cli import run
from sb3_progpolicy.cli.play import action_keys

needs_pybullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is not installed")
PLANNING = [domain.id for domain in DOMAINS.values() if not domain.simulation]


@pytest.fixture
def play(monkeypatch, capsys):
    def played(keys, *arguments):
        monkeypatch.setattr(sys, "stdin", io.StringIO(keys))
        code = run(["play", *arguments])
        return code, *capsys.readouterr()

    return played


def test_hanoi_is_solved_by_typed_keys_and_every_state_is_shown(play):
    # Two discs from peg 0 to peg 2: 0->1, 0->2, 1->2.
    code, out, _ = play("12\n 4", "Hanoi-v0", "--set", "n_discs=2")
    assert code == 0
    assert out.startswith("1 move 0->1   2 move 0->2   3 move 1->0   4 move 1->2   5 move 2->0   6 move 2->1   q quit")
    assert out.count("0 source --1-- 2 target") == 4
    assert "2: move 0->2, reward -0.01" in out
    assert "Goal reached in 3 steps; the planner needs 3. Return" in out.splitlines()[-1]


def test_quit_and_end_of_input_stop_and_unknown_keys_are_answered(play):
    code, out, _ = play("1x1q222", "Hanoi-v0")
    assert code == 0
    assert "'x' is not a key; keys: 1 2 3 4 5 6 q" in out
    assert out.endswith("Stopped after 2 steps; the planner needs 7 in all.\n")
    assert play("1", "Hanoi-v0")[1].endswith("Stopped after 1 steps; the planner needs 7 in all.\n")


@pytest.mark.parametrize("env_id", PLANNING)
def test_every_planning_domain_shows_all_its_actions_and_takes_all_keys(play, env_id):
    number_of_keys = gym.make(env_id).action_space.n
    _, out, _ = play("", env_id, "--seed", "1")
    keys = [entry.split()[0] for entry in out.splitlines()[0].split("   ")]
    assert len(set(keys)) == number_of_keys + 1
    _, out, _ = play("".join(keys), env_id, "--seed", "1", "--set", f"{DOMAINS[env_id].size}=4")
    assert f"\n{number_of_keys}: " in out


def test_equal_seeds_give_equal_games(play):
    games = [play("nesw", "Hiking-v0", "--seed", seed)[1] for seed in ("1", "1", "2")]
    assert games[0] == games[1] != games[2]


def test_actions_without_an_initial_of_their_own_are_numbered():
    assert action_keys(["north", "pick", "move 0->1"]) == {"n": 0, "p": 1, "3": 2}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["PandaReach-v0"], "can be played in a terminal: Hanoi-v0"),
        (["CartPole-v1"], "can be played in a terminal: Hanoi-v0"),
        (["Hanoy-v0"], "Hanoi-v0"),
        (["Hanoi-v0", "--set", "n_discs=1,2"], "2 variations"),
        (["Hanoi-v0", "--set", "n_discs=77"], "n_discs=77"),
    ],
)
def test_what_cannot_be_played_is_refused(play, arguments, said):
    code, out, err = play("q", *arguments)
    assert (code, out) == (2, "")
    assert said in err


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo-terminals on this system")
def test_in_a_terminal_single_keys_are_enough():
    ours, theirs = os.openpty()
    command = [sys.executable, "-c", "from sb3_progpolicy.cli import main; main()", "play", "Hanoi-v0"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        # What is typed before a key is waited for is thrown away; so it is typed until it has been taken.
        for _ in range(300):
            os.write(ours, b"Q")
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=0.2)
                break
        assert process.returncode == 0
        assert process.stdout.read().endswith("Stopped after 0 steps; the planner needs 7 in all.\n")
    finally:
        process.kill()
        process.communicate()
        os.close(ours)
        os.close(theirs)


@pytest.mark.parametrize("env_id", PLANNING)
def test_the_planner_of_every_planning_domain_is_rendered_to_its_goal(tmp_path, capsys, env_id):
    file = tmp_path / "planner.gif"
    assert run(["render", env_id, "--planner", "-o", str(file), "--set", f"{DOMAINS[env_id].size}=3"]) == 0
    message = capsys.readouterr().err
    assert "goal reached" in message
    with Image.open(file) as picture:
        assert f"{picture.n_frames - 1} steps" in message


@needs_pybullet
@pytest.mark.parametrize(("env_id", "size"), [("Stacking-v0", "n_plates=8"), ("PandaPush-v0", "n_objects=8")])
def test_colours_of_small_things_survive_in_the_animation(tmp_path, env_id, size):
    file = tmp_path / "a.gif"
    assert run(["render", env_id, "--random", "-o", str(file), "--set", size, "--max-steps", "1", "--seed", "0"]) == 0
    name, number = size.split("=")
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0, options={name: int(number)})
    with Image.open(file) as picture:
        difference = np.asarray(picture.convert("RGB")).astype(int) - env.render()
    env.close()
    assert np.abs(difference).max() <= 10


@needs_pybullet
@pytest.mark.parametrize(("actor", "cap"), [("--planner", "30"), ("--random", "3")])
def test_panda_is_rendered(tmp_path, capsys, actor, cap):
    file = tmp_path / "panda.gif"
    assert run(["render", "PandaReach-v0", actor, "-o", str(file), "--set", "n_targets=1", "--max-steps", cap]) == 0
    message = capsys.readouterr().err
    assert ("goal reached" in message) == (actor == "--planner")
    with Image.open(file) as picture:
        assert f"{picture.n_frames - 1} steps" in message


def test_the_planner_of_another_environment_is_refused(tmp_path, capsys):
    assert run(["render", "CartPole-v1", "--planner", "-o", str(tmp_path / "a.gif"), "--set", "low=-0.01"]) == 2
    assert "--planner is not accepted for CartPole-v1" in capsys.readouterr().err


@needs_pybullet
def test_the_table_of_environments_lists_every_domain_with_ranges_and_both_sets(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    assert run(["envs"]) == 0
    out = capsys.readouterr().out
    rows = {domain: [line for line in out.split("├") if domain in line] for domain in DOMAINS}
    for domain in DOMAINS.values():
        (row,) = rows[domain.id]
        for part in (domain.train, domain.validation, domain.unseen):
            sizes = ", ".join(dict.fromkeys(str(variation[domain.size]) for variation in part))
            assert f"{domain.size}: {sizes}" in row
        assert row.count(f"{domain.size}: ") == 4, "the range, what is trained on, what is chosen by, what is unseen"


def test_the_table_of_environments_says_what_the_panda_tasks_need_where_pybullet_is_missing():
    code = "import sys; sys.modules['pybullet'] = None; from sb3_progpolicy.cli import main; main()"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "300"}
    command = [sys.executable, "-c", code, "envs"]
    out = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60, check=True).stdout
    rows = out.split("├")
    assert sum('pip install "sb3-progpolicy[panda]"' in row for row in rows) == len(DOMAINS) - len(PLANNING)
    assert sum("an integer from" in row for row in rows) == len(PLANNING)
