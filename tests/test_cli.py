import json
import os
import re
import subprocess
import sys
from dataclasses import replace

import imageio_ffmpeg
import pytest
import yaml
from PIL import Image, ImageSequence

from progpolicy_envs import get_domain
from sb3_progpolicy.cli import run
from sb3_progpolicy.cli.parsing import parse_variations, repeat_flags
from sb3_progpolicy.programs import load_program
from tests.handwritten.hanoi import hanoi_program

TINY = ["--hyperparams", "n_envs:4", "n_steps:16", "batch_size:16", "n_epochs:1", "--verbose", "0"]
FIELDS = {
    "env",
    "variation",
    "episodes",
    "success_rate",
    "steps_mean",
    "steps_std",
    "return_mean",
    "return_std",
    "optimal_steps_mean",
    "semantics",
    "learned_by",
}


@pytest.fixture
def program(tmp_path):
    path = tmp_path / "program.json"
    solver = hanoi_program()
    object.__setattr__(solver, "metadata", {"env": "Hanoi-v0"})
    solver.save(path)
    return str(path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    assert run(["train", "--seed", "0", "-f", str(folder), "-n", "512", "--eval-freq", "256", *TINY]) == 0
    return folder / "reptile_ppo" / "Hanoi-v0_1"


# Ctrl-C from a thread of the process itself: a process of its own may be too late on a busy machine.
INTERRUPTED = """
import os, signal, sys, threading, time
from pathlib import Path
from sb3_progpolicy.cli import main

def interrupt(checkpoint):
    while not checkpoint.exists():
        time.sleep(0.001)
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread(target=interrupt, args=(Path(sys.argv.pop(1)),), daemon=True).start()
main()
"""


def process(*arguments, code="from sb3_progpolicy.cli import main; main()"):
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_run_folder_holds_model_program_and_what_was_run(trained):
    files = {path.name for path in trained.iterdir()}
    assert files - {".lock"} == {
        "model.zip",
        "program.json",
        "config.yml",
        "args.yml",
        "versions.yml",
        "evaluations.json",
    }
    config = yaml.safe_load((trained / "config.yml").read_text())
    assert (config["algo"], config["env"], config["seed"]) == ("reptile_ppo", "Hanoi-v0", 0)
    assert config["hyperparams"]["n_steps"] == 16
    about = load_program(trained / "program.json").metadata
    assert about["timesteps"] == 512
    assert about["trained_on"] == list(get_domain("Hanoi-v0").train)
    assert {row["timesteps"] for row in json.loads((trained / "evaluations.json").read_text())} == {0, 256, 512}


def test_equal_seeds_give_equal_programs_in_folders_of_their_own(trained):
    assert run(["train", "--seed", "0", "-f", str(trained.parents[1]), "-n", "512", *TINY]) == 0
    again = trained.with_name("Hanoi-v0_2")
    assert (again / "program.json").read_bytes() == (trained / "program.json").read_bytes()


@pytest.mark.parametrize("algo", ["ppo", "recurrent_ppo"])
def test_stock_algorithms_are_trained_and_evaluated(algo, tmp_path, capsys):
    assert run(["train", "--algo", algo, "--seed", "0", "-f", str(tmp_path), "-n", "256", *TINY]) == 0
    run_folder = tmp_path / algo / "Hanoi-v0_1"
    capsys.readouterr()
    evaluate = ["evaluate", str(run_folder), "--set", "n_discs=1", "--max-steps", "5", "--json"]
    assert run(evaluate) == 2
    assert "saved with pickle: loading it runs the code in it" in capsys.readouterr().err
    assert run([*evaluate, "--allow-pickle"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["semantics"] is None
    assert row["learned_by"] is None
    assert run(["show", str(run_folder), "--allow-pickle"]) == 2
    start = ["train", "--algo", algo, "-i", str(run_folder), "-f", str(tmp_path / "b"), "-n", "64", *TINY]
    assert run(start) == 2
    assert run([*start, "--allow-pickle"]) == 0


def test_evaluation_prints_only_json(program):
    out, _ = process("evaluate", program, "--set", "n_discs=5,6,7,8", "--episodes", "1", "--json").communicate()
    rows = json.loads(out)
    assert [(row["semantics"], row["variation"]["n_discs"], row["steps_mean"]) for row in rows] == [
        (semantics, n_discs, 2**n_discs - 1) for semantics in ("soft", "crisp") for n_discs in (5, 6, 7, 8)
    ]
    assert all(set(row) == FIELDS for row in rows)
    assert {row["learned_by"] for row in rows} == {"reinforcement"}


def test_evaluation_table_shows_steps_optimum_and_ratio(program, capsys):
    assert run(["evaluate", program, "--set", "n_discs=3", "--semantics", "crisp"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"3 +\S+ +crisp +\S+ +100% +\S+ +7 +\S+ +7 +\S+ +1\.00", out)


def test_run_model_and_program_are_the_same_source(trained, capsys):
    outputs = []
    for source in (trained, trained / "model.zip", trained / "program.json"):
        assert run(["show", str(source), "--format", "python"]) == 0
        outputs.append(capsys.readouterr().out)
    assert len(set(outputs)) == 1


@pytest.mark.parametrize(
    ("format_", "start"),
    [
        ("text", "Program"),
        ("latex", "cases"),
        ("dot", "digraph"),
        ("python", '"""'),
        ("c", "hanoi_v0_act("),
        ("javascript", "class ProgramPolicy"),
        ("html", "<!DOCTYPE html>"),
    ],
)
def test_show_prints_every_format(format_, start, program, tmp_path, capsys):
    assert run(["show", program, "--format", format_]) == 0
    printed = capsys.readouterr().out
    assert run(["show", program, "--format", format_, "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out").read_text() == printed
    assert start in printed


def test_show_writes_an_onnx_model_and_a_c_header_as_the_file_is_named(program, tmp_path, monkeypatch):
    onnx = pytest.importorskip("onnx")
    monkeypatch.chdir(tmp_path)
    assert run(["show", program, "--format", "onnx"]) == 0
    assert run(["show", program, "-o", "again.onnx"]) == 0
    assert (tmp_path / "Hanoi-v0.onnx").read_bytes() == (tmp_path / "again.onnx").read_bytes()
    onnx.checker.check_model(onnx.load("again.onnx"))
    assert run(["show", program, "-o", "program.h"]) == 0
    assert "#include <math.h>" in (tmp_path / "program.h").read_text()


def test_show_says_what_an_onnx_model_needs(program, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert run(["show", program, "--format", "onnx"]) == 2
    assert 'pip install "sb3-progpolicy[onnx]"' in capsys.readouterr().err


def test_show_draws(program, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(["show", program, "--format", "png"]) == 0
    with Image.open("Hanoi-v0.png") as image:
        assert image.width > 300


@pytest.mark.parametrize(
    ("title", "written"),
    [
        ("..\\..\\x\0/y", "..-..-x-y.png"),
        ("my_envs:Pong-v5", "Pong-v5.png"),
        ("é" * 300, "-.png"),
        ("a:", "program.png"),
    ],
)
def test_picture_of_a_hostile_program_goes_to_a_plain_file_here(title, written, tmp_path, monkeypatch):
    replace(hanoi_program(), metadata={"env": title}).save(tmp_path / "program.json")
    monkeypatch.chdir(tmp_path)
    assert run(["show", "program.json", "--format", "png"]) == 0
    assert sorted(os.listdir()) == sorted([written, "program.json"])


@pytest.mark.parametrize(
    ("arguments", "steps"), [(["PROGRAM"], 7), (["Hanoi-v0", "--planner"], 7), (["Hanoi-v0", "--random"], 20)]
)
def test_render_writes_a_picture_for_every_step(arguments, steps, program, tmp_path):
    source = [program if argument == "PROGRAM" else argument for argument in arguments]
    gif = tmp_path / "hanoi.gif"
    assert run(["render", *source, "--set", "n_discs=3", "--max-steps", "20", "-o", str(gif)]) == 0
    with Image.open(gif) as image:
        # Pillow joins equal frames; the last one is shown for two seconds.
        assert sum(frame.info["duration"] for frame in ImageSequence.Iterator(image)) == steps * 250 + 2000
        assert image.n_frames > 3
        assert image.size == (480, 240)


def test_render_writes_a_film(tmp_path):
    film = tmp_path / "hanoi.mp4"
    assert run(["render", "Hanoi-v0", "--planner", "--set", "n_discs=3", "--fps", "4", "-o", str(film)]) == 0
    frames = imageio_ffmpeg.read_frames(str(film))
    about = next(frames)
    assert (about["size"], about["fps"]) == ((480, 240), 4)
    # The start, a picture for each of seven moves, and the last one for two seconds more.
    assert len(list(frames)) == 1 + 7 + 2 * 4
    assert list(tmp_path.iterdir()) == [film]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["evaluat"], "nearest: evaluate"),
        (["train", "--env", "Hanoy-v0"], "Hanoi-v0"),
        (["train", "--algo", "reptil_ppo"], "nearest: reptile_ppo"),
        (["train", "--hyperparams", "n_step:3"], "nearest: n_steps"),
        (["train", "--hyperparams", "n_steps:many"], "n_steps='many'"),
        (["train", "--hyperparams", "n_steps"], "name:value"),
        (["train", "--hyperparams", "policy_kwargs:dict(cell='gr')"], "affine, min, rnn, gru, lstm"),
        (["train", "--hyperparams", "batch_size:7"], "batch_size=7"),
        (["train", "--env-kwargs", "n_disc:3"], "nearest: n_discs"),
        (["train", "--sed", "3"], "--seed"),
        (["train", "-n", "many"], "--n-timesteps"),
        (["train", "--resume", "nowhere"], "not a run folder"),
        (["train", "--device", "abacus"], "abacus"),
        (["evaluate", "nowhere.json"], "does not exist"),
        (["evaluate", "PROGRAM", "--set", "n_disc=3"], "did you mean 'n_discs'"),
        (["evaluate", "PROGRAM", "--set", "n_discs=30"], "from 1 to 12"),
        (["evaluate", "PROGRAM", "--set", "n_discs=8-1"], "range"),
        (["evaluate", "PROGRAM", "--semantics", "sof"], "nearest: soft"),
        (["show", "PROGRAM", "--format", "lattex"], "nearest: latex"),
        (["render", "PROGRAM", "-o", "hanoi.avi"], ".mp4"),
        (["show", "PROGRAM", "-o", "nowhere/program.txt"], "nowhere"),
        (["render", "PROGRAM", "--set", "n_discs=1,2", "-o", "hanoi.gif"], "2 variations"),
        (["render", "PROGRAM", "-o", "nowhere/hanoi.gif", "--set", "n_discs=1"], "nowhere"),
    ],
)
def test_mistake_is_one_line_and_exit_code_2(arguments, said, program, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    assert run([program if argument == "PROGRAM" else argument for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert err.count("\n") == 1
    assert set(tmp_path.iterdir()) == before


def test_interrupted_run_says_how_to_go_on_and_ends_the_same(tmp_path, capsys):
    options = ["--seed", "5", "-n", "8000", "--hyperparams", "inner_updates:2", *TINY]
    folder = tmp_path / "a" / "reptile_ppo" / "Hanoi-v0_1"
    arguments = ["train", "-f", str(tmp_path / "a"), *options, "--save-freq", "500"]
    running = process(str(folder / "model.zip"), *arguments, code=INTERRUPTED)
    _, err = running.communicate(timeout=120)
    assert running.returncode == 130, err
    assert "Traceback" not in err
    assert f"progpolicy train --resume {folder}" in err
    assert 0 < load_program(folder / "program.json").metadata["timesteps"] < 8000
    assert run(["train", "--resume", str(folder), "--verbose", "0"]) == 0
    assert run(["train", "-f", str(tmp_path / "b"), *options]) == 0
    whole = tmp_path / "b" / "reptile_ppo" / "Hanoi-v0_1" / "program.json"
    assert (folder / "program.json").read_bytes() == whole.read_bytes()
    assert run(["train", "--resume", str(folder)]) == 2
    assert "trained already" in capsys.readouterr().err


def test_resumed_run_refuses_what_would_change_it(trained, capsys):
    assert run(["train", "--resume", str(trained), "--seed", "3"]) == 2
    assert "--seed" in capsys.readouterr().err


def test_training_starts_from_a_trained_model(trained, tmp_path, capsys):
    frozen = ["--hyperparams", "learning_rate:1e-12", *TINY[1:]]
    arguments = ["-i", str(trained), "-f", str(tmp_path), "-n", "64", "--seed", "1", *frozen]
    assert run(["train", *arguments]) == 0
    started = load_program(tmp_path / "reptile_ppo" / "Hanoi-v0_1" / "program.json")
    assert started.controllers[0].bias == pytest.approx(
        load_program(trained / "program.json").controllers[0].bias, abs=1e-6
    )
    assert run(["train", *arguments[:-2], "n_epochs:1", "policy_kwargs:{depth: 5}"]) == 2
    assert "does not fit" in capsys.readouterr().err


def test_help_needs_no_torch():
    code = "import sys, sb3_progpolicy.cli as c; c.run(['--help']); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60, env={**os.environ, "COLUMNS": "80"})


def test_one_flag_takes_several_values_as_in_the_zoo():
    assert repeat_flags(["--set", "a=1", "b=2", "run", "-n", "c=3"]) == [
        "--set",
        "a=1",
        "--set",
        "b=2",
        "run",
        "-n",
        "c=3",
    ]


def test_variations_are_every_combination_of_lists_and_ranges():
    assert parse_variations(["n=1-2,5", "peg=random"]) == [{"n": n, "peg": "random"} for n in (1, 2, 5)]
    assert len(parse_variations(["a=1,2", "b=1-3"])) == 6
