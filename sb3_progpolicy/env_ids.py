"""Environment ids: what they stand for, and which of them a file may give."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

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


def creator_of(env_id: str) -> Any:
    """Return what makes the environments of an id: a class, or a function.

    :param env_id: see :func:`spec_of`
    :raises ValueError: if there is none
    """
    entry_point = spec_of(env_id).entry_point
    return entry_point if callable(entry_point) else load_env_creator(str(entry_point))


def id_from_file(env_id: Any) -> str | None:
    """Return an environment id that a file gives, unless a module would have to be imported for it, which runs code.

    :param env_id: from the metadata of a program
    """
    if not isinstance(env_id, str):
        return None
    module = env_id.rpartition(":")[0]
    return env_id if not module or module in sys.modules else None


def same_env(one: Any, other: Any) -> bool:
    """Return whether two ids are of one environment, with or without the module that registers it.

    :param one: an id, or something else, which is of none
    :param other: another
    """
    if not isinstance(one, str) or not isinstance(other, str):
        return False
    return one.rpartition(":")[2] == other.rpartition(":")[2]


def env_to_act_in(given: str | None, named: Any, who: str, argument: str = "env_id=") -> str:
    """Return the environment id that a user gives, or else the one that a file names.

    :param given: by the user; its module may be imported
    :param named: by a file; its module is not imported for it
    :param who: acts in it, for the message
    :param argument: by which a user gives an id, ``"env_id="`` or ``"--env "``
    :raises ValueError: if there is none, or the file's needs a module that is not imported
    """
    env_id = given or id_from_file(named)
    if env_id:
        return env_id
    if isinstance(named, str) and named:
        module = named.rpartition(":")[0]
        raise ValueError(
            f"{who} names the environment {named}, and a file may not have the module {module} imported, which runs "
            f"its code; give {argument}{named}"
        )
    raise ValueError(f"{who} does not say which environment it is for; give {argument.strip(' =')}")


def _import(module: str) -> None:
    here = os.getcwd()
    sys.path.append(here)
    try:
        import_module(module)
    except Exception as error:  # a module may raise anything
        raise ValueError(f"module {module!r} cannot be imported: {type(error).__name__}: {error}") from None
    finally:
        sys.path.remove(here)
