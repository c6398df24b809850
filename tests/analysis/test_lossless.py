"""What is shown of a program is the smallest form that is sure to do the same."""

import pytest

from progpolicy_envs.documentation import observation_rows
from sb3_progpolicy import load_pretrained
from sb3_progpolicy.analysis.lossless import lossless
from sb3_progpolicy.cli import run
from tests.analysis.idle import idle


@pytest.mark.parametrize("name", ["Stacking-v0", "PandaReach-v0"])
def test_programs_with_many_starts_or_physics_are_shown_as_they_are(name, capsys):
    assert lossless(load_pretrained(name), name) is None
    assert run(["show", name]) == 0
    assert "smaller terms" in capsys.readouterr().out


def test_hanoi_is_simplified_and_simplified_once_only():
    found = lossless(load_pretrained("Hanoi-v0"), "Hanoi-v0")
    assert found.terms_after == 4
    assert lossless(found.program, "Hanoi-v0") is None


@pytest.mark.parametrize("env_id", [None, "CartPole-v1", "Hiking-v0"])
def test_what_does_not_fit_is_shown_as_it_is(env_id):
    assert lossless(load_pretrained("Hanoi-v0"), env_id) is None


def test_print_is_the_whole_program_with_its_proof_and_a_glossary(capsys):
    assert run(["show", "Hanoi-v0"]) == 0
    out, err = capsys.readouterr()
    assert "Simplified from 108 numbers, with the same decisions in all 54 situations of training" in err
    assert "Simplified to 4 terms, tied over a symmetry (pegs); no program of this form has fewer." in out
    assert out.count("previous move") == 12
    assert "smaller term" not in out
    lines = out.splitlines()
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 100
    assert any(line.startswith("rank[peg]    size of the top disc") for line in lines)
    assert "empty[peg]" not in out, "it is not read"


def test_full_print_has_every_number(capsys):
    assert run(["show", "Hanoi-v0", "--full"]) == 0
    out, err = capsys.readouterr()
    assert "Simplified" not in err
    assert out.count("*") + 2 * out.count("(2 smaller terms)") == 6 * 17
    assert "Simplified" not in out


def test_what_is_for_running_has_the_numbers_as_they_were_learnt(capsys):
    assert run(["show", "Hanoi-v0", "--format", "python"]) == 0
    assert "-2.249213218688965" in capsys.readouterr().out


@pytest.mark.parametrize("env_id", ["Hanoi-v0", "Stacking-v0", "PandaPush-v0"])
def test_every_number_of_an_observation_is_explained_once(env_id):
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    rows = observation_rows(load_env_creator(gym.spec(env_id).entry_point).__doc__)
    numbers = [number for row in rows for number in row.numbers]
    assert sorted(numbers) == list(range(idle(env_id).n_observations))
    assert all(row.meaning and "|" not in row.meaning for row in rows)


@pytest.mark.parametrize(
    "docstring", [None, "", "## Observation Space\n| a | b |", "## Observation Space\n\n| Num | Meaning |"]
)
def test_other_docstrings_have_no_glossary(docstring):
    assert observation_rows(docstring) == []
