"""What a program needs of the environment that it acts in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from progpolicy_envs import find_domain
from sb3_progpolicy.env_ids import same_env, spec_of
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.spaces import action_spec


def own_env_kwargs(program: ProgramData, env_id: str | None = None) -> dict[str, Any]:
    """Return the constructor arguments of the environment that a program was trained in, as its metadata say.

    :param program: the program
    :param env_id: where it is to act, with or without a module; there are none for another environment than its own
    :raises ValueError: if the metadata hold something else
    """
    if env_id is not None and not same_env(env_id, program.metadata.get("env")):
        return {}
    kwargs = program.metadata.get("env_kwargs", {})
    if not isinstance(kwargs, Mapping):
        raise ValueError(f"the program's env_kwargs={kwargs!r} is not accepted; it is a mapping")
    return dict(kwargs)


@dataclass(frozen=True)
class Surroundings:
    """How the environment is made that a program was trained in.

    :param variation: parameters of its domain that are not the defaults
    :param kwargs: other arguments of its constructor
    :param cap: steps after which an episode has failed; ``None`` if there is no limit
    """

    variation: Mapping[str, Any]
    kwargs: Mapping[str, Any]
    cap: int | None


def surroundings(program: ProgramData, env_id: str) -> Surroundings:
    """Return how an environment is to be made: as the program's own if it is that one, else by the defaults.

    :param program: what will act in it
    :param env_id: environment id
    """
    kwargs, domain = own_env_kwargs(program, env_id), find_domain(env_id)
    cap = kwargs.pop("max_episode_steps", spec_of(env_id).max_episode_steps)
    names = set() if domain is None or domain.space is None else set(domain.space.defaults)
    variation = {name: kwargs.pop(name) for name in list(kwargs) if name in names}
    return Surroundings(variation, kwargs, cap)


def check_fit(
    program: ProgramData, env_id: str | None, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> None:
    """Raise ``ValueError`` if a program does not read the observations of an environment, or acts otherwise.

    :param program: the program
    :param env_id: of the environment
    :param observation_space: of one environment
    :param action_space: of one environment
    """
    spec, n_observations = action_spec(action_space), int(np.prod(observation_space.shape or ()))
    if (spec, n_observations) != (program.action, program.n_observations):
        raise ValueError(
            f"the program reads {program.n_observations} numbers and acts in {program.action.kind} "
            f"{list(program.action.sizes)}; {env_id} has {n_observations} numbers and {spec.kind} {list(spec.sizes)}"
        )


def refuse_wrappers(what: str, wrappers: Any) -> None:
    """Raise ``ValueError`` if something was trained in wrappers that an environment's id does not bring back.

    :param what: was trained, for the message
    :param wrappers: see :func:`~sb3_progpolicy.extraction.wrappers_of`; from a file it may be anything
    """
    if not isinstance(wrappers, (list, tuple)) or not all(isinstance(name, str) for name in wrappers):
        raise ValueError(f"wrappers={wrappers!r} of {what} is not accepted; it is a list of names")
    if wrappers:
        raise ValueError(
            f"{what} was trained in an environment wrapped in {', '.join(wrappers)}, which an id alone does not bring "
            "back. Evaluate it in that environment, as with SB3's evaluate_policy(model, model.get_env())"
        )
