"""``progpolicy tune``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from sb3_progpolicy.cli.streams import plain_console
from sb3_progpolicy.hyperparams import algorithms

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial


def tune(
    algo: Annotated[str, typer.Option("--algo", help=f"one of {', '.join(algorithms())}")] = "reptile_ppo",
    env: Annotated[str, typer.Option("--env", help="id of a domain")] = "Hanoi-v0",
    n_trials: Annotated[int, typer.Option("--n-trials", min=1, help="in all; the first has the tuned file's")] = 8,
    n_startup_trials: Annotated[
        int, typer.Option("--n-startup-trials", min=1, help="drawn at random before TPE chooses")
    ] = 5,
    n_timesteps: Annotated[
        int | None, typer.Option("-n", "--n-timesteps", min=1, help="of a trial; a fifth of the file's by default")
    ] = None,
    max_seconds: Annotated[
        float | None, typer.Option("--max-seconds", min=0.1, help="processor time of a trial's training")
    ] = None,
    episodes: Annotated[int, typer.Option("--eval-episodes", min=1, help="on each variation")] = 20,
    storage: Annotated[
        str | None, typer.Option("--storage", help="database of the study, such as sqlite:///tuning.db")
    ] = None,
    study_name: Annotated[str | None, typer.Option("--study-name", help="by default method and environment")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of every trial")] = 0,
    num_threads: Annotated[int, typer.Option("--num-threads", min=1, help="of torch")] = 1,
) -> None:
    """Search for hyperparameters, scored on the validation variations, which are neither trained on nor reported.

    With --storage a study can be interrupted and gone on with, and several processes can work on it.
    """
    try:
        import optuna
    except ModuleNotFoundError:
        raise ValueError('optuna is missing: pip install "sb3-progpolicy[tune]"') from None
    import torch

    from sb3_progpolicy.experiment import tuning as tunings

    torch.set_num_threads(num_threads)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    console = plain_console(stderr=True)
    tuning = tunings.Tuning(algo, env, n_trials, n_startup_trials, n_timesteps, max_seconds, episodes, seed)
    study = tunings.open_study(tuning, storage, study_name)
    done = len(tunings.finished(study))
    console.print(f"{study.study_name}: {done} of {n_trials} trials done", highlight=False)
    tunings.tune(tuning, study, lambda trial: console.print(_line(trial), highlight=False, soft_wrap=True))
    trial = study.best_trial
    typer.echo(_entry(algo, env, trial, tuning))


def _line(trial: FrozenTrial) -> str:
    values = trial.user_attrs.get("hyperparams") or "as in the file"
    outcome = "refused" if trial.value is None else f"{trial.value:.4f}"
    capped = " (stopped at the limit of time)" if trial.user_attrs.get("capped") else ""
    return f"trial {trial.number}: {outcome}{capped}  {values}"


def _entry(algo: str, env: str, trial: FrozenTrial, tuning: Any) -> str:
    """Return the best trial as an entry of the YAML file."""
    import yaml

    nested: dict[str, Any] = {}
    for name, value in trial.user_attrs["hyperparams"].items():
        outer, dot, inner = name.partition(".")
        if dot:
            nested.setdefault(outer, {})[inner] = value
        else:
            nested[name] = value
    comment = (
        f"# {algo}.yml, trial {trial.number} of {tuning.n_trials} at {tuning.config({}).n_timesteps} steps: score "
        f"{trial.value:.4f} on {env}'s validation variations"
    )
    return f"{comment}\n" + yaml.safe_dump({env: nested or "as in the file"}, sort_keys=False).rstrip()
