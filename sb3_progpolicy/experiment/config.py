"""What decides the outcome of a run: method, environment, seed and hyperparameters, all of them checked."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, get_args

import torch as th
from stable_baselines3.common.utils import LinearSchedule

from sb3_progpolicy.bounds import BOUNDS, MAX_ROLLOUT, limits_of
from sb3_progpolicy.env_ids import creator_of
from sb3_progpolicy.experiment.methods import METHODS, get_method
from sb3_progpolicy.hyperparams import load_hyperparams, parse_kwargs, parse_number, parse_numbers, shortened
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.policy_arguments import check_policy_kwargs
from sb3_progpolicy.reptile.callback import ReptileWrapper
from sb3_progpolicy.reptile.samplers import make_sampler
from sb3_progpolicy.reptile_ppo.environments import DEFAULT_N_ENVS
from sb3_progpolicy.reptile_ppo.sequence_ppo import Timeouts

#: Hyperparameters of ReptileWrapper, which a stock algorithm is trained with if any of them is given.
REPTILE = (
    "tasks",
    "sampler",
    "inner_updates",
    "tasks_per_iteration",
    "meta_learning_rate",
    "meta_optimizer",
    "meta_update",
)
#: Largest seed.
MAX_SEED = 2**32 - 1
_SCHEDULES = (
    "learning_rate",
    "clip_range",
    "clip_range_vf",
    "meta_learning_rate",
    "temperature",
    "action_std",
    "action_temperature",
)
# Arguments of the constructors that have a flag of their own or no place in a file.
_ELSEWHERE = {"self", "env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"}
_ELSEWHERE |= {f"{kind}_buffer_{part}" for kind in ("rollout", "replay") for part in ("class", "kwargs")} | {
    "action_noise"
}
# What SB3 counts between two updates.
_UNITS = ("step", "episode")
# Texts of which there are few.
_CHOICES = {"timeouts": get_args(Timeouts)}
# Texts that may be numbers, too.
_TEXT_OR_NUMBER = ("ent_coef", "target_entropy", "goal_scale")


@dataclass(frozen=True)
class RunConfig:
    """All that decides the outcome of a run; written to its folder.

    :param algo: a key of :data:`~sb3_progpolicy.experiment.methods.METHODS`
    :param env: environment id
    :param seed: of everything random
    :param env_kwargs: constructor arguments of the environment
    :param hyperparams: ``policy``, ``n_timesteps``, ``n_envs`` and the algorithm's arguments, as in the YAML files
    :param device: torch device
    """

    algo: str
    env: str
    seed: int
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    hyperparams: Mapping[str, Any] = field(default_factory=dict)
    device: str = "auto"

    @property
    def n_timesteps(self) -> int:
        """Environment steps of the whole training."""
        return int(self.hyperparams["n_timesteps"])


def make_config(
    algo: str,
    env_id: str,
    seed: int,
    n_timesteps: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
    device: str = "auto",
) -> RunConfig:
    """Read the hyperparameters of an algorithm for an environment, put in what overrides them, and check all of it.

    :param algo: a key of :data:`~sb3_progpolicy.experiment.methods.METHODS`
    :param env_id: a registered environment id
    :param seed: of everything random
    :param n_timesteps: in place of the file's
    :param env_kwargs: constructor arguments of the environment
    :param overrides: hyperparameters in place of the file's
    :param device: torch device
    :raises ValueError: if a name or a value is not accepted; the message names the nearest names
    """
    method = get_method(algo)
    hyperparams = {**load_hyperparams(method.name, env_id), **(overrides or {})}
    if n_timesteps is not None:
        hyperparams["n_timesteps"] = n_timesteps
    env_kwargs = {**parse_kwargs("env_kwargs", hyperparams.pop("env_kwargs", None)), **(env_kwargs or {})}
    config = check_config(RunConfig(algo, env_id, seed, env_kwargs, hyperparams, device))
    check_surroundings(config)
    return config


def parse_config(described: Any) -> RunConfig:
    """Return the configuration that a run folder describes.

    :param described: what its file holds
    :raises ValueError: if it is not a mapping of the fields of :class:`RunConfig`, or a value is not accepted
    """
    names = [entry.name for entry in fields(RunConfig)]
    if not isinstance(described, Mapping):
        raise ValueError(f"{shortened(described)} is not accepted; it is a mapping of {', '.join(names)}")
    for name in described:
        if name not in names:
            raise unknown("field", name, names)
    for name in ("algo", "env", "seed", "hyperparams"):
        if name not in described:
            raise ValueError(f"{name} is missing")
    return check_config(RunConfig(**described))


def check_config(config: RunConfig) -> RunConfig:
    """Return a configuration with every value as the type it has to be of.

    :param config: with values from a file or the command line
    :raises ValueError: if a name or a value is not accepted; the message names the nearest names
    """
    for name in ("algo", "env", "device"):
        if not isinstance(getattr(config, name), str):
            raise ValueError(f"{name}={shortened(getattr(config, name))} is not accepted; it is a text")
    get_method(config.algo)
    if isinstance(config.seed, bool) or not isinstance(config.seed, int) or not 0 <= config.seed <= MAX_SEED:
        raise ValueError(f"seed={shortened(config.seed)} is not accepted; it is a whole number from 0 to {MAX_SEED}")
    for name in ("env_kwargs", "hyperparams"):
        if not isinstance(getattr(config, name), Mapping):
            raise ValueError(f"{name}={shortened(getattr(config, name))} is not accepted; it is a mapping")
    accepted = _accepted(config.algo)
    for name in config.hyperparams:
        if name not in accepted:
            raise unknown("hyperparameter", name, [*accepted, "env_kwargs"])
    for name in ("policy", "n_timesteps"):
        if name not in config.hyperparams:
            raise ValueError(f"hyperparams: {name} is missing")
    checked = {name: _checked(name, value, accepted[name]) for name, value in config.hyperparams.items()}
    if checked.get("n_envs", 1) * checked.get("n_steps", 1) > MAX_ROLLOUT:
        raise ValueError(f"n_envs times n_steps is more than {MAX_ROLLOUT} transitions, which is not accepted")
    by_episode = isinstance(checked.get("train_freq"), list) and checked["train_freq"][1] == "episode"
    if by_episode and checked.get("n_envs", DEFAULT_N_ENVS) != 1:
        raise ValueError(f"train_freq={checked['train_freq']} is not accepted with several environments; give n_envs=1")
    config = replace(config, hyperparams=checked)
    _check_policy(config)
    return config


def check_surroundings(config: RunConfig) -> None:
    """Check what a configuration can be trained with here: the environment and the device.

    :param config: with checked values
    :raises ValueError: if the environment is not known or does not take its arguments, or the device is not there
    """
    _check_env_kwargs(config.env, config.env_kwargs)
    if config.device == "auto":
        return
    try:
        th.zeros(1, device=config.device).item()
    except Exception as error:  # torch raises an error of its own kind for every kind of device
        reason = str(error).partition("\n")[0]
        raise ValueError(f"device={shortened(config.device)} is not accepted here: {reason}") from None


def _check_env_kwargs(env_id: str, env_kwargs: Mapping[str, Any]) -> None:
    constructor = inspect.signature(creator_of(env_id)).parameters
    if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in constructor.values()):
        return
    for name in env_kwargs:
        if name not in constructor:
            raise unknown("environment argument", name, constructor)


def _accepted(algo: str) -> dict[str, Any]:
    """Return the hyperparameters of an algorithm with their defaults."""
    method = METHODS[algo]
    signature = inspect.signature(method.algorithm.__init__).parameters
    accepted = {name: parameter.default for name, parameter in signature.items() if name not in _ELSEWHERE}
    if not method.has_reptile:
        accepted["interaction_history"] = False
    if method.takes_tasks and not method.has_reptile:
        reptile = inspect.signature(ReptileWrapper.__init__).parameters
        accepted |= {name: reptile[name].default for name in REPTILE if name in reptile}
    accepted.pop("env_kwargs", None)
    return {**accepted, "policy": "", "tasks": None, "sampler": None, "n_envs": DEFAULT_N_ENVS, "n_timesteps": 1}


def _checked(name: str, value: Any, default: Any) -> Any:
    """Return a value as the type of its default, so that a slip is an error here and not deep inside torch."""
    value = parse_numbers(parse_number(value))
    if name == "policy_kwargs":
        return parse_kwargs(name, value)
    if name == "init_program" and value is not None and not isinstance(value, str):
        raise ValueError(f"{name}={shortened(value)} is not accepted; it is a file or the name of a shipped program")
    if name == "sampler" and value is not None:
        make_sampler(value)
        return value
    if value is None and (default is None or name == "batch_size"):
        return None
    if name in _SCHEDULES:
        if isinstance(value, str):
            parse_schedule(name, value)
            return value
        return _number(name, value, "a number, lin_<from> or lin_<from>_<to>")
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise ValueError(f"{name}={shortened(value)} is not accepted; it is true or false")
        return value
    if name == "train_freq" and isinstance(value, (list, tuple)):
        return _frequency(name, value)
    if isinstance(default, int) or name in ("batch_size", "n_envs", "max_episode_steps"):
        number = _number(name, value, "a whole number", (1, math.inf))
        if number != int(number):
            raise ValueError(f"{name}={shortened(value)} is not accepted; it is a whole number")
        return int(number)
    if isinstance(default, float) or name == "target_kl":
        return _number(name, value, "a number")
    if name in _TEXT_OR_NUMBER and isinstance(default, str) and isinstance(value, (int, float)):
        return _number(name, value, "a text or a number")
    if isinstance(default, str) and not isinstance(value, str):
        raise ValueError(f"{name}={shortened(value)} is not accepted; it is a text")
    if name in _CHOICES and value not in _CHOICES[name]:
        raise unknown(name, value, _CHOICES[name])
    return value


def _frequency(name: str, value: Sequence[Any]) -> list[Any]:
    """Return SB3's pair of a number and what is counted."""
    number, unit = value if len(value) == 2 else (None, None)
    if isinstance(number, bool) or not isinstance(number, int) or number < 1 or unit not in _UNITS:
        raise ValueError(
            f"{name}={shortened(value)} is not accepted; it is a whole number of at least 1, or such a number and "
            f"{' or '.join(_UNITS)}, as in [1, episode]"
        )
    return [number, unit]


def _number(name: str, value: Any, accepted: str, bounds: tuple[float, float] = (-math.inf, math.inf)) -> float:
    """Return a finite number within the bounds of its name."""
    low, high = BOUNDS.get(name, bounds)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != value or abs(value) == math.inf:
        raise ValueError(f"{name}={shortened(value)} is not accepted; it is {accepted}")
    if not low <= value <= high:
        limits = limits_of(value, low, high)
        raise ValueError(f"{name}={shortened(value)} is not accepted; it is {accepted} {limits}")
    return value


def parse_schedule(name: str, value: Any) -> Any:
    """Return a text as a linear schedule if the hyperparameter may be one, and anything else as it is.

    The zoo's ``lin_0.001`` falls to 0 at the end of the training; ``lin_0.5_0.1`` goes from the first to the second.
    """
    if name not in _SCHEDULES or not isinstance(value, str):
        return value
    kind, *numbers = value.split("_")
    ends = [parse_number(number) for number in numbers]
    if kind != "lin" or len(ends) not in (1, 2) or not all(isinstance(end, float) for end in ends):
        raise ValueError(f"{name}={shortened(value)} is not accepted; it is a number, lin_<from> or lin_<from>_<to>")
    for end in ends:
        _number(name, end, "a schedule between numbers")
    return LinearSchedule(ends[0], ends[1] if len(ends) == 2 else 0.0, 1.0)


def _check_policy(config: RunConfig) -> None:
    policy, policies = config.hyperparams["policy"], METHODS[config.algo].all_policies
    if policy not in policies:
        raise unknown("policy", policy, policies)
    known = {
        name
        for base in policies[policy].__mro__
        if "__init__" in vars(base)
        for name, parameter in inspect.signature(vars(base)["__init__"]).parameters.items()
        if parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
    } - {"self", "observation_space", "action_space", "lr_schedule"}
    for name in config.hyperparams.get("policy_kwargs") or {}:
        if name not in known:
            raise unknown("policy_kwargs entry", name, sorted(known))
    check_policy_kwargs(config.hyperparams.get("policy_kwargs") or {})
