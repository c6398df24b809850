"""Environment ids: what they stand for, and which of them a file may give."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any

import gymnasium as gym

from sb3_progpolicy.nearest import unknown


def spec_of(env_id: str) -> Any:
    """Return the registered specification of an environment id.

    :param env_id: an id, or ``module:id`` where a module registers it, which may be in the working directory
    :raises ValueError: if there is none; the message names the nearest ids
    """
    module, _, name = env_id.rpartition(":")
    if module:
        _import(module)
    try:
        return gym.spec(name)
    except gym.error.Error:
        raise unknown("environment", env_id, gym.registry) from None


def id_from_file(env_id: Any) -> str | None:
    """Return an environment id that a file gives, unless a module would have to be imported for it, which runs code.

    :param env_id: from the metadata of a program
    """
    if not isinstance(env_id, str):
        return None
    module = env_id.rpartition(":")[0]
    return env_id if not module or module in sys.modules else None


def _import(module: str) -> None:
    here = os.getcwd()
    sys.path.append(here)
    try:
        import_module(module)
    except Exception as error:  # a module may raise anything
        raise ValueError(f"module {module!r} cannot be imported: {type(error).__name__}: {error}") from None
    finally:
        sys.path.remove(here)
