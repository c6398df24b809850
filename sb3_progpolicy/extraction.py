"""From a model to its program, whatever algorithm trained it."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, is_vecenv_wrapped

from sb3_progpolicy.interaction import VecInteractionHistory, program_names
from sb3_progpolicy.policies import ProgrammaticActorCritic
from sb3_progpolicy.programs.program import Program


def holds_program(model: BaseAlgorithm) -> bool:
    """Return whether a model's policy is a program (``ProgPolicy`` or ``PRLPolicy``)."""
    return isinstance(model.policy, ProgrammaticActorCritic)


def extract_program(model: BaseAlgorithm, **metadata: Any) -> Program:
    """Return the most likely program of a model as plain data, its inputs and outputs named by the environment.

    :param model: of any algorithm, with the policy ``ProgPolicy`` or ``PRLPolicy``
    :param metadata: JSON values to keep with it; environment id, seed and number of steps are put in
    :raises TypeError: if the policy is not a program
    """
    policy, env = model.policy, model.get_env()
    if not isinstance(policy, ProgrammaticActorCritic):
        raise TypeError(f"{type(policy).__name__} is not a program; ProgPolicy and PRLPolicy are")
    # ReptilePPO knows these without its environment too.
    inputs, outputs = getattr(model, "input_names", None), getattr(model, "output_names", None)
    env_id, interaction = getattr(model, "env_id", None), getattr(model, "interaction_history", False)
    if env is not None:
        inputs, outputs = (inputs, outputs) if inputs else program_names(env)
        env_id, interaction = env_id or env_id_of(env), is_vecenv_wrapped(env, VecInteractionHistory)
    origin = {"env": env_id, "seed": model.seed, "timesteps": model.num_timesteps}
    # A saved model's tuples are loaded as lists.
    return policy.program(tuple(inputs or ()), tuple(outputs or ()), interaction, **{**origin, **metadata})


def env_id_of(env: Any) -> str | None:
    """Return the id under which an environment, or every one of a ``VecEnv``, was made; ``None`` if it has none.

    :param env: an environment, a ``VecEnv`` or ``None``
    """
    if isinstance(env, VecEnv):
        spec = env.get_attr("spec")[0] if env.has_attr("spec") else None
    else:
        spec = getattr(env, "spec", None)
    return None if spec is None else spec.id
