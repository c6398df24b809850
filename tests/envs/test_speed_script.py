"""The speed measurement runs and prints its table."""

import os
import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "envs_speed.py"


def test_speed_script_prints_a_ratio_for_every_planning_domain() -> None:
    command = [sys.executable, str(SCRIPT), "--num-envs", "256", "--seconds", "0.05", "--rounds", "3"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, env=environment)
    rows = re.findall(r"^(\S+-v0(?:, \w+)?)\s+([\d,]+)\s+([\d,]+)\s+([\d,]+)", result.stdout, flags=re.MULTILINE)
    assert [row[0] for row in rows] == ["Hanoi-v0", "Hiking-v0, map", "Hiking-v0, egocentric", "Stacking-v0"]
    assert all(int(ratio.replace(",", "")) > 5 for *_, ratio in rows), result.stdout
