"""The speed measurements run and print their tables."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SCRIPT = BENCHMARKS / "envs_speed.py"


def test_speed_script_prints_a_row_for_every_planning_domain() -> None:
    command = [sys.executable, str(SCRIPT), "--num-envs", "4", "--seconds", "0.01", "--rounds", "1"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, env=environment)
    rows = re.findall(r"^(\S+-v\d)\s+[\d,]+\s+[\d,]+\s+[\d,]+", result.stdout, flags=re.MULTILINE)
    assert rows == ["Hanoi-v0", "Hiking-v0", "Hiking-v1", "HikingEgo-v0", "Stacking-v0"]


@pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is not installed")
def test_panda_speed_script_does_without_panda_gym_and_says_so() -> None:
    script = str(BENCHMARKS / "panda_speed.py")
    # A module that is None in sys.modules can't be imported, as if it were not installed.
    program = (
        f"import runpy, sys; sys.modules['panda_gym'] = None; sys.argv[0] = {script!r}; "
        f"runpy.run_path({script!r}, run_name='__main__')"
    )
    command = [sys.executable, "-c", program, "--blocks", "1", "--rounds", "1"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True, env=environment)
    rows = re.findall(r"^(Panda\w+) +([\d,]+) .*%", result.stdout, flags=re.MULTILINE)
    assert [task for task, _ in rows] == ["PandaReach", "PandaPush", "PandaSlide", "PandaStack"]
    assert "panda-gym is not installed" in result.stdout
    assert "peers" in result.stdout
