"""Every example runs as a user would run it, in a process of its own, with a small budget."""

import json
import os
import subprocess
import sys
from pathlib import Path

from sb3_progpolicy.programs import load_program
from sb3_progpolicy.programs.io import program_digest

EXAMPLES = Path(__file__).parent.parent / "examples"
BUDGET = "4096"


def run(script, folder, *arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(EXAMPLES / script), "--timesteps", BUDGET, *arguments]
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_quickstart_prints_the_program_and_its_steps(tmp_path):
    output = run("quickstart.py", tmp_path)
    assert "Program" in output
    assert "optimum: 127.0" in output


def test_own_task_domain_trains_a_network_and_a_program(tmp_path):
    output = run("own_task_domain.py", tmp_path)
    assert "[pole angle]" in output  # the program
    assert "half-length 1.2 m: network" in output


def test_read_and_export_writes_every_format_of_a_program_trained_or_given(tmp_path):
    output = run("read_and_export.py", tmp_path, "--out", "first")
    assert "files in first/" in output
    written = {path.name for path in (tmp_path / "first").iterdir()}
    assert written == {
        "program.json",
        "program.png",
        "program.dot",
        "program.tex",
        "hanoi_program.h",
        "hanoi_program.py",
    }
    run("read_and_export.py", tmp_path, "first/program.json", "--out", "second")
    assert (tmp_path / "first/program.json").read_bytes() == (tmp_path / "second/program.json").read_bytes()


def test_demo_prints_a_table_and_writes_program_picture_and_film(tmp_path):
    output = run("demo.py", tmp_path)
    rows = [line for line in output.splitlines() if "│" in line]
    sizes = [*range(1, 9), *range(1, 13)]  # the learnt program, then the simplified one
    assert [row.split("│")[1].strip() for row in rows] == list(map(str, sizes))
    folder = tmp_path / "runs/demo"
    assert load_program(folder / "program.json").metadata["env"] == "Hanoi-v0"
    assert (folder / "program.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "hanoi.gif").read_bytes().startswith(b"GIF89a")
    small = load_program(folder / "simplified.json")
    assert json.loads((folder / "certificate.json").read_text())["program"] == program_digest(small)
    assert "<!DOCTYPE html>" in (folder / "hanoi.html").read_text()


def test_distilled_network_is_printed_and_exported(tmp_path):
    output = run("distill_sb3_model.py", tmp_path, "--episodes", "12", "--states", "1000")
    assert "Program for CartPole-v1" in output
    assert "of the actions are the same" in output
    assert (tmp_path / "policy.py").exists()


def test_distilled_planner_is_compared_with_it(tmp_path):
    output = run("distill_planner.py", tmp_path, "--env", "Stacking-v0", "--max-conditions", "0")
    assert "round 12 of 12" in output
    assert "success: planner 1.00" in output
