"""What the libraries behind the Panda environments do to a user's program."""

import os
import subprocess
import sys

import pytest

from tests.envs.helpers import run_python

pytest.importorskip("pybullet", reason="PyBullet is not installed")


def test_nothing_is_printed_when_a_panda_environment_is_made() -> None:
    code = "import gymnasium as gym; gym.make('progpolicy_envs:PandaReach-v0', observation='goal').reset(seed=0)"
    assert run_python(code) == ""


@pytest.mark.skipif(sys.platform == "win32", reason="closes streams as a shell of Unix does")
def test_closed_standard_streams_are_no_obstacle() -> None:
    code = "import gymnasium as gym; gym.make('progpolicy_envs:PandaReach-v0').reset(seed=0)"
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = ["sh", "-c", '"$0" -c "$1" >&- 2>&-', sys.executable, code]
    subprocess.run(command, check=True, env=variables, timeout=60)


def test_streams_work_again_after_the_import() -> None:
    code = (
        "import os, sys, progpolicy_envs.panda; print('out', flush=True); print('err', file=sys.stderr, flush=True); "
        "os.write(1, b'raw out\\n'); os.write(2, b'raw err\\n')"
    )
    assert run_python(code).splitlines() == ["out", "err", "raw out", "raw err"]
