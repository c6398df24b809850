"""What is installed is all that is there."""

import configparser
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_package_is_installed():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    listed = set(setup["options"]["packages"].split())
    roots = {"sb3_progpolicy": ROOT, "progpolicy_envs": ROOT / "envs"}
    found = {
        ".".join(path.parent.relative_to(root).parts)
        for name, root in roots.items()
        for path in (root / name).rglob("__init__.py")
    }
    # A folder of data with no __init__.py is installed as a package, too, where it is listed.
    assert found <= listed
    assert listed - found <= {"sb3_progpolicy.hyperparams"}
