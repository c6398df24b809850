"""What the file of a model holds besides tensors, and what it may give for each of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_progpolicy.programs.program import LEARNED_BY

Check = Callable[[Any], bool]


def _number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _limit(value: Any) -> bool:
    return _number(value) or (type(value) is float and value == math.inf)


def _count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**53


def _flag(value: Any) -> bool:
    return type(value) is bool


def _text(value: Any) -> bool:
    return type(value) is str


def _schedule(value: Any) -> bool:
    return _number(value) or type(value) in (LinearSchedule, ConstantSchedule, FloatSchedule)


def _mapping(value: Any) -> bool:
    return type(value) is dict


def _space(value: Any) -> bool:
    return isinstance(value, spaces.Space)


def _optional(check: Check) -> Check:
    return lambda value: value is None or check(value)


def _all(check: Check) -> Check:
    return lambda value: isinstance(value, (list, tuple)) and all(check(item) for item in value)


#: The constructor's arguments, and what a file may give for them.
ARGUMENTS: Mapping[str, Check] = {
    "policy": _text,
    "learning_rate": _schedule,
    "n_steps": _count,
    "batch_size": _count,
    "n_epochs": _count,
    "gamma": _number,
    "gae_lambda": _number,
    "clip_range": _schedule,
    "clip_range_vf": _optional(_schedule),
    "normalize_advantage": _flag,
    "ent_coef": _number,
    "vf_coef": _number,
    "max_grad_norm": _limit,
    "target_kl": _optional(_limit),
    "tasks": _mapping,
    "env_kwargs": _mapping,
    "max_episode_steps": _optional(_count),
    "inner_updates": _count,
    "tasks_per_iteration": _count,
    "meta_batch_size": _count,
    "engine": _text,
    "meta_learning_rate": _schedule,
    "meta_optimizer": _text,
    "meta_update": _flag,
    "search_method": _text,
    "search_fraction": _number,
    "growth_iterations": _count,
    "length_coef": _number,
    "temperature": _optional(_schedule),
    "action_temperature": _optional(_schedule),
    "action_std": _optional(_schedule),
    "symmetric": _flag,
    "interaction_history": _flag,
    "normalize_observations": _flag,
    "ignore": _all(_text),
    "scale_rewards": _flag,
    "timeouts": _text,
    "stats_window_size": _count,
    "tensorboard_log": _optional(_text),
    "policy_kwargs": _mapping,
    "verbose": _count,
    "seed": _optional(_count),
}
#: The state of a training besides tensors, and what a file may give for it.
STATE: Mapping[str, Check] = {
    "env_id": _optional(_text),
    "n_envs": _count,
    "observation_space": _space,
    "action_space": _space,
    "input_names": _optional(_all(_text)),
    "output_names": _optional(_all(_text)),
    "wrappers": _all(_text),
    "learned_by": lambda value: value in LEARNED_BY,
    "num_timesteps": _count,
    "total_timesteps": _count,
    "progress_remaining": _number,
    "n_updates": _count,
    "meta_iteration": _count,
    "rng": _mapping,
    "reward_statistics": _optional(_all(_number)),
    "episodes": _optional(_all(_all(_number))),
    "growth": _optional(_mapping),
    "successes": _optional(_all(lambda value: _flag(value) or _number(value))),
}
