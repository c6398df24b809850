"""The environments of ReptilePPO: made from an id, and with the interaction history appended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, is_vecenv_wrapped

from progpolicy_envs import find_domain
from progpolicy_envs.symmetry import Symmetry
from sb3_progpolicy.interaction import InteractionHistory, VecInteractionHistory, reads_scaled_rewards
from sb3_progpolicy.reptile.tasks import RemakeOnVariation
from sb3_progpolicy.symmetries import as_data
from sb3_progpolicy.vec_env import make_fast_vec_env

DEFAULT_N_ENVS = 32


def make_venv(
    env: GymEnv | str, n_envs: int | None, seed: int | None, env_kwargs: Mapping[str, Any], remade: bool = False
) -> VecEnv:
    """Return the environments of an id in their fastest form, or those given as a ``VecEnv``.

    :param env: an id, an environment or a ``VecEnv``
    :param n_envs: how many to make of an id; :data:`DEFAULT_N_ENVS` by default
    :param seed: of the environments of an id
    :param env_kwargs: constructor arguments for an id
    :param remade: whether each of an id's is to be made anew for a variation, in :class:`RemakeOnVariation`
    :raises ValueError: for ``n_envs`` or ``env_kwargs`` with an environment that is made already
    """
    if isinstance(env, str):
        number = DEFAULT_N_ENVS if n_envs is None else n_envs
        if remade:
            return make_vec_env(partial(RemakeOnVariation, env, **env_kwargs), number, seed)
        return make_fast_vec_env(env, number, seed, **env_kwargs)
    if n_envs is not None or env_kwargs:
        raise ValueError(
            "n_envs, env_kwargs and max_episode_steps are for environment ids; the environment given is already made"
        )
    return PPO._wrap_env(env)


def with_limit(env_kwargs: Mapping[str, Any], max_episode_steps: int | None) -> dict[str, Any]:
    """Return constructor arguments with a limit of steps.

    :param env_kwargs: without
    :param max_episode_steps: at least 1; ``None`` for the one that is registered
    :raises ValueError: if it is not accepted
    """
    if max_episode_steps is None:
        return dict(env_kwargs)
    if isinstance(max_episode_steps, bool) or not isinstance(max_episode_steps, int) or max_episode_steps < 1:
        raise ValueError(f"max_episode_steps={max_episode_steps!r} is not accepted; it is at least 1, or None")
    return {**env_kwargs, "max_episode_steps": max_episode_steps}


def with_history(venv: VecEnv, interaction_history: bool, learns_program: bool = False) -> VecEnv:
    """Append the interaction history, if asked for and not there yet.

    :param venv: environments
    :param interaction_history: whether the policy reads it
    :param learns_program: whether the policy is a program, which is run where nothing scales rewards
    :raises ValueError: if a single environment is wrapped in :class:`InteractionHistory`, or it would show
        rewards that are scaled
    """
    if interaction_history and any(venv.env_is_wrapped(InteractionHistory)):
        raise ValueError(
            "an environment wrapped in InteractionHistory is not accepted; ReptilePPO appends the history itself. "
            "Give it the environment without the wrapper, or interaction_history=False"
        )
    joined = venv
    if interaction_history and not is_vecenv_wrapped(venv, VecInteractionHistory):
        joined = VecInteractionHistory(venv)
    if interaction_history and learns_program and reads_scaled_rewards(joined):
        raise ValueError(
            "VecNormalize with norm_reward=True is not accepted for a program that reads its previous reward: nothing "
            "outside of training scales it. Give VecNormalize norm_reward=False, or put it around "
            "VecInteractionHistory; scale_rewards=True scales what is learnt from"
        )
    return joined


def symmetries_of(env_id: str | None, venv: VecEnv | None) -> list[dict[str, Any]]:
    """Return the symmetries that an environment declares, as plain data.

    :param env_id: id of the environment, where it is known
    :param venv: the environments; asked for an attribute ``symmetries`` where the id is no domain's
    :raises ValueError: if it declares none
    """
    domain = find_domain(env_id)
    declared: Sequence[Symmetry] = () if domain is None else domain.symmetries
    if not declared and venv is not None and venv.has_attr("symmetries"):
        declared = venv.get_attr("symmetries")[0]
    if not declared:
        raise ValueError(f"symmetric=True is not accepted; {env_id or 'the environment'} declares no symmetries")
    return [as_data(symmetry) for symmetry in declared]
