import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

import sb3_progpolicy.pretrained as pretrained
from progpolicy_envs.hanoi import MOVES
from sb3_progpolicy import evaluate_program, load_pretrained, pretrained_names
from sb3_progpolicy.programs import ProgramRunner, join_inputs
from tests.envs.test_hanoi import Referee
from tests.handwritten.hanoi import hanoi_program


@pytest.fixture
def one_program(tmp_path, monkeypatch):
    hanoi_program().save(tmp_path / "Hanoi-v0.json")
    monkeypatch.setattr(pretrained, "files", lambda package: tmp_path)


def test_program_is_loaded_by_its_environment(one_program):
    assert pretrained_names() == ["Hanoi-v0"]
    assert load_pretrained("Hanoi-v0") == load_pretrained("progpolicy_envs:Hanoi-v0") == hanoi_program()


def test_unknown_name_is_answered_with_the_nearest(one_program):
    with pytest.raises(ValueError, match="'Hanoi-v1'; nearest: Hanoi-v0"):
        load_pretrained("Hanoi-v1")


def test_every_shipped_program_loads():
    names = pretrained_names()
    assert "Hanoi-v0" in names
    assert [load_pretrained(name).metadata["env"] for name in names] == names


def test_guide_prints_programs_as_they_are():
    guide = Path(__file__).parents[1].joinpath("docs/guide/imitation.md").read_text(encoding="utf-8")
    printed = re.findall(r"as `progpolicy show (\S+)` prints it.*?```text\n(.*?)```", guide, flags=re.DOTALL)
    assert {name for name, _ in printed} == {"PandaPush-v0", "PandaSlide-v0", "PandaStack-v0"}
    for name, text in printed:
        assert text.rstrip() in str(load_pretrained(name)), name


def test_loading_needs_no_torch():
    code = "import sys, sb3_progpolicy as s; s.load_pretrained('Hanoi-v0'); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize("semantics", ["soft", "crisp"])
@pytest.mark.parametrize("n_discs", range(1, 11))
def test_moves_of_the_shipped_program_obey_the_puzzles_rules_and_are_the_fewest(n_discs, semantics):
    program = load_pretrained("Hanoi-v0")
    env = gym.make("Hanoi-v0", n_discs=n_discs, max_episode_steps=2**n_discs)
    runner, referee = ProgramRunner(program, semantics=semantics), Referee(n_discs, source=0)
    observation, _ = env.reset()
    action, reward, ended, n_moves = None, 0.0, False, 0
    while not ended:
        action = runner.act(join_inputs(program, observation, action, reward, ended))
        referee.move(*MOVES[int(action[0])])
        observation, reward, terminated, truncated, _ = env.step(action[0])
        ended, n_moves = terminated or truncated, n_moves + 1
    assert referee.piles[2] == list(range(n_discs, 0, -1))
    assert n_moves == 2**n_discs - 1


@pytest.mark.parametrize(
    ("name", "variation", "n_episodes", "ratio"),
    [
        ("Hanoi-v0", {"n_discs": 7}, 1, 1.0),
        ("PandaReach-v0", {"n_targets": 8}, 3, None),
        ("PandaPush-v0", {"n_objects": 5}, 3, None),
        ("PandaStack-v0", {"n_objects": 5}, 2, None),
        ("Stacking-v0", {"n_plates": 8}, 50, 1.02),
    ],
)
def test_shipped_programs_solve_what_they_were_not_trained_on(name, variation, n_episodes, ratio):
    (result,) = evaluate_program(load_pretrained(name), name, [variation], n_episodes, seed=50)
    assert result.success_rate == 1
    assert result.ratio is None if ratio is None else 1 <= result.ratio <= ratio
