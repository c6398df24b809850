"""The constructor's arguments, checked before anything is made of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sb3_progpolicy.bounds import check_number, check_whole
from sb3_progpolicy.reptile.callback import check_reptile_arguments
from sb3_progpolicy.reptile_ppo.growth import check_search_arguments
from sb3_progpolicy.reptile_ppo.inner_loops import check_batch_arguments

_WHOLE = {"n_steps": 1, "n_epochs": 1, "stats_window_size": 1}
_OPTIONAL_WHOLE = {"n_envs": 1, "batch_size": 1, "seed": 0}
_NUMBERS = ("gamma", "gae_lambda", "ent_coef", "vf_coef", "length_coef")
_LIMITS = ("max_grad_norm", "target_kl")  # infinite ones limit nothing
_SCHEDULES = (
    *("learning_rate", "clip_range", "clip_range_vf", "meta_learning_rate"),
    *("temperature", "action_temperature", "action_std"),
)
_FLAGS = ("normalize_advantage", "meta_update", "symmetric", "interaction_history", "scale_rewards")


def check_arguments(given: Mapping[str, Any]) -> None:
    """Check what ``ReptilePPO`` was given.

    :param given: arguments by name
    :raises ValueError: if one is not accepted, or has no effect beside the others
    """
    check_reptile_arguments(given["inner_updates"], given["tasks_per_iteration"])
    check_batch_arguments(given["meta_batch_size"], given["engine"])
    check_search_arguments(given["search_method"], given["search_fraction"], given["growth_iterations"])
    for name, least in _WHOLE.items():
        check_whole(name, given[name], least)
    check_whole("verbose", int(given["verbose"]), 0)  # a flag will do
    for name, least in _OPTIONAL_WHOLE.items():
        if given[name] is not None:
            check_whole(name, given[name], least)
    for name in _NUMBERS:
        check_number(name, given[name])
    for name in _LIMITS:
        if given[name] is not None:
            check_number(name, given[name], may_be_infinite=True)
    for name in _SCHEDULES:
        _check_schedule(name, given[name])
    for name in _FLAGS:
        if not isinstance(given[name], bool):
            raise ValueError(f"{name}={given[name]!r} is not accepted; it is True or False")
    ignore = given["ignore"]
    if isinstance(ignore, str) or not all(isinstance(name, str) for name in ignore):
        raise ValueError(f"ignore={ignore!r} is not accepted; it is a sequence of names of inputs, such as ('left',)")
    if given["max_episode_steps"] is not None and "max_episode_steps" in (given["env_kwargs"] or {}):
        raise ValueError("max_episode_steps is given twice, as an argument and in env_kwargs; give one of them")


def _check_schedule(name: str, value: Any) -> None:
    if value is None or callable(value):
        return
    if isinstance(value, str):
        raise ValueError(
            f"{name}={value!r} is not accepted; it is a number or a schedule, such as SB3's "
            "LinearSchedule(1.0, 0.1, 1.0)"
        )
    check_number(name, value)


def whole_timesteps(total_timesteps: float) -> int:
    """Return a number of steps that may be written as 1e5.

    :param total_timesteps: given
    :raises ValueError: if it is not whole
    """
    check_number("total_timesteps", total_timesteps)
    if total_timesteps != int(total_timesteps):
        raise ValueError(f"total_timesteps={total_timesteps} is not accepted; it is a whole number")
    return int(total_timesteps)
