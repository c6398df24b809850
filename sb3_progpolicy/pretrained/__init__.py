"""Small trained programs shipped with the package, as JSON files named after their environment."""

from __future__ import annotations

from importlib.resources import as_file, files

from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.programs.program import Program, load_program


def pretrained_names() -> list[str]:
    """Return the names that :func:`load_pretrained` accepts, sorted."""
    return sorted(
        entry.name.removesuffix(".json") for entry in files(__name__).iterdir() if entry.name.endswith(".json")
    )


def load_pretrained(name: str) -> Program:
    """Load a trained program.

    :param name: an environment id, such as ``"Hanoi-v0"``, with or without a module prefix
    :return: the program, plain data that needs no torch
    :raises ValueError: if there is none of that name; the message names the nearest ones
    """
    bare = str(name).rpartition(":")[2]
    if bare not in pretrained_names():
        raise unknown("pretrained program", name, pretrained_names())
    with as_file(files(__name__) / f"{bare}.json") as path:
        return load_program(path)
