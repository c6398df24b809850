"""What the libraries behind the Panda environments do to a user's program."""

import os
import subprocess
import sys
from importlib.util import find_spec

import pytest

from tests.envs.helpers import run_python

needs_pybullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is not installed")


def test_without_pybullet_all_other_environments_work_and_the_panda_ids_say_what_to_install() -> None:
    code = """
import sys, warnings
sys.modules["pybullet"] = None  # which makes an import of it fail, as if it were not installed
import gymnasium as gym
import progpolicy_envs
warnings.simplefilter("ignore", DeprecationWarning)  # of Gymnasium, for ids of which there is a newer version
for domain in progpolicy_envs.DOMAINS.values():
    for make in (gym.make, lambda env_id: gym.make_vec(env_id, num_envs=2)):
        try:
            make(domain.id).reset(seed=0)
            assert not domain.simulation
        except ModuleNotFoundError as error:
            assert domain.simulation and error.name == "pybullet"
            print(error)
"""
    lines = run_python(code).splitlines()
    assert len(lines) == 8
    assert set(lines) == {
        'The Panda environments need PyBullet: pip install "sb3-progpolicy[panda]". There are no wheels of it for '
        "Python 3.12 and later; there pip compiles it, which takes a C++ compiler and some minutes."
    }


@needs_pybullet
def test_nothing_is_printed_when_a_panda_environment_is_made() -> None:
    code = "import gymnasium as gym; gym.make('progpolicy_envs:PandaReach-v0', observation='goal').reset(seed=0)"
    assert run_python(code) == ""


@needs_pybullet
@pytest.mark.skipif(sys.platform == "win32", reason="closes streams as a shell of Unix does")
def test_closed_standard_streams_are_no_obstacle() -> None:
    code = "import gymnasium as gym; gym.make('progpolicy_envs:PandaReach-v0').reset(seed=0)"
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = ["sh", "-c", '"$0" -c "$1" >&- 2>&-', sys.executable, code]
    subprocess.run(command, check=True, env=variables, timeout=60)


@needs_pybullet
def test_streams_work_again_after_the_import() -> None:
    code = (
        "import os, sys, progpolicy_envs.panda; print('out', flush=True); print('err', file=sys.stderr, flush=True); "
        "os.write(1, b'raw out\\n'); os.write(2, b'raw err\\n')"
    )
    assert run_python(code).splitlines() == ["out", "err", "raw out", "raw err"]
