"""``progpolicy train``."""

from __future__ import annotations

import secrets
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from sb3_progpolicy.cli.parsing import parse_pairs
from sb3_progpolicy.hyperparams import algorithms

# Flags that decide the outcome, which a resumed run takes from its folder.
_DECIDED = ("--algo", "--env", "--seed", "--hyperparams", "--env-kwargs", "--trained-agent", "--device")


def train(
    context: typer.Context,
    algo: Annotated[str, typer.Option("--algo", help=f"one of {', '.join(algorithms())}")] = "reptile_ppo",
    env: Annotated[str, typer.Option("--env", help="environment id")] = "Hanoi-v0",
    seed: Annotated[int, typer.Option("--seed", help="of everything random; negative: drawn, and noted")] = -1,
    log_folder: Annotated[Path, typer.Option("-f", "--log-folder", help="folder of all runs")] = Path("runs"),
    n_timesteps: Annotated[
        int | None, typer.Option("-n", "--n-timesteps", min=1, help="in place of the tuned number")
    ] = None,
    hyperparams: Annotated[
        list[str] | None,
        typer.Option("-params", "--hyperparams", help="overrides: n_steps:64 policy_kwargs:'{depth: 2}'"),
    ] = None,
    env_kwargs: Annotated[
        list[str] | None, typer.Option("--env-kwargs", help="constructor arguments: n_discs:4")
    ] = None,
    progress: Annotated[bool, typer.Option("-P", "--progress", help="show a progress bar")] = False,
    trained_agent: Annotated[
        str, typer.Option("-i", "--trained-agent", help="start from the parameters of a model (.zip or run folder)")
    ] = "",
    resume: Annotated[
        Path | None, typer.Option("--resume", help="run folder to go on with, from its last checkpoint")
    ] = None,
    tensorboard_log: Annotated[
        str, typer.Option("-tb", "--tensorboard-log", help="folder of the TensorBoard logs")
    ] = "",
    eval_freq: Annotated[
        int, typer.Option("--eval-freq", help="steps between evaluations on the training variations; negative: none")
    ] = -1,
    eval_episodes: Annotated[int, typer.Option("--eval-episodes", min=1, help="on each variation")] = 5,
    save_freq: Annotated[int, typer.Option("--save-freq", help="steps between checkpoints; negative: none")] = 50_000,
    log_interval: Annotated[int, typer.Option("--log-interval", min=1, help="rollouts between lines of the log")] = 10,
    num_threads: Annotated[int, typer.Option("--num-threads", min=1, help="of torch")] = 1,
    device: Annotated[str, typer.Option("--device", help="cpu, cuda or auto")] = "auto",
    verbose: Annotated[int, typer.Option("--verbose", min=0, max=2, help="0, 1 or 2")] = 1,
) -> None:
    """Train and write a run folder: the model, its program, what was run with which versions.

    Ctrl-C saves and says how to go on; a killed run goes on from its last checkpoint, to the same result bit for bit.
    """
    import torch

    from sb3_progpolicy.experiment import config as configs
    from sb3_progpolicy.experiment import folder as folders
    from sb3_progpolicy.experiment import run

    torch.set_num_threads(num_threads)
    options = run.TrainingOptions(progress, save_freq, eval_freq, eval_episodes, log_interval)
    console = Console(stderr=True)
    model: Any
    wrapper = None
    if resume is not None:
        _refuse_decided(context)
        folder = resume
        model, config = run.resume(folder, n_timesteps, max(0, verbose - 1))
    else:
        config = configs.make_config(
            algo,
            env,
            secrets.randbelow(2**31) if seed < 0 else seed,
            n_timesteps,
            parse_pairs("--env-kwargs", env_kwargs or ()),
            parse_pairs("--hyperparams", hyperparams or ()),
            device,
        )
        model, wrapper = run.build_model(config, tensorboard_log or None, max(0, verbose - 1))
        if trained_agent:
            run.start_from(model, trained_agent)
        given = {name: str(value) if isinstance(value, Path) else value for name, value in context.params.items()}
        folder = folders.create_run(log_folder, config, given)
    if verbose:
        console.print(f"{config.algo} on {config.env}, seed {config.seed}, {config.n_timesteps} steps: {folder}")
    try:
        run.train(model, config, folder, wrapper, options)
    except run.Interrupted as interruption:
        _say_how_to_go_on(interruption, folder, config, progress)
        raise typer.Exit(130) from None
    if verbose:
        _show_result(folder, console)


def _refuse_decided(context: typer.Context) -> None:
    flags = {option: parameter.name for parameter in context.command.params for option in parameter.opts}
    for flag in _DECIDED:
        source = context.get_parameter_source(str(flags[flag]))
        if source is not None and source.name == "COMMANDLINE":
            raise ValueError(f"{flag} is not accepted with --resume; a resumed run keeps what it was started with")


def _say_how_to_go_on(interruption: Any, folder: Path, config: Any, progress: bool) -> None:
    flag = " -P" if progress else ""
    again = f"progpolicy train --resume {shlex.quote(str(folder))}{flag}"
    if not interruption.resumable:
        again = (
            f"progpolicy train --algo {config.algo} --env {shlex.quote(config.env)} -i {shlex.quote(str(folder))}{flag}"
        )
    # Not by rich, which would break the command into lines of the terminal's width.
    typer.echo(f"\nInterrupted; saved at step {interruption.timesteps} in {folder}. To go on:\n  {again}", err=True)


def _show_result(folder: Path, console: Console) -> None:
    from sb3_progpolicy.experiment.folder import PROGRAM
    from sb3_progpolicy.programs.program import load_program

    if (folder / PROGRAM).is_file():
        typer.echo(str(load_program(folder / PROGRAM)))
    console.print(f"Saved in {folder}", highlight=False)
