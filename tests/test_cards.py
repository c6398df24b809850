"""Model cards and comparisons of runs."""

import dataclasses
import json

import pytest

from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.cli import run
from sb3_progpolicy.experiment.comparison import read_curve
from sb3_progpolicy.pretrained import load_pretrained


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for algo in ("reptile_ppo", "reptile_mlp"):
        small = ["n_envs:4", "n_steps:16", "batch_size:64"]
        arguments = ["train", "--algo", algo, "--env", "Hanoi-v0", "--seed", "0", "-n", "512", "-f", str(folder)]
        assert run([*arguments, "--eval-freq", "256", "--verbose", "0", "--hyperparams", *small]) == 0
    return folder


def test_card_of_a_run_says_how_it_was_trained_and_what_it_reaches(runs, capsys):
    folder = runs / "reptile_ppo" / "Hanoi-v0_1"
    assert run(["card", str(folder), "--set", "n_discs=1,6", "--episodes", "1"]) == 0
    text = (folder / "card.md").read_text(encoding="utf-8")
    for part in (
        "# reptile_ppo on Hanoi-v0",
        "* Seed: 0",
        "Wu et al., IJCAI 2024",
        "'n_discs': 4",
        "n_envs: 4",
        "| n_discs 1 | trained |",
        "| n_discs 6 | extrapolated |",
        "](card.gif)",
        "Program for Hanoi-v0",
        "stable-baselines3 ",
    ):
        assert part in text
    assert (folder / "card.gif").read_bytes().startswith(b"GIF89a")


def test_card_of_a_network_has_no_program(runs, tmp_path):
    folder, output = runs / "reptile_mlp" / "Hanoi-v0_1", tmp_path / "mlp.md"
    assert run(["card", str(folder), "--set", "n_discs=1", "--episodes", "1", "-o", str(output)]) == 0
    text = output.read_text(encoding="utf-8")
    assert "Most likely actions." in text
    assert "## Program" not in text


def test_card_of_a_shipped_program(tmp_path):
    output = tmp_path / "card.md"
    arguments = ["card", "Hanoi-v0", "--set", "n_discs=7", "--episodes", "1", "--no-film", "-o", str(output)]
    assert run(arguments) == 0
    text = output.read_text(encoding="utf-8")
    assert "| n_discs 7 | extrapolated | 100% | 127.0 ± 0.0 | 127.0 | 1.00 |" in text
    assert "gif" not in text


def test_a_card_says_what_was_trained_on(tmp_path):
    """PPO is trained on the domain's default alone, three discs."""
    output, small = tmp_path / "card.md", ["n_envs:4", "n_steps:16", "batch_size:64"]
    arguments = ["train", "--algo", "ppo", "--env", "Hanoi-v0", "--seed", "0", "-n", "64", "-f", str(tmp_path)]
    assert run([*arguments, "--verbose", "0", "--hyperparams", *small]) == 0
    folder = str(tmp_path / "ppo" / "Hanoi-v0_1")
    arguments = ["card", folder, "--allow-pickle", "--set", "n_discs=2,3", "--episodes", "1"]
    assert run([*arguments, "-o", str(output)]) == 0
    text = output.read_text(encoding="utf-8")
    assert "| n_discs 2 | easier |" in text
    assert "| n_discs 3 | trained |" in text


@pytest.mark.parametrize(("known", "relation"), [([{"n_discs": 1}, {"n_discs": 2}], "extrapolated"), (None, "")])
def test_a_bare_program_is_compared_with_what_its_file_says_alone(tmp_path, known, relation):
    program = load_pretrained("Hanoi-v0")
    path, output = tmp_path / "program.json", tmp_path / "card.md"
    about = program.metadata if known is None else {**program.metadata, "trained_on": known}
    dataclasses.replace(program, metadata=about).save(path)
    arguments = ["card", str(path), "--set", "n_discs=3", "--episodes", "1", "--no-film", "-o", str(output)]
    assert run(arguments) == 0
    text = output.read_text(encoding="utf-8")
    assert f"| n_discs 3 | {relation} | 100%" in text
    assert ("* Trained on: {'n_discs': 1}, {'n_discs': 2}" in text) == (known is not None)


def test_a_card_where_there_is_no_goal(tmp_path):
    program = ReptilePPO("ProgPolicy", "CartPole-v1", n_steps=8, batch_size=8, seed=0, device="cpu").program()
    program.save(tmp_path / "pole.json")
    assert run(["card", str(tmp_path / "pole.json"), "--episodes", "1", "-o", str(tmp_path / "card.md")]) == 0
    text = (tmp_path / "card.md").read_text(encoding="utf-8")
    assert "![as it is: " in text
    assert "goal" not in text
    assert "fails" not in text


def test_comparison_is_on_the_same_episodes(runs, tmp_path, capsys):
    names = ["Hanoi-v0", *(str(runs / algo / "Hanoi-v0_1") for algo in ("reptile_ppo", "reptile_mlp"))]
    picture = tmp_path / "compared.svg"
    assert run(["compare", *names, "--set", "n_discs=1,2", "--episodes", "1", "--json", "-o", str(picture)]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["run"], row["variation"]["n_discs"]) for row in rows] == [(name, n) for name in names for n in (1, 2)]
    assert [row["steps_mean"] for row in rows[:2]] == [1.0, 3.0]
    assert {row["optimal_steps_mean"] for row in rows} == {1.0, 3.0}
    assert "<svg" in picture.read_text(encoding="utf-8")
    assert [timesteps for timesteps, _ in read_curve(runs / "reptile_mlp" / "Hanoi-v0_1")] == [0, 256, 512]
    assert run(["compare", *names, "--set", "n_discs=1", "--episodes", "1"]) == 0
    assert "planner" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compare", "Hanoi-v0"], "1 run given; two or more are compared"),
        (["compare", "Hanoi-v0", "Stacking-v0"], "runs of different environments cannot be compared"),
        (["compare", "Hanoi-v0", "Hanoi-v0", "-o", "c.jpg"], "the file is a .png or an .svg"),
        (["compare", "Hanoi-v0", "none.json"], "none.json does not exist"),
        (["card", "Hanoi-v0", "-o", "card.html"], "the file is a .md"),
        (["card", "nothing"], "unknown run, file or pretrained program 'nothing'"),
    ],
)
def test_mistakes_are_named(arguments, message, capsys):
    assert run(arguments) == 2
    assert message in capsys.readouterr().err
