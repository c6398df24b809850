"""Search for hyperparameters with Optuna, as in rl-baselines3-zoo, scored on a domain's validation variations."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from progpolicy_envs import Domain, get_domain
from sb3_progpolicy.env_ids import spec_of
from sb3_progpolicy.evaluation import Evaluation, evaluate_any
from sb3_progpolicy.experiment.budget import ProcessorTimeLimit
from sb3_progpolicy.experiment.config import RunConfig, make_config
from sb3_progpolicy.experiment.run import build_model
from sb3_progpolicy.hyperparams import load_search, shortened
from sb3_progpolicy.vec_env.factory import simulations_in_this_process

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.trial import FrozenTrial

#: How much the trained variations count beside those of validation, where all fail in the first trials.
TRAINED_WEIGHT = 0.1
#: Seconds after which a trial whose process has died is tried again.
HEARTBEAT = 60
DEFAULTS = "defaults"  # marks the trial of the hyperparameters as the file has them


@dataclass(frozen=True)
class Tuning:
    """What is tuned and at what cost.

    :param algo: a key of :data:`~sb3_progpolicy.experiment.methods.METHODS`
    :param env: id of a domain
    :param n_trials: number of trials in all; the first has the hyperparameters of the file
    :param n_startup_trials: of them, how many are drawn at random before Optuna's TPE chooses
    :param n_timesteps: environment steps of a trial; a fifth of the file's by default
    :param max_seconds: processor time of a trial's training; ``None`` for no limit
    :param episodes: of the evaluation, on each variation
    :param seed: of every trial's training, and of what is drawn
    :param search: what to try in place of what the method's file has under ``search``
    :raises ValueError: if a value is not accepted
    """

    algo: str
    env: str
    n_trials: int = 8
    n_startup_trials: int = 5
    n_timesteps: int | None = None
    max_seconds: float | None = None
    episodes: int = 20
    seed: int = 0
    search: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        for name in ("n_trials", "n_startup_trials", "episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} is not accepted; it is at least 1")
        if not self.space:
            raise ValueError(f"there is nothing to search: {self.algo}.yml has no 'search', and none is given")
        check_space(self.space)
        get_domain(self.env)
        self.config({})

    @property
    def space(self) -> Mapping[str, Any]:
        """What is tried, by hyperparameter."""
        return load_search(self.algo) if self.search is None else self.search

    def config(self, chosen: Mapping[str, Any]) -> RunConfig:
        """Return the configuration of a trial.

        :param chosen: hyperparameters in place of the file's; ``policy_kwargs.<name>`` replaces one of them
        """
        config = make_config(self.algo, self.env, self.seed)
        overrides = {name: value for name, value in chosen.items() if "." not in name}
        for name, value in chosen.items():
            outer, dot, inner = name.partition(".")
            if dot:
                kept = overrides.get(outer, config.hyperparams.get(outer) or {})
                overrides[outer] = {**kept, inner: value}
        n_timesteps = self.n_timesteps or max(1, config.n_timesteps // 5)
        return make_config(self.algo, self.env, self.seed, n_timesteps, overrides=overrides)


def check_space(space: Mapping[str, Any]) -> None:
    """Raise an error unless every entry says what to try.

    :param space: by hyperparameter a list of values, or a mapping of ``low``, ``high`` and, if wanted, ``log``
    :raises ValueError: naming the entry
    """
    for name, tried in space.items():
        if isinstance(tried, Sequence) and not isinstance(tried, str) and len(tried):
            continue
        if isinstance(tried, Mapping) and {"low", "high"} <= set(tried) <= {"low", "high", "log"}:
            low, high = tried["low"], tried["high"]
            if all(isinstance(end, (int, float)) and not isinstance(end, bool) for end in (low, high)) and low < high:
                continue
        raise ValueError(
            f"search: {name}={shortened(tried)} is not accepted; it is a list of values, or low and high (and log)"
        )


def suggest(trial: Trial, space: Mapping[str, Any]) -> dict[str, Any]:
    """Draw hyperparameters for a trial.

    :param trial: of Optuna
    :param space: what to try
    """
    chosen: dict[str, Any] = {}
    for name, tried in space.items():
        if not isinstance(tried, Mapping):
            # Optuna's choices are plain values; lists are chosen by their number.
            plain = all(value is None or isinstance(value, (bool, int, float, str)) for value in tried)
            choices = list(tried) if plain else list(range(len(tried)))
            choice = trial.suggest_categorical(name, choices)
            chosen[name] = choice if plain else tried[choice]
        elif isinstance(tried["low"], int) and isinstance(tried["high"], int):
            chosen[name] = trial.suggest_int(name, tried["low"], tried["high"], log=tried.get("log", False))
        else:
            chosen[name] = trial.suggest_float(name, tried["low"], tried["high"], log=tried.get("log", False))
    return chosen


def score(domain: Domain, rows: Sequence[Evaluation], cap: int) -> float:
    """Return how bad a trial is, 0 to 1: the share of the cap on steps that is used on the validation variations.

    What was trained on counts a tenth as much, so that trials that fail beyond it can still be told apart.

    :param domain: whose variations these are
    :param rows: crisp where there is a program
    :param cap: largest number of steps of an episode
    """
    validation = [row.steps_mean / cap for row in rows if dict(row.variation) in domain.validation]
    trained = [row.steps_mean / cap for row in rows if dict(row.variation) not in domain.validation]
    parts = sum(validation) / len(validation) + TRAINED_WEIGHT * sum(trained) / len(trained)
    return parts / (1 + TRAINED_WEIGHT)


def run_trial(tuning: Tuning, trial: Trial) -> float:
    """Train with drawn hyperparameters and return the score.

    :param tuning: what is tuned
    :param trial: of Optuna
    """
    from optuna import TrialPruned

    chosen = {} if trial.user_attrs.get(DEFAULTS) else suggest(trial, tuning.space)
    trial.set_user_attr("hyperparams", chosen)
    domain = get_domain(tuning.env)
    try:
        config = tuning.config(chosen)
        model, wrapper = build_model(config)
    except ValueError as error:  # values that do not go together
        trial.set_user_attr("refused", str(error))
        raise TrialPruned(str(error)) from None
    callbacks: list[Any] = [] if wrapper is None else [wrapper]
    limit = None if tuning.max_seconds is None else ProcessorTimeLimit(tuning.max_seconds)
    if limit is not None:
        callbacks.append(limit)
    try:
        model.learn(config.n_timesteps, callback=callbacks)
    except FloatingPointError as error:  # diverged: as bad as can be
        trial.set_user_attr("diverged", str(error))
        return 1.0
    variations = [*domain.trained, *domain.validation]
    rows = evaluate_any(
        model, tuning.env, variations, tuning.episodes, semantics=("crisp",), env_kwargs=config.env_kwargs
    )
    trial.set_user_attr("timesteps", model.num_timesteps)
    trial.set_user_attr("capped", limit is not None and limit.reached)
    trial.set_user_attr("steps_mean", [row.steps_mean for row in rows])
    env = model.get_env()
    if env is not None:
        env.close()
    cap = spec_of(tuning.env).max_episode_steps
    assert cap is not None, "evaluation needs one"
    return score(domain, rows, cap)


def open_study(tuning: Tuning, storage: str | None, name: str | None = None) -> Study:
    """Open a study, or go on with one; several processes may work on one that is stored.

    :param tuning: what is tuned
    :param storage: URL of a database, such as ``sqlite:///tuning.db``; ``None`` keeps it in memory
    :param name: of the study; made of method and environment by default
    :raises ValueError: if the study is of something else: method, environment, steps, seed, episodes, limit of time or
        space
    """
    import optuna
    from optuna.exceptions import ExperimentalWarning
    from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
    from optuna.trial import TrialState

    database: Any = None
    if storage is not None:
        with warnings.catch_warnings():  # Optuna has called these experimental since 2021
            warnings.simplefilter("ignore", ExperimentalWarning)
            retry: Callable[..., None] = RetryHeartbeatStaleTrialCallback(max_retry=3)
            database = RDBStorage(storage, heartbeat_interval=HEARTBEAT, heartbeat_stale_trial_callback=retry)
    study = optuna.create_study(
        storage=database, study_name=name or f"{tuning.algo} on {tuning.env}", direction="minimize", load_if_exists=True
    )
    described = {
        "algo": tuning.algo,
        "env": tuning.env,
        "n_timesteps": tuning.config({}).n_timesteps,
        "seed": tuning.seed,
        "episodes": tuning.episodes,
        "max_seconds": tuning.max_seconds,
        "space": json.loads(json.dumps(tuning.space)),
    }
    known = study.user_attrs.get("tuning")
    if known is None:
        study.set_user_attr("tuning", described)
    else:
        differing = [key for key, value in known.items() if described.get(key) != value]
        if differing:
            was, given = ({key: one.get(key) for key in differing} for one in (known, described))
            raise ValueError(f"the study {study.study_name!r} is of {was}, not of {given}; give another --study-name")
    # Who opens it again, or works on it beside others, must not draw the same values again.
    opened = int(study.user_attrs.get("opened", 0))
    study.set_user_attr("opened", opened + 1)
    seed = tuning.seed if not opened else int(np.random.SeedSequence((tuning.seed, opened)).generate_state(1)[0])
    study.sampler = optuna.samplers.TPESampler(n_startup_trials=tuning.n_startup_trials, seed=seed)
    alive = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.WAITING, TrialState.RUNNING)
    if not any(trial.user_attrs.get(DEFAULTS) for trial in study.get_trials(deepcopy=False, states=alive)):
        study.enqueue_trial({}, user_attrs={DEFAULTS: True})
    return study


def finished(study: Study) -> list[FrozenTrial]:
    """Return the trials of a study that have come to an end: with a score, or refused."""
    from optuna.trial import TrialState

    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))


def tune(tuning: Tuning, study: Study, report: Callable[[FrozenTrial], None] | None = None) -> None:
    """Run trials until a study has as many as wanted.

    :param tuning: what is tuned
    :param study: from :func:`open_study`
    :param report: is called with each trial that has ended
    """
    while len(finished(study)) < tuning.n_trials:
        with simulations_in_this_process():  # whose time would not count towards the limit elsewhere
            study.optimize(
                lambda trial: run_trial(tuning, trial),
                n_trials=1,
                callbacks=[] if report is None else [lambda _, trial: report(trial)],
            )
