"""From a configuration to a trained model in a run folder: what ``progpolicy train`` does."""

from __future__ import annotations

import contextlib
import json
import shlex
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from progpolicy_envs import Domain, find_domain
from progpolicy_envs.variation import Variation
from sb3_progpolicy.evaluation import evaluate_any, success_and_steps
from sb3_progpolicy.experiment.config import REPTILE, RunConfig, check_surroundings, parse_schedule
from sb3_progpolicy.experiment.folder import (
    EVALUATIONS,
    MODEL,
    PROGRAM,
    load_model,
    read_arguments,
    read_config,
    save_results,
)
from sb3_progpolicy.experiment.methods import METHODS
from sb3_progpolicy.extraction import extract_program, holds_program
from sb3_progpolicy.interaction import VecInteractionHistory
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.program import Program
from sb3_progpolicy.reptile.callback import ReptileWrapper
from sb3_progpolicy.reptile.checkpoint import ReptileCheckpoint, load_last_good, previous_of
from sb3_progpolicy.reptile.tasks import TaskDistribution, make_tasks
from sb3_progpolicy.reptile_ppo.environments import make_venv
from sb3_progpolicy.vec_env.worker import WorkerDiedError, interrupts_deferred


def build_model(
    config: RunConfig, tensorboard_log: str | None = None, verbose: int = 0
) -> tuple[BaseAlgorithm, ReptileWrapper | None]:
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
    if isinstance(arguments.get("train_freq"), list):  # SB3 takes a pair as a tuple, which no file has
        arguments["train_freq"] = tuple(arguments["train_freq"])
    try:
        if method.has_reptile:
            return method.algorithm(policy, config.env, env_kwargs=config.env_kwargs, **arguments), None  # type: ignore[call-arg]
        reptile = {name: arguments.pop(name) for name in REPTILE if name in arguments}
        wrapper = _reptile_wrapper(config, reptile) if reptile else None
        for name in ("n_envs", "interaction_history"):
            arguments.pop(name, None)
        env = make_env(config)
        return method.algorithm_for(env.action_space)(method.policies.get(policy, policy), env, **arguments), wrapper
    except ValueError:
        raise
    except Exception as error:  # for a value of the wrong kind environments, SB3 and torch raise whatever they please
        raise ValueError(f"{config.algo} on {config.env} cannot be made so: {error or type(error).__name__}") from error


def _reptile_wrapper(config: RunConfig, arguments: dict[str, Any]) -> ReptileWrapper:
    for name in ("tasks", "sampler"):
        arguments.pop(name, None)
    return ReptileWrapper(_tasks(config), **arguments)


def trained_variations(config: RunConfig, domain: Domain) -> tuple[Variation, ...]:
    """Return the variations that a configuration trains on.

    :param config: of the training
    :param domain: of its environment
    """
    tasks = config.hyperparams.get("tasks")
    if tasks is None and METHODS[config.algo].across_variations:
        return domain.train
    space = domain.space
    fixed = {**({} if space is None else space.defaults), **config.env_kwargs}
    chosen = TaskDistribution(tasks).variations if tasks is not None else [{}]
    return tuple({**fixed, **variation} for variation in chosen)


def _tasks(config: RunConfig) -> TaskDistribution:
    """Return the tasks of a configuration in the form that has an effect on its environment."""
    tasks, sampler = config.hyperparams.get("tasks"), config.hyperparams.get("sampler")
    return make_tasks(tasks, sampler, config.env, True, config.env_kwargs)


def make_env(config: RunConfig) -> VecEnv:
    """Make the training environments of a configuration."""
    remade = _tasks(config).apply == "constructor"
    env = make_venv(config.env, config.hyperparams.get("n_envs"), config.seed, config.env_kwargs, remade)
    # An algorithm that has Reptile appends the history by itself.
    if not METHODS[config.algo].has_reptile and config.hyperparams.get("interaction_history", False):
        return VecInteractionHistory(env)
    return env


@dataclass(frozen=True)
class TrainingOptions:
    """What a run does besides training; nothing here changes its outcome.

    :param progress: show a progress bar
    :param save_freq: environment steps between two checkpoints; negative for none
    :param eval_freq: environment steps between two evaluations on the validation variations; negative for none
    :param eval_episodes: episodes of an evaluation, on each variation
    :param eval_max_steps: cap on the steps of an evaluated episode; ``None`` for the registered one
    :param log_interval: rollouts between two lines of the log
    """

    progress: bool = False
    save_freq: int = 50_000
    eval_freq: int = -1
    eval_episodes: int = 5
    eval_max_steps: int | None = None
    log_interval: int = 10


class Interrupted(Exception):
    """Training was interrupted and what was reached is saved.

    :param timesteps: environment steps at which it goes on
    :param resumable: whether it can go on as if nothing had happened
    :param reason: what interrupted it, if that was not the user
    """

    def __init__(self, timesteps: int, resumable: bool, reason: str = "") -> None:
        super().__init__(reason or f"interrupted at step {timesteps}")
        self.timesteps, self.resumable, self.reason = timesteps, resumable, reason


class Diverged(FloatingPointError):
    """Training has met a number that is not finite; its message says what of the parameters is saved, and where."""


class _RunCheckpoint(ReptileCheckpoint):
    """Checkpoints of a run: the model and, if it is one, its program, of the same boundary.

    :param folder: of the run
    :param config: of the run
    :param save_freq: environment steps between two checkpoints; negative for none but at an interruption
    """

    def __init__(self, folder: Path, config: RunConfig, save_freq: int) -> None:
        super().__init__(folder / MODEL, save_freq if save_freq >= 0 else sys.maxsize)
        self.config = config
        self.timesteps = 0
        self._program: Program | None = None

    def _on_rollout_start(self) -> None:
        if self.model.meta_iteration != self._boundary_iteration:
            self.timesteps = self.num_timesteps
            self._program = extract_program(self.model, env=self.config.env) if holds_program(self.model) else None
        super()._on_rollout_start()

    def save(self) -> bool:
        with interrupts_deferred():
            saved = super().save()
            if saved and self._program is not None:
                self._program.save(self.path.with_name(PROGRAM))
        return saved


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Let a request to terminate (SIGTERM) end what is done here as Ctrl-C does."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread hears of signals
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def train(
    model: BaseAlgorithm,
    config: RunConfig,
    folder: Path,
    wrapper: ReptileWrapper | None = None,
    options: TrainingOptions = TrainingOptions(),
    callbacks: Sequence[BaseCallback] = (),
) -> None:
    """Train a new or a loaded model up to its number of steps and save what comes of it.

    :param model: from :func:`build_model`, or one loaded from a checkpoint
    :param config: of the run
    :param folder: of the run
    :param wrapper: from :func:`build_model`
    :param options: what to do besides
    :param callbacks: of SB3, besides those that train and save
    :raises Interrupted: after an interrupt (Ctrl-C), or when a worker process has died; then all is saved
    :raises Diverged: at a number that is not finite; then the last finite parameters are saved
    """
    checkpoint: _RunCheckpoint | None = None
    callbacks = [*callbacks, *([] if wrapper is None else [wrapper])]
    if METHODS[config.algo].has_reptile:
        checkpoint = _RunCheckpoint(folder, config, options.save_freq)
        callbacks.append(checkpoint)
    if options.eval_freq >= 0:
        callbacks.append(_EvaluateVariations(config, options, folder / EVALUATIONS, wrapper))
    try:
        model.learn(
            config.n_timesteps - model.num_timesteps,
            callback=callbacks,
            log_interval=options.log_interval,
            reset_num_timesteps=model.num_timesteps == 0,
            progress_bar=options.progress,
        )
    except KeyboardInterrupt:
        raise _saved(model, folder, checkpoint) from None
    except WorkerDiedError as error:
        raise _saved(model, folder, checkpoint, str(error)) from None
    except FloatingPointError as error:
        raise _diverged(model, config, folder, checkpoint, str(error)) from None
    save_results(folder, model)


def _saved(model: BaseAlgorithm, folder: Path, checkpoint: _RunCheckpoint | None, reason: str = "") -> Interrupted:
    """Save what was reached and return what says so."""
    with interrupts_deferred():
        if checkpoint is not None:
            checkpoint.save()
            return Interrupted(checkpoint.timesteps, resumable=True, reason=reason)
        save_results(folder, model)
    return Interrupted(model.num_timesteps, resumable=False, reason=reason)


def _diverged(
    model: BaseAlgorithm, config: RunConfig, folder: Path, checkpoint: _RunCheckpoint | None, reason: str
) -> Diverged:
    """Save what is finite and return what says so."""
    reason = reason.rstrip(".")
    if checkpoint is None and not all(th.isfinite(parameter).all() for parameter in model.policy.parameters()):
        return Diverged(f"{reason}; the parameters are not saved, for they are not finite")
    saved = _saved(model, folder, checkpoint)
    again = f"progpolicy train --algo {config.algo} --env {shlex.quote(config.env)} -i {shlex.quote(str(folder))}"
    again += "" if saved.resumable else " --allow-pickle"
    where = f"saved at step {saved.timesteps} in {folder}"
    return Diverged(f"{reason}; {where}. To train from there with other hyperparameters: {again}")


def resume(
    folder: Path, n_timesteps: int | None = None, verbose: int = 0, allow_pickle: bool = False
) -> tuple[BaseAlgorithm, RunConfig]:
    """Load a run to go on from its last checkpoint, or make its model anew if it was stopped before the first.

    :func:`train` then ends as if the run had never stopped.

    :param folder: of a run whose method has Reptile built in
    :param n_timesteps: another end of the training than the run was started with; schedules stretch to it
    :param verbose: 0, 1 or 2
    :param allow_pickle: see :func:`~sb3_progpolicy.experiment.folder.load_model`
    :raises ValueError: if the folder holds no such run, or it is trained already
    """
    config = read_config(folder)
    if not METHODS[config.algo].has_reptile:
        resumable = ", ".join(name for name, method in METHODS.items() if method.has_reptile)
        raise ValueError(f"{folder} is a run of {config.algo}; {resumable} can be resumed, for others use -i")
    check_surroundings(config)
    if n_timesteps is not None:
        config = replace(config, hyperparams={**config.hyperparams, "n_timesteps": n_timesteps})
    if not (folder / MODEL).is_file() and not previous_of(folder / MODEL).is_file():
        arguments = read_arguments(folder)
        model, _ = build_model(config, arguments.get("tensorboard_log") or None, verbose)
        if arguments.get("trained_agent"):
            start_from(model, arguments["trained_agent"], allow_pickle or arguments.get("allow_pickle") is True)
        return model, config
    kwargs = {"env": make_env(config), "device": config.device, "allow_pickle": allow_pickle}
    model = load_last_good(folder / MODEL, load_model, **kwargs)
    if model.num_timesteps >= config.n_timesteps:
        raise ValueError(f"{folder} is trained already: {model.num_timesteps} of {config.n_timesteps} steps")
    model.verbose = verbose
    return model, config


def start_from(model: BaseAlgorithm, trained: str | Path, allow_pickle: bool = False) -> None:
    """Take the parameters of a trained model as the initial ones.

    :param model: a new model
    :param trained: a ``.zip`` file or a run folder
    :param allow_pickle: see :func:`~sb3_progpolicy.experiment.folder.load_model`
    :raises ValueError: if the policies differ in shape
    """
    path = Path(trained) / MODEL if Path(trained).is_dir() else Path(trained)
    start = load_model(path, device=model.device, allow_pickle=allow_pickle)
    try:
        model.policy.load_state_dict(start.policy.state_dict())
    except RuntimeError:
        raise ValueError(f"{trained} does not fit; its policy has other layers than the one to be trained") from None
    if hasattr(start, "learned_by"):
        model.learned_by = start.learned_by  # type: ignore[attr-defined]


class _EvaluateVariations(BaseCallback):
    """Evaluates on the validation variations, between two tasks where there are tasks, and at the end.

    The results are logged and kept in a file.
    """

    def __init__(self, config: RunConfig, options: TrainingOptions, path: Path, wrapper: ReptileWrapper | None) -> None:
        super().__init__()
        self.config, self.options, self.path, self.wrapper = config, options, path, wrapper
        self._meta_iteration: int | None = None
        domain = find_domain(config.env)
        self.variations = [{}] if domain is None else list(domain.validation)
        self._next = 0
        self._kept: list[dict[str, Any]] = []

    def _on_training_start(self) -> None:
        if self.num_timesteps and self.path.is_file():
            kept = json.loads(self.path.read_text(encoding="utf-8"))
            self._kept = [row for row in kept if row["timesteps"] < self.num_timesteps]
            self._next = max((row["timesteps"] for row in self._kept), default=0) + self.options.eval_freq

    def _on_rollout_start(self) -> None:
        before, self._meta_iteration = self._meta_iteration, getattr(self.wrapper or self.model, "meta_iteration", None)
        in_a_task = before is not None and before == self._meta_iteration
        if self.num_timesteps >= self._next and not in_a_task:
            self._evaluate()

    def _on_training_end(self) -> None:
        self._evaluate()

    def _evaluate(self) -> None:
        self._next = self.num_timesteps + self.options.eval_freq
        rows = evaluate_any(
            self.model,
            self.config.env,
            self.variations,
            self.options.eval_episodes,
            semantics=("crisp",),
            max_steps=self.options.eval_max_steps,
            env_kwargs=self.config.env_kwargs,
        )
        self._kept += [{"timesteps": self.num_timesteps, **row.to_json()} for row in rows]
        write_atomically(self.path, json.dumps(self._kept, indent=1) + "\n")
        if all(row.success_rate is not None for row in rows):
            success, steps = success_and_steps(rows)
            self.logger.record("eval/success_rate", success)
            self.logger.record("eval/steps_mean", steps)
        self.logger.record("eval/return_mean", sum(row.return_mean for row in rows) / len(rows))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)  # as SB3's EvalCallback does

    def _on_step(self) -> bool:
        return True
