"""From a saved model to a ReptilePPO: its sizes are checked before anything is made of them."""

from __future__ import annotations

import copy
import io
import os
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces

from sb3_progpolicy.bounds import MAX_ENVS, MAX_ROLLOUT
from sb3_progpolicy.env_ids import same_env
from sb3_progpolicy.reptile.samplers import SAMPLERS
from sb3_progpolicy.reptile.steps import META_OPTIMIZERS
from sb3_progpolicy.reptile.tasks import TaskDistribution
from sb3_progpolicy.reptile_ppo.environments import make_venv, with_history
from sb3_progpolicy.reptile_ppo.fields import ARGUMENTS, STATE
from sb3_progpolicy.reptile_ppo.saving import (
    ARM,
    OPTIMIZERS,
    ROLLOUT,
    SavedModel,
    is_sb3_file,
    read_model,
)
from sb3_progpolicy.reptile_ppo.values import ModelFormatError

if TYPE_CHECKING:
    from sb3_progpolicy.reptile_ppo.algorithm import ReptilePPO

#: What loading cannot change, because parameters or statistics depend on it.
FIXED = (
    *("policy", "policy_kwargs", "meta_optimizer"),
    *("interaction_history", "normalize_observations", "ignore", "scale_rewards", "symmetric", "search_method"),
)
#: What else loading can change; the number of environments is among the state, the sampler is that of the tasks.
_NOT_STORED = ("n_envs", "sampler")
#: Tensors of a policy that came later: files without them mean what a new policy has.
_LATER = ("module.action_temperature",)
MAX_PARAMETERS = 10**7
# What constructors raise for values of the right type that they cannot take.
_REFUSALS = (TypeError, AttributeError, AssertionError, ArithmeticError, LookupError, RuntimeError, MemoryError)


def load_model(
    cls: type[Any],
    path: str | os.PathLike[str] | io.BufferedIOBase,
    env: GymEnv | str | None,
    device: th.device | str,
    custom_objects: Mapping[str, Any],
    force_reset: bool,
    allow_pickle: bool,
    changes: Mapping[str, Any],
) -> Any:
    """Make a model of a file. See ``ReptilePPO.load`` for the arguments.

    :param cls: ReptilePPO
    :param changes: constructor arguments that replace those of the file
    :raises ModelFormatError: if the file is damaged or holds what is not accepted
    :raises ValueError: if the file holds pickles, the environment does not fit, or something cannot be changed
    """
    if is_sb3_file(path):
        if not allow_pickle:
            raise ValueError(
                f"{path} is a zip of pickles, as release 0.1 and Stable-Baselines3 write it, and loading one runs the "
                "code in it. If you trust where it comes from, load it with allow_pickle=True and save it again"
            )
        return _load_pickles(cls, path, env, device, custom_objects, force_reset, changes)
    changes = {**{name: value for name, value in custom_objects.items() if name in ARGUMENTS}, **changes}
    if unknown := sorted(set(changes) - set(ARGUMENTS) - set(_NOT_STORED)):
        raise ValueError(f"{unknown[0]}= is not accepted; accepted: {', '.join((*ARGUMENTS, *_NOT_STORED))}")
    saved = read_model(path, allow_pickle, {*changes, *custom_objects})
    saved.state.update({name: value for name, value in custom_objects.items() if name in saved.state})
    for name in FIXED:
        if name in changes and name in saved.arguments and changes[name] != saved.arguments[name]:
            raise ValueError(
                f"{name}={changes[name]!r} is not accepted; the model was trained with {saved.arguments[name]!r}, "
                "which loading cannot change"
            )
    try:
        _check_sizes(saved)
        model = _make(cls, saved, env, device, changes)
        _restore_state(model, saved.state)
        model.set_parameters(checked_parameters(model, saved), device=device)
        if model.growth is not None and saved.state.get("growth") is not None:
            arm = checked_parameters(model, saved, ARM) if saved.state["growth"]["trial_is_open"] else None
            model.growth.restore(saved.state["growth"], arm, model)
    except _REFUSALS as error:
        raise ModelFormatError(f"{path}: no model can be made of it ({type(error).__name__}: {error})") from error
    if env is None or not force_reset:
        _restore_rollout(model, saved.under("rollout"))
    return model


def _load_pickles(
    cls: type[ReptilePPO],
    path: Any,
    env: GymEnv | str | None,
    device: th.device | str,
    custom_objects: Mapping[str, Any],
    force_reset: bool,
    changes: Mapping[str, Any],
) -> Any:
    """Load what release 0.1 saved."""
    changes = dict(changes)
    n_envs, env_kwargs = changes.pop("n_envs", None), dict(changes.pop("env_kwargs", None) or {})
    if env is not None:
        data, _, _ = load_from_zip_file(path, device=device, custom_objects=dict(custom_objects))
        assert data is not None
        if isinstance(env, str) and n_envs is None:
            n_envs = data["n_envs"]
        env = with_history(make_venv(env, n_envs, data["seed"], env_kwargs), data["interaction_history"])
    load = PPO.load.__func__  # type: ignore[attr-defined]
    model = load(cls, path, env, device, dict(custom_objects), False, force_reset, **changes)
    model.policy.reset_state_at_episode_start = False  # had no effect
    model.env_kwargs = env_kwargs
    return model


def _check_sizes(saved: SavedModel) -> None:
    """Refuse sizes that the tensors of the file do not bear out, before memory is taken for them."""
    arguments, state = saved.arguments, saved.state
    if missing := {"n_envs", "observation_space", "action_space"} - set(state):
        raise ModelFormatError(f"state: {', '.join(sorted(missing))} missing")
    flat = [spaces.flatdim(state[name]) for name in ("observation_space", "action_space")]
    if not 1 <= state["n_envs"] <= MAX_ENVS:
        raise ModelFormatError(f"n_envs={state['n_envs']} is not accepted; it is from 1 to {MAX_ENVS}")
    if (size := arguments.get("n_steps", 1) * state["n_envs"] * (sum(flat) + 6)) > MAX_ROLLOUT:
        raise ModelFormatError(f"a rollout of {size} numbers is not accepted; at most {MAX_ROLLOUT}")
    # No policy has more parameters than layers times their two largest sizes.
    policy_kwargs = arguments.get("policy_kwargs") or {}
    shape = {name: value for name, value in policy_kwargs.items() if name not in ("symmetries", "optimizer_kwargs")}
    sizes = sorted([*flat, *_whole_numbers(shape)])
    held = sum(tensor.size for tensor in saved.under("policy").values())
    if len(sizes) * sizes[-1] * sizes[-2] > max(MAX_PARAMETERS, 8 * held):
        raise ModelFormatError(f"layers of up to {sizes[-1]} units are not accepted; the file has {held} parameters")


def _whole_numbers(value: Any) -> list[int]:
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, (list, tuple)):
        return [number for item in value for number in _whole_numbers(item)]
    return [value] if type(value) is int else []


def _make(
    cls: type[ReptilePPO],
    saved: SavedModel,
    env: GymEnv | str | None,
    device: th.device | str,
    changes: Mapping[str, Any],
) -> ReptilePPO:
    """Make the model, in the environments given or without any."""
    arguments, state = {**saved.arguments, **changes}, saved.state
    if (arguments.get("policy_kwargs") or {}).get("reset_state_at_episode_start") and "policy_kwargs" not in changes:
        # Accepted once, without an effect: states were not reset.
        arguments["policy_kwargs"] = {**arguments["policy_kwargs"], "reset_state_at_episode_start": False}
    if isinstance(arguments.get("tasks"), dict) and "tasks" not in changes:
        arguments["tasks"] = _tasks(arguments["tasks"])
    if isinstance(env, str):
        arguments.setdefault("n_envs", state["n_envs"])
        if not same_env(env, state.get("env_id")):
            arguments["env_kwargs"] = changes.get("env_kwargs")  # those saved are another environment's
    elif env is not None:
        for name in {"env_kwargs", "max_episode_steps"} - set(changes):
            arguments.pop(name, None)
    model = cls(env=env, device=device, _init_setup_model=False, **arguments)
    if env is None:
        model.observation_space, model.action_space = state["observation_space"], state["action_space"]
        model.n_envs, model.env_id = changes.get("n_envs", state["n_envs"]), state.get("env_id")
    else:
        assert model.env is not None
        if "VecNormalize" in state.get("wrappers", ()) and model.get_vec_normalize_env() is None:
            raise ValueError(
                "env is not accepted without VecNormalize: the model was trained with it, and the file does not hold "
                "its statistics. Give VecNormalize.load(file, env), with the file that VecNormalize.save has written"
            )
        check_for_correct_spaces(model.env, state["observation_space"], state["action_space"])
    model._setup_model()
    return model


def _tasks(data: Mapping[str, Any]) -> TaskDistribution:
    if data["sampler"] not in SAMPLERS:
        raise ModelFormatError(f"sampler={data['sampler']!r:.40} is not accepted; known: {', '.join(SAMPLERS)}")
    sampler = SAMPLERS[data["sampler"]](**data["sampler_arguments"])
    tasks = TaskDistribution(data["variations"], sampler, data["apply"], data.get("check", True))
    tasks.success_rates = _means("success_rates", data["success_rates"], len(tasks))
    if "scores" in data:  # files of before there were any lack them
        tasks.scores = np.array([_means("scores", means, len(tasks)) for means in data["scores"]])
        if tasks.scores.shape != (2, len(tasks)):
            raise ModelFormatError(f"scores: {len(data['scores'])} rows given; 2 are expected")
    return tasks


def _means(name: str, given: Any, n_variations: int) -> NDArray[np.float64]:
    means = np.array([np.nan if mean is None else float(mean) for mean in given], dtype=np.float64)
    if len(means) != n_variations or np.isinf(means).any():
        raise ModelFormatError(f"{name}: {len(means)} finite numbers or null expected for {n_variations} variations")
    return means


def _restore_state(model: ReptilePPO, state: Mapping[str, Any]) -> None:
    model.wrappers = tuple(state.get("wrappers", ()))
    model.learned_by = state.get("learned_by", model.learned_by)
    model.input_names, model.output_names = (
        names and tuple(names) for names in (state.get("input_names"), state.get("output_names"))
    )
    model.num_timesteps, model._total_timesteps = state.get("num_timesteps", 0), state.get("total_timesteps", 0)
    model._current_progress_remaining = state.get("progress_remaining", 1.0)
    model._n_updates, model.meta_iteration = state.get("n_updates", 0), state.get("meta_iteration", 0)
    if "rng" in state:
        model.rng.bit_generator.state = state["rng"]
    if model.reward_scaler is not None and state.get("reward_statistics") is not None:
        model.reward_scaler.restore(state["reward_statistics"])
    window = model._stats_window_size
    if state.get("episodes") is not None:
        model.ep_info_buffer = deque((dict(zip("rlt", e, strict=True)) for e in state["episodes"]), maxlen=window)
    if state.get("successes") is not None:
        model.ep_success_buffer = deque(state["successes"], maxlen=window)


def parameters_of(model: Any, path_or_parameters: Any) -> Any:
    """Return what ``set_parameters`` is given as SB3 takes it: a path, or parameters, which may be of release 0.1."""
    if not isinstance(path_or_parameters, dict):
        if is_sb3_file(path_or_parameters):
            return path_or_parameters
        return checked_parameters(model, read_model(path_or_parameters, replaced=(*ARGUMENTS, *STATE)))
    renamed = dict(path_or_parameters)
    if "reptile.meta_optimizer" in renamed:
        renamed["outer_optimizer"] = renamed.pop("reptile.meta_optimizer")
    return renamed


def checked_parameters(model: ReptilePPO, saved: SavedModel, owner: str = "") -> dict[str, Any]:
    """Return the parameters and optimizers of a file, in the form of ``set_parameters``.

    :param model: which they are for
    :param saved: the file
    :param owner: ``""`` for the model's own, :data:`ARM` for those of the program that growth is trying
    :raises ModelFormatError: if they do not fit, or are not finite
    """
    policy, expected_policy = saved.under(f"{owner}policy"), model.policy.state_dict()
    absent = {name: expected_policy[name].cpu().numpy() for name in _LATER if name in expected_policy}
    policy = {**{name: array for name, array in absent.items() if name not in policy}, **policy}
    _check_tensors("policy", policy, expected_policy)
    parameters: dict[str, Any] = {"policy": _to_torch(policy)}
    outer = META_OPTIMIZERS[model.meta_optimizer](model.policy.parameters(), lr=1.0)  # type: ignore[call-arg]
    for name, optimizer in zip(OPTIMIZERS, (model.policy.optimizer, outer), strict=True):
        groups = saved.optimizers.get(f"{owner}{name}")
        if groups == [] and name == "outer_optimizer":  # before the first meta-step
            parameters[name] = {}
            continue
        expected = _after_a_step(optimizer)
        _check_groups(name, groups, expected["param_groups"])
        moments: dict[int, Any] = {}
        for key, tensor in saved.under(f"{owner}{name}").items():
            index, _, of = key.partition("/")
            moments.setdefault(int(index), {})[of] = tensor
        for number, tensors in moments.items():
            _check_tensors(f"{name}: parameter {number}", tensors, expected["state"][number])
        state = {number: _to_torch(tensors) for number, tensors in moments.items()}
        parameters[name] = {"state": state, "param_groups": groups}
    owners = (*("policy", *OPTIMIZERS, "rollout"), *(ARM + name for name in ("policy", *OPTIMIZERS)))
    known = sum(len(saved.under(name)) for name in owners)
    if known != len(saved.tensors):
        raise ModelFormatError(f"{len(saved.tensors) - known} unknown tensors")
    return parameters


def _to_torch(arrays: Mapping[str, NDArray[Any]]) -> dict[str, th.Tensor]:
    return {name: th.from_numpy(array.copy()) for name, array in arrays.items()}


def _check_tensors(what: str, arrays: Mapping[str, NDArray[Any]], expected: Mapping[str, th.Tensor]) -> None:
    """Raise ``ModelFormatError`` unless arrays have the names, shapes and dtypes expected, and are finite."""
    if different := sorted(set(arrays) ^ set(expected)):
        raise ModelFormatError(f"{what}: {', '.join(different)[:200]} missing or unknown")
    for name, array in arrays.items():
        given, right = (str(array.dtype), array.shape), (str(expected[name].dtype)[6:], tuple(expected[name].shape))
        if given != right:
            raise ModelFormatError(f"{what}: {name} is {given}; {right} is expected")
        if not np.isfinite(array).all():
            raise ModelFormatError(f"{what}: {name} holds numbers that are not finite")


def _after_a_step(optimizer: th.optim.Optimizer) -> dict[str, Any]:
    """Return what an optimizer's state would be after a step, to compare the file's with."""
    probe = copy.deepcopy(optimizer)
    for group in probe.param_groups:
        for parameter in group["params"]:
            parameter.grad = th.zeros_like(parameter)
    probe.step()
    return probe.state_dict()


def _check_groups(what: str, groups: Any, expected: list[dict[str, Any]]) -> None:
    """Raise ``ModelFormatError`` unless an optimizer's settings have the names and types expected."""
    if not isinstance(groups, list) or [_form(group) for group in groups] != [_form(group) for group in expected]:
        raise ModelFormatError(f"{what}: the settings are not those of the optimizer")
    if [group["params"] for group in groups] != [group["params"] for group in expected]:
        raise ModelFormatError(f"{what}: the settings are of other parameters")


def _form(value: Any) -> Any:
    """What of a value has to be the same: all but finite numbers."""
    if isinstance(value, dict):
        return {name: _form(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_form(item) for item in value]
    return "number" if type(value) in (int, float) and np.isfinite(value) else value


def _restore_rollout(model: ReptilePPO, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Take over the last observations, for a model that goes on in the environments it was trained in."""
    shapes = ((model.n_envs, *(model.observation_space.shape or ())), (model.n_envs,))
    if set(arrays) == set(ROLLOUT) and tuple(arrays[name].shape for name in ROLLOUT) == shapes:
        model._last_obs, model._last_episode_starts = (arrays[name].copy() for name in ROLLOUT)
