"""From hyperparameters to a trained model in a run folder: what ``progpolicy train`` does."""

from __future__ import annotations

import inspect
import io
import json
import platform
import signal
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml
from gymnasium.envs.registration import load_env_creator
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from progpolicy_envs import DOMAINS
from sb3_progpolicy.checkpoint import ReptileCheckpoint
from sb3_progpolicy.evaluation import evaluate_model, evaluate_program, spec_of
from sb3_progpolicy.hyperparams import load_hyperparams, parse_kwargs, parse_number
from sb3_progpolicy.interaction import VecInteractionHistory
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.policies import ProgrammaticActorCritic, ProgrammaticPolicy, RecurrentProgrammaticPolicy
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.reptile import ReptileWrapper
from sb3_progpolicy.reptile_ppo import DEFAULT_N_ENVS, ReptilePPO
from sb3_progpolicy.tasks import TaskDistribution, default_tasks
from sb3_progpolicy.vec_env import make_fast_vec_env

ALGORITHMS: dict[str, type[OnPolicyAlgorithm]] = {
    "ppo": PPO,
    "recurrent_ppo": RecurrentPPO,
    "reptile_ppo": ReptilePPO,
}
MODEL, PROGRAM, CONFIG, ARGUMENTS, VERSIONS = "model.zip", "program.json", "config.yml", "args.yml", "versions.yml"
EVALUATIONS = "evaluations.json"

_OWN_POLICIES: dict[type[OnPolicyAlgorithm], dict[str, Any]] = {
    PPO: {"PRLPolicy": ProgrammaticPolicy},
    RecurrentPPO: {"ProgPolicy": RecurrentProgrammaticPolicy},
}
_REPTILE = ("tasks", "inner_updates", "tasks_per_iteration", "meta_learning_rate", "meta_optimizer", "meta_update")
_SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf", "meta_learning_rate", "temperature", "action_std")
# Arguments of the constructors that have a flag of their own or no place in a file.
_ELSEWHERE = {"self", "env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"}
_ELSEWHERE |= {"rollout_buffer_class", "rollout_buffer_kwargs"}


@dataclass(frozen=True)
class RunConfig:
    """All that decides the outcome of a run; written to its folder.

    :param algo: a key of :data:`ALGORITHMS`
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

    :param algo: a key of :data:`ALGORITHMS`
    :param env_id: a registered environment id
    :param seed: of everything random
    :param n_timesteps: in place of the file's
    :param env_kwargs: constructor arguments of the environment
    :param overrides: hyperparameters in place of the file's
    :param device: torch device
    :raises ValueError: if a name or a value is not accepted; the message names the nearest names
    """
    if algo not in ALGORITHMS:
        raise unknown("algorithm", algo, ALGORITHMS)
    hyperparams = {**load_hyperparams(algo, env_id), **(overrides or {})}
    if n_timesteps is not None:
        hyperparams["n_timesteps"] = n_timesteps
    env_kwargs = {**parse_kwargs("env_kwargs", hyperparams.pop("env_kwargs", None)), **(env_kwargs or {})}
    _check_env_kwargs(env_id, env_kwargs)
    accepted = _accepted(algo)
    for name in hyperparams:
        if name not in accepted:
            raise unknown("hyperparameter", name, [*accepted, "env_kwargs"])
    checked = {name: _checked(name, value, accepted[name]) for name, value in hyperparams.items()}
    config = RunConfig(algo, env_id, seed, env_kwargs, checked, device)
    _check_policy(config)
    return config


def _check_env_kwargs(env_id: str, env_kwargs: Mapping[str, Any]) -> None:
    constructor = inspect.signature(load_env_creator(str(spec_of(env_id).entry_point))).parameters
    if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in constructor.values()):
        return
    for name in env_kwargs:
        if name not in constructor:
            raise unknown("environment argument", name, constructor)


def _accepted(algo: str) -> dict[str, Any]:
    """Return the hyperparameters of an algorithm with their defaults."""
    signature = inspect.signature(ALGORITHMS[algo].__init__).parameters
    accepted = {name: parameter.default for name, parameter in signature.items() if name not in _ELSEWHERE}
    if algo != "reptile_ppo":
        reptile = inspect.signature(ReptileWrapper.__init__).parameters
        accepted |= {name: reptile[name].default for name in _REPTILE} | {"interaction_history": False}
    accepted.pop("env_kwargs", None)
    return {**accepted, "policy": "", "tasks": None, "n_envs": DEFAULT_N_ENVS, "n_timesteps": 1}


def _checked(name: str, value: Any, default: Any) -> Any:
    """Return a value as the type of its default, so that a slip is an error here and not deep inside torch."""
    value = parse_number(value)
    if name == "policy_kwargs":
        return parse_kwargs(name, value)
    if name in _SCHEDULES:
        if value is not None and not isinstance(value, str):
            return _number(name, value, "a number, lin_<from> or lin_<from>_<to>")
        if isinstance(value, str):
            _schedule(name, value)
        return value
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise ValueError(f"{name}={value!r} is not accepted; it is true or false")
        return value
    if isinstance(default, int) or name in ("batch_size", "n_envs"):
        if value is None and name == "batch_size":
            return None
        number = _number(name, value, "a whole number")
        if number != int(number) or number < 1:
            raise ValueError(f"{name}={value!r} is not accepted; it is a whole number of at least 1")
        return int(number)
    if isinstance(default, float) or (name == "target_kl" and value is not None):
        return _number(name, value, "a number")
    return value


def _number(name: str, value: Any, accepted: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{name}={value!r} is not accepted; it is {accepted}")
    return value


def _schedule(name: str, value: Any) -> Any:
    """Return a text as a linear schedule, and anything else as it is.

    The zoo's ``lin_0.001`` falls to 0 at the end of the training; ``lin_0.5_0.1`` goes from the first to the second.
    """
    if not isinstance(value, str):
        return value
    kind, *numbers = value.split("_")
    ends = [parse_number(number) for number in numbers]
    if kind != "lin" or len(ends) not in (1, 2) or not all(isinstance(end, float) for end in ends):
        raise ValueError(f"{name}={value!r} is not accepted; it is a number, lin_<from> or lin_<from>_<to>")
    return LinearSchedule(ends[0], ends[1] if len(ends) == 2 else 0.0, 1.0)


def _check_policy(config: RunConfig) -> None:
    algorithm, policy = ALGORITHMS[config.algo], config.hyperparams.get("policy")
    policies = {**algorithm.policy_aliases, **_OWN_POLICIES.get(algorithm, {})}
    if policy not in policies:
        raise unknown("policy", policy, policies)
    known = {
        name
        for base in policies[policy].__mro__
        if "__init__" in vars(base)
        for name, parameter in inspect.signature(base.__init__).parameters.items()
        if parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD
    } - {"self", "observation_space", "action_space", "lr_schedule"}
    for name in config.hyperparams.get("policy_kwargs") or {}:
        if name not in known:
            raise unknown("policy_kwargs entry", name, sorted(known))


# ------------------------------------------------------------------------------------------------------- building


def build_model(
    config: RunConfig, tensorboard_log: str | None = None, verbose: int = 0
) -> tuple[OnPolicyAlgorithm, ReptileWrapper | None]:
    """Make the model that a configuration describes.

    :param config: from :func:`make_config`
    :param tensorboard_log: folder of the TensorBoard logs
    :param verbose: 0, 1 or 2
    :return: the model, and the :class:`ReptileWrapper` that a stock algorithm is to be trained with, if any
    :raises ValueError: if a value is not accepted
    """
    arguments = {name: _schedule(name, value) if name in _SCHEDULES else value for name, value in _constructor(config)}
    arguments |= {"seed": config.seed, "device": config.device, "verbose": verbose, "tensorboard_log": tensorboard_log}
    algorithm = ALGORITHMS[config.algo]
    policy = arguments.pop("policy")
    try:
        if issubclass(algorithm, ReptilePPO):
            return algorithm(policy, config.env, env_kwargs=config.env_kwargs, **arguments), None
        arguments.pop("n_envs", None)
        wrapper = _reptile_wrapper(config, {name: arguments.pop(name) for name in _REPTILE if name in arguments})
        arguments.pop("interaction_history", None)
        policy = _OWN_POLICIES[algorithm].get(policy, policy)
        return algorithm(policy, make_env(config), **arguments), wrapper
    except (AssertionError, RuntimeError) as error:  # what SB3 and torch raise for some values
        raise ValueError(str(error)) from None


def _constructor(config: RunConfig) -> Iterable[tuple[str, Any]]:
    return ((name, value) for name, value in config.hyperparams.items() if name != "n_timesteps")


def _reptile_wrapper(config: RunConfig, arguments: dict[str, Any]) -> ReptileWrapper | None:
    if not arguments:
        return None
    tasks = arguments.pop("tasks", None)
    return ReptileWrapper(default_tasks(config.env) if tasks is None else TaskDistribution(tasks), **arguments)


def make_env(config: RunConfig) -> VecEnv:
    """Make the training environments of a configuration."""
    n_envs = config.hyperparams.get("n_envs", DEFAULT_N_ENVS)
    env = make_fast_vec_env(config.env, n_envs, config.seed, **config.env_kwargs)
    # ReptilePPO appends the history by itself.
    if config.algo != "reptile_ppo" and config.hyperparams.get("interaction_history", False):
        return VecInteractionHistory(env)
    return env


# ---------------------------------------------------------------------------------------------------- run folders


def create_run(log_folder: str | Path, config: RunConfig, arguments: Mapping[str, Any]) -> Path:
    """Make the folder ``<log_folder>/<algo>/<env>_<n>`` with the first free n, and describe the run in it.

    :param log_folder: folder of all runs
    :param config: what is run
    :param arguments: the command line's options, kept for the reader
    """
    parent = Path(log_folder) / config.algo
    parent.mkdir(parents=True, exist_ok=True)
    name, number = config.env.rpartition(":")[2].replace("/", "-"), 1
    while True:
        folder = parent / f"{name}_{number}"
        try:
            folder.mkdir()  # fails if another process took the number
            break
        except FileExistsError:
            number += 1
    packages = ("sb3-progpolicy", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy")
    versions = {"python": platform.python_version(), **{package: _version(package) for package in packages}}
    described = {CONFIG: asdict(config), ARGUMENTS: dict(arguments), VERSIONS: versions}
    for file, content in described.items():
        write_atomically(folder / file, yaml.safe_dump(content, sort_keys=False))
    return folder


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def read_config(folder: str | Path) -> RunConfig:
    """Read the configuration of a run folder.

    :raises ValueError: if the folder holds none, or it is damaged
    """
    path = Path(folder) / CONFIG
    try:
        return RunConfig(**yaml.safe_load(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise ValueError(f"{folder} is not a run folder; it has no {CONFIG}") from None
    except (yaml.YAMLError, TypeError, UnicodeDecodeError):
        raise ValueError(f"{path} is damaged; it does not describe a run") from None


def load_model(path: str | Path, env: VecEnv | None = None, **kwargs: Any) -> OnPolicyAlgorithm:
    """Load a model saved by any of our algorithms: the one that the configuration next to it names, or ReptilePPO.

    :param path: a ``.zip`` file; as SB3's models it holds pickled objects, so load only files that you trust
    :param env: environments to go on training in
    :param kwargs: see SB3's ``BaseAlgorithm.load``
    :raises ValueError: if there is no such file
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist; a model is a .zip file")
    algo = read_config(path.parent).algo if (path.parent / CONFIG).is_file() else "reptile_ppo"
    if algo not in ALGORITHMS:
        raise unknown("algorithm", algo, ALGORITHMS)
    return ALGORITHMS[algo].load(path, env=env, **kwargs)


def save_results(folder: Path, model: OnPolicyAlgorithm) -> None:
    """Write the model and, if it is one, its program to a run folder."""
    buffer = io.BytesIO()
    model.save(buffer)
    write_atomically(folder / MODEL, buffer.getvalue())
    if isinstance(model, ReptilePPO) and isinstance(model.policy, ProgrammaticActorCritic):
        model.program().save(folder / PROGRAM)


# ------------------------------------------------------------------------------------------------------- training


@dataclass(frozen=True)
class TrainingOptions:
    """What a run does besides training; nothing here changes its outcome.

    :param progress: show a progress bar
    :param save_freq: environment steps between two checkpoints; negative for none
    :param eval_freq: environment steps between two evaluations on the training variations; negative for none
    :param eval_episodes: episodes of an evaluation, on each variation
    :param log_interval: rollouts between two lines of the log
    """

    progress: bool = False
    save_freq: int = 50_000
    eval_freq: int = -1
    eval_episodes: int = 5
    log_interval: int = 10


class Interrupted(Exception):
    """Training was interrupted and what was reached is saved.

    :param timesteps: environment steps at which it goes on
    :param resumable: whether it can go on as if nothing had happened
    """

    def __init__(self, timesteps: int, resumable: bool) -> None:
        super().__init__(f"interrupted at step {timesteps}")
        self.timesteps, self.resumable = timesteps, resumable


def train(
    model: OnPolicyAlgorithm,
    config: RunConfig,
    folder: Path,
    wrapper: ReptileWrapper | None = None,
    options: TrainingOptions = TrainingOptions(),
) -> None:
    """Train a new or a loaded model up to its number of steps and save what comes of it.

    :param model: from :func:`build_model`, or a :class:`ReptilePPO` loaded from a checkpoint
    :param config: of the run
    :param folder: of the run
    :param wrapper: from :func:`build_model`
    :param options: what to do besides
    :raises Interrupted: after an interrupt signal (Ctrl-C) or a termination signal, when all is saved
    """
    reptile = model.reptile if isinstance(model, ReptilePPO) else wrapper
    checkpoint = None
    callbacks: list[BaseCallback] = [] if wrapper is None else [wrapper]
    if isinstance(model, ReptilePPO):
        checkpoint = ReptileCheckpoint(folder / MODEL, options.save_freq if options.save_freq >= 0 else sys.maxsize)
        callbacks.append(checkpoint)
    if options.eval_freq >= 0:
        callbacks.append(_EvaluateVariations(config, options, folder / EVALUATIONS, reptile))
    remaining = config.n_timesteps - model.num_timesteps
    if remaining <= 0:
        raise ValueError(f"{folder} is trained already: {model.num_timesteps} of {config.n_timesteps} steps")
    terminate = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        model.learn(
            remaining,
            callback=callbacks,
            log_interval=options.log_interval,
            reset_num_timesteps=model.num_timesteps == 0,
            progress_bar=options.progress,
        )
    except KeyboardInterrupt:
        if checkpoint is None or not checkpoint.save():
            save_results(folder, model)
            raise Interrupted(model.num_timesteps, resumable=False) from None
        boundary = ReptilePPO.load(folder / MODEL)
        save_results(folder, boundary)
        raise Interrupted(boundary.num_timesteps, resumable=True) from None
    finally:
        signal.signal(signal.SIGTERM, terminate)
    save_results(folder, model)


def resume(folder: Path, n_timesteps: int | None = None, verbose: int = 0) -> tuple[ReptilePPO, RunConfig]:
    """Load a run to go on from its last checkpoint; :func:`train` then ends as if it had never stopped.

    :param folder: of a run of ReptilePPO
    :param n_timesteps: another end of the training than the run was started with; schedules stretch to it
    :param verbose: 0, 1 or 2
    :raises ValueError: if the folder holds no such run or no checkpoint
    """
    config = read_config(folder)
    if config.algo != "reptile_ppo":
        raise ValueError(f"{folder} is a run of {config.algo}; reptile_ppo can be resumed, for others use -i")
    if n_timesteps is not None:
        config = replace(config, hyperparams={**config.hyperparams, "n_timesteps": n_timesteps})
    if not (folder / MODEL).is_file():
        raise ValueError(f"{folder} has no checkpoint yet; start the training anew")
    model = ReptilePPO.load(folder / MODEL, env=make_env(config), device=config.device)
    model.verbose = verbose
    return model, config


def start_from(model: OnPolicyAlgorithm, trained: str | Path) -> None:
    """Take the parameters of a trained model as the initial ones.

    :param model: a new model
    :param trained: a ``.zip`` file or a run folder
    :raises ValueError: if the policies differ in shape
    """
    path = Path(trained) / MODEL if Path(trained).is_dir() else Path(trained)
    state = load_model(path, device=model.device).policy.state_dict()
    try:
        model.policy.load_state_dict(state)
    except RuntimeError:
        raise ValueError(f"{trained} does not fit; its policy has other layers than the one to be trained") from None


class _EvaluateVariations(BaseCallback):
    """Evaluates on the training variations, between two tasks where there are tasks; logs and keeps the results."""

    def __init__(self, config: RunConfig, options: TrainingOptions, path: Path, reptile: ReptileWrapper | None) -> None:
        super().__init__()
        self.config, self.options, self.path, self.reptile = config, options, path, reptile
        domain = DOMAINS.get(config.env.rpartition(":")[2])
        self.variations = [{}] if domain is None else list(domain.train)
        self._next = 0
        self._kept: list[dict[str, Any]] = []

    def _on_training_start(self) -> None:
        if self.num_timesteps and self.path.is_file():
            kept = json.loads(self.path.read_text(encoding="utf-8"))
            self._kept = [row for row in kept if row["timesteps"] < self.num_timesteps]

    def _on_rollout_start(self) -> None:
        if self.num_timesteps < self._next or (self.reptile is not None and not self.reptile.at_task_start):
            return
        self._next = self.num_timesteps + self.options.eval_freq
        model, arguments = self.model, (self.config.env, self.variations, self.options.eval_episodes)
        if isinstance(model, ReptilePPO) and isinstance(model.policy, ProgrammaticActorCritic):
            rows = evaluate_program(model.program(), *arguments, env_kwargs=self.config.env_kwargs)
        else:
            rows = evaluate_model(model, *arguments, env_kwargs=self.config.env_kwargs)
        self._kept += [{"timesteps": self.num_timesteps, **row.to_json()} for row in rows]
        write_atomically(self.path, json.dumps(self._kept, indent=1) + "\n")
        self.logger.record("eval/success_rate", sum(row.success_rate for row in rows) / len(rows))
        self.logger.record("eval/steps_mean", sum(row.steps_mean for row in rows) / len(rows))

    def _on_step(self) -> bool:
        return True
