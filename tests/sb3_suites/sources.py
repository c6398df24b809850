"""The suites: the tests in the source distributions of the installed versions. Nothing of them is kept here."""

import subprocess
import sys
import tarfile
from importlib.metadata import version
from pathlib import Path

DISTRIBUTIONS = {"stable_baselines3": "stable-baselines3", "sb3_contrib": "sb3-contrib"}


def download(folder: Path) -> None:
    """Put the source distributions into a folder with pip."""
    wanted = [f"{name}=={version(name)}" for name in DISTRIBUTIONS.values()]
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:"]
    subprocess.run([*command, "--dest", str(folder), *wanted], check=True)


def unpack(package: str, source: Path, target: Path) -> Path:
    """Unpack the tests of a package, without the package itself, which would be imported instead of the installed one.

    :param package: its import name
    :param source: folder that holds the source distribution
    :param target: folder to unpack into
    :return: the folder of the tests
    """
    archive = next(iter(source.glob(f"{package}-{version(DISTRIBUTIONS[package])}.tar.gz")), None)
    if archive is None:
        raise SystemExit(f"{source} has no {package}-{version(DISTRIBUTIONS[package])}.tar.gz")
    folder = target / package
    folder.mkdir()
    with tarfile.open(archive) as files:
        for member in files.getmembers():
            path = Path(member.name)
            if member.isfile() and path.parts[1:-1] == ("tests",) and path.suffix == ".py":
                content = files.extractfile(member)
                assert content is not None
                (folder / path.name).write_bytes(content.read())
    return folder
