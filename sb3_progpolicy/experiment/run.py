"""From a configuration to a trained model in a run folder: what ``progpolicy train`` does."""

from __future__ import annotations

import json
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from progpolicy_envs import DOMAINS
from sb3_progpolicy.evaluation import evaluate_model, evaluate_program
from sb3_progpolicy.experiment.config import REPTILE, RunConfig, check_surroundings, parse_schedule
from sb3_progpolicy.experiment.folder import EVALUATIONS, MODEL, load_model, read_config, save_results
from sb3_progpolicy.experiment.methods import METHODS
from sb3_progpolicy.extraction import extract_program, holds_program
from sb3_progpolicy.interaction import VecInteractionHistory
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.reptile.callback import ReptileWrapper
from sb3_progpolicy.reptile.checkpoint import ReptileCheckpoint, load_last_good
from sb3_progpolicy.reptile.tasks import TaskDistribution, default_tasks
from sb3_progpolicy.reptile_ppo.environments import DEFAULT_N_ENVS
from sb3_progpolicy.vec_env import make_fast_vec_env


def build_model(
    config: RunConfig, tensorboard_log: str | None = None, verbose: int = 0
) -> tuple[OnPolicyAlgorithm, ReptileWrapper | None]:
    """Make the model that a configuration describes.

    :param config: from :func:`~sb3_progpolicy.experiment.config.make_config`
    :param tensorboard_log: folder of the TensorBoard logs
    :param verbose: 0, 1 or 2
    :return: the model, and the :class:`ReptileWrapper` that a stock algorithm is to be trained with, if any
    :raises ValueError: if a value is not accepted
    """
    method = METHODS[config.algo]
    arguments = {
        name: parse_schedule(name, value) for name, value in config.hyperparams.items() if name != "n_timesteps"
    }
    arguments |= {"seed": config.seed, "device": config.device, "verbose": verbose, "tensorboard_log": tensorboard_log}
    policy = arguments.pop("policy")
    try:
        if method.has_reptile:
            return method.algorithm(policy, config.env, env_kwargs=config.env_kwargs, **arguments), None  # type: ignore[call-arg]
        reptile = {name: arguments.pop(name) for name in REPTILE if name in arguments}
        wrapper = _reptile_wrapper(config, reptile) if reptile else None
        for name in ("n_envs", "interaction_history"):
            arguments.pop(name, None)
        return method.algorithm(method.policies.get(policy, policy), make_env(config), **arguments), wrapper
    except ValueError:
        raise
    except Exception as error:  # for a value of the wrong kind environments, SB3 and torch raise whatever they please
        raise ValueError(f"{config.algo} on {config.env} cannot be made so: {error or type(error).__name__}") from error


def _reptile_wrapper(config: RunConfig, arguments: dict[str, Any]) -> ReptileWrapper:
    tasks = arguments.pop("tasks", None)
    return ReptileWrapper(default_tasks(config.env) if tasks is None else TaskDistribution(tasks), **arguments)


def make_env(config: RunConfig) -> VecEnv:
    """Make the training environments of a configuration."""
    n_envs = config.hyperparams.get("n_envs", DEFAULT_N_ENVS)
    env = make_fast_vec_env(config.env, n_envs, config.seed, **config.env_kwargs)
    # An algorithm that has Reptile appends the history by itself.
    if not METHODS[config.algo].has_reptile and config.hyperparams.get("interaction_history", False):
        return VecInteractionHistory(env)
    return env


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

    :param model: from :func:`build_model`, or one loaded from a checkpoint
    :param config: of the run
    :param folder: of the run
    :param wrapper: from :func:`build_model`
    :param options: what to do besides
    :raises Interrupted: after an interrupt signal (Ctrl-C) or a termination signal, when all is saved
    """
    checkpoint = None
    callbacks: list[BaseCallback] = [] if wrapper is None else [wrapper]
    if METHODS[config.algo].has_reptile:
        checkpoint = ReptileCheckpoint(folder / MODEL, options.save_freq if options.save_freq >= 0 else sys.maxsize)
        callbacks.append(checkpoint)
    if options.eval_freq >= 0:
        callbacks.append(_EvaluateVariations(config, options, folder / EVALUATIONS, wrapper))
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
        boundary = load_model(folder / MODEL)
        save_results(folder, boundary)
        raise Interrupted(boundary.num_timesteps, resumable=True) from None
    finally:
        signal.signal(signal.SIGTERM, terminate)
    save_results(folder, model)


def resume(folder: Path, n_timesteps: int | None = None, verbose: int = 0) -> tuple[OnPolicyAlgorithm, RunConfig]:
    """Load a run to go on from its last checkpoint; :func:`train` then ends as if it had never stopped.

    :param folder: of a run whose method has Reptile built in
    :param n_timesteps: another end of the training than the run was started with; schedules stretch to it
    :param verbose: 0, 1 or 2
    :raises ValueError: if the folder holds no such run or no checkpoint
    """
    config = read_config(folder)
    if not METHODS[config.algo].has_reptile:
        resumable = ", ".join(name for name, method in METHODS.items() if method.has_reptile)
        raise ValueError(f"{folder} is a run of {config.algo}; {resumable} can be resumed, for others use -i")
    check_surroundings(config)
    if n_timesteps is not None:
        config = replace(config, hyperparams={**config.hyperparams, "n_timesteps": n_timesteps})
    if not (folder / MODEL).is_file():
        raise ValueError(f"{folder} has no checkpoint yet; start the training anew")
    model = load_last_good(folder / MODEL, load_model, env=make_env(config), device=config.device)
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

    def __init__(self, config: RunConfig, options: TrainingOptions, path: Path, wrapper: ReptileWrapper | None) -> None:
        super().__init__()
        self.config, self.options, self.path, self.wrapper = config, options, path, wrapper
        self._meta_iteration: int | None = None
        domain = DOMAINS.get(config.env.rpartition(":")[2])
        self.variations = [{}] if domain is None else list(domain.train)
        self._next = 0
        self._kept: list[dict[str, Any]] = []

    def _on_training_start(self) -> None:
        if self.num_timesteps and self.path.is_file():
            kept = json.loads(self.path.read_text(encoding="utf-8"))
            self._kept = [row for row in kept if row["timesteps"] < self.num_timesteps]

    def _on_rollout_start(self) -> None:
        before, self._meta_iteration = self._meta_iteration, getattr(self.wrapper or self.model, "meta_iteration", None)
        in_a_task = before is not None and before == self._meta_iteration
        if self.num_timesteps < self._next or in_a_task:
            return
        self._next = self.num_timesteps + self.options.eval_freq
        model, arguments = self.model, (self.config.env, self.variations, self.options.eval_episodes)
        if holds_program(model):
            rows = evaluate_program(extract_program(model), *arguments, env_kwargs=self.config.env_kwargs)
        else:
            rows = evaluate_model(model, *arguments, env_kwargs=self.config.env_kwargs)
        self._kept += [{"timesteps": self.num_timesteps, **row.to_json()} for row in rows]
        write_atomically(self.path, json.dumps(self._kept, indent=1) + "\n")
        self.logger.record("eval/success_rate", sum(row.success_rate for row in rows) / len(rows))
        self.logger.record("eval/steps_mean", sum(row.steps_mean for row in rows) / len(rows))

    def _on_step(self) -> bool:
        return True
