"""From a model to its program, whatever algorithm trained it."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

from sb3_progpolicy.interaction import VecInteractionHistory, appends_history, program_names, reads_scaled_rewards
from sb3_progpolicy.policies import ProgrammaticActorCritic
from sb3_progpolicy.programs.program import LEARNED_BY, Program
from sb3_progpolicy.programs.transform import fold_normalization

# Wrappers of which a program knows what they do, or that do nothing to what it sees.
_KNOWN = (VecMonitor, VecInteractionHistory, VecNormalize, VecCheckNan, VecVideoRecorder)
_HARMLESS = {"Monitor", "RecordEpisodeStatistics", "RecordVideo", "HumanRendering", "RenderCollection", "TimeLimit"}
_HARMLESS |= {"OrderEnforcing", "PassiveEnvChecker", "InteractionHistory", "RemakeOnVariation", "RepeatOptions"}


def holds_program(model: BaseAlgorithm) -> bool:
    """Return whether a model's policy is a program (``ProgPolicy`` or ``PRLPolicy``) that can be taken out of it.

    It cannot where the policy resets the conditions' states when an episode starts, which a program does not do.
    """
    return isinstance(model.policy, ProgrammaticActorCritic) and not _resets_states(model.policy)


def _resets_states(policy: ProgrammaticActorCritic) -> bool:
    return policy.reset_state_at_episode_start and policy.module.conditions.recurrent


def extract_program(model: BaseAlgorithm, **metadata: Any) -> Program:
    """Return the most likely program of a model as plain data, its inputs and outputs named by the environment.

    It reads what the environment gives. What ``VecNormalize`` does to observations is folded into it, which is exact as
    long as ``clip_obs`` is not reached. Other wrappers are named in ``metadata["wrappers"]``, and
    the variations that it was trained on in ``metadata["trained_on"]``, the symmetry that ties the weights in
    ``metadata["symmetry"]``, and the conditions that were tried in ``metadata["growth"]``, where the search was by
    growth.

    :param model: of any algorithm, with the policy ``ProgPolicy`` or ``PRLPolicy``
    :param metadata: JSON values to keep with it; environment id, seed, number of steps and way of
        learning are put in
    :raises TypeError: if the policy is not a program
    :raises ValueError: if the policy reads rewards that ``VecNormalize`` has scaled, or resets its conditions' states
        when an episode starts
    """
    policy, env = model.policy, model.get_env()
    if not isinstance(policy, ProgrammaticActorCritic):
        raise TypeError(f"{type(policy).__name__} is not a program; ProgPolicy and PRLPolicy are")
    if _resets_states(policy):
        raise ValueError(
            "a policy with reset_state_at_episode_start=True cannot be extracted; a program is not told that an "
            "episode starts, and would remember what the policy forgets. Train with False, or without conditions that "
            "remember (cell='affine')"
        )
    # ReptilePPO knows these without its environment too.
    inputs, outputs = getattr(model, "input_names", None), getattr(model, "output_names", None)
    env_id, interaction = getattr(model, "env_id", None), getattr(model, "interaction_history", False)
    wrappers = getattr(model, "wrappers", ())
    if env is not None:
        inputs, outputs = (inputs, outputs) if inputs else program_names(env)
        env_id, interaction, wrappers = env_id or env_id_of(env), appends_history(env), wrappers_of(env)
    origin = {"env": env_id, "seed": model.seed, "timesteps": model.num_timesteps}
    if env_kwargs := _plain(getattr(model, "env_kwargs", {})):
        origin["env_kwargs"] = env_kwargs
    variations = getattr(getattr(model, "tasks", None), "variations", ())
    if any(variations) and (plain := _plain(variations)):
        origin["trained_on"] = plain
    origin["learned_by"] = getattr(model, "learned_by", LEARNED_BY[0])
    if policy.module.group is not None:
        origin["symmetry"] = policy.module.group.members[0].name
    growth = getattr(model, "growth", None)
    if growth is not None:
        origin["growth"] = growth.trials
    if wrappers:
        origin["wrappers"] = list(wrappers)
    # A saved model's tuples are loaded as lists.
    program = policy.program(tuple(inputs or ()), tuple(outputs or ()), interaction, **{**origin, **metadata})
    normalizer = model.get_vec_normalize_env()
    if normalizer is None:
        return program
    if program.interaction and env is not None and reads_scaled_rewards(env):
        raise ValueError(
            "a program that reads its previous reward cannot be trained on rewards that VecNormalize scales: run alone "
            "it would read others. Give VecNormalize norm_reward=False, or put it around VecInteractionHistory, which "
            "then reads rewards as they are; ReptilePPO has scale_rewards=True"
        )
    return _fold(program, normalizer)


def _plain(values: Any) -> Any:
    """Return what JSON can hold; ``None`` if a part is of another kind."""
    try:
        return json.loads(json.dumps(values, allow_nan=False))
    except (TypeError, ValueError):
        return None


def _fold(program: Program, normalizer: VecNormalize) -> Program:
    mean, scale = np.zeros(program.n_inputs), np.ones(program.n_inputs)
    if normalizer.norm_obs:
        statistics: Any = normalizer.obs_rms
        n_observations = len(statistics.mean)
        mean[:n_observations] = statistics.mean
        scale[:n_observations] = 1 / np.sqrt(statistics.var + normalizer.epsilon)
    return fold_normalization(program, mean, scale)


def wrappers_of(env: VecEnv) -> tuple[str, ...]:
    """Return the names of the wrappers that change what a policy sees, and that an id alone does not bring back.

    :param env: the environments of a model; ``VecNormalize`` is not named, its statistics are known
    """
    names = []
    while isinstance(env, VecEnvWrapper):
        if not isinstance(env, _KNOWN):
            names.append(type(env).__name__)
        env = env.venv
    spec = env.get_attr("spec")[0] if env.has_attr("spec") else None
    if spec is not None:
        registered = gym.registry[spec.id].additional_wrappers if spec.id in gym.registry else ()
        expected = _HARMLESS | {wrapper.name for wrapper in registered}
        names += [wrapper.name for wrapper in spec.additional_wrappers if wrapper.name not in expected]
    return tuple(names)


def env_id_of(env: Any) -> str | None:
    """Return the id under which an environment, or every one of a ``VecEnv``, was made; ``None`` if it has none.

    :param env: an environment, a ``VecEnv`` or ``None``
    """
    if isinstance(env, VecEnv):
        spec = env.get_attr("spec")[0] if env.has_attr("spec") else None
    else:
        spec = getattr(env, "spec", None)
    return None if spec is None else spec.id
