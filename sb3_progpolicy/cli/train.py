"""``progpolicy train``."""

from __future__ import annotations

import contextlib
import secrets
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, parse_pairs
from sb3_progpolicy.cli.streams import plain_console
from sb3_progpolicy.hyperparams import algorithms

# Flags that decide the outcome, which a resumed run takes from its folder.
_DECIDED = (
    *("--algo", "--env", "--seed", "--hyperparams", "--env-kwargs", "--trained-agent", "--device"),
    *("--log-folder", "--tensorboard-log", "--init-program"),
)


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
        list[str] | None, typer.Option("--env-kwargs", help="constructor arguments: reward_type:sparse")
    ] = None,
    progress: Annotated[bool, typer.Option("-P", "--progress", help="show a progress bar")] = False,
    trained_agent: Annotated[
        str, typer.Option("-i", "--trained-agent", help="start from the parameters of a model (.zip or run folder)")
    ] = "",
    init_program: Annotated[
        str, typer.Option("--init-program", help="start from a program: a .json file, run folder or shipped name")
    ] = "",
    resume: Annotated[
        Path | None, typer.Option("--resume", help="run folder to go on with, from its last checkpoint")
    ] = None,
    tensorboard_log: Annotated[
        str, typer.Option("-tb", "--tensorboard-log", help="folder of the TensorBoard logs")
    ] = "",
    eval_freq: Annotated[
        int, typer.Option("--eval-freq", help="steps between evaluations on the validation variations; negative: none")
    ] = -1,
    eval_episodes: Annotated[int, typer.Option("--eval-episodes", min=1, help="on each variation")] = 5,
    save_freq: Annotated[
        int, typer.Option("--save-freq", help="steps between checkpoints of our algorithms; negative: none")
    ] = 50_000,
    log_interval: Annotated[int, typer.Option("--log-interval", min=1, help="rollouts between lines of the log")] = 10,
    num_threads: Annotated[int, typer.Option("--num-threads", min=1, help="of torch")] = 1,
    device: Annotated[str, typer.Option("--device", help="cpu, cuda or auto")] = "auto",
    verbose: Annotated[int, typer.Option("--verbose", min=0, max=2, help="0, 1 or 2")] = 1,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Train and write a run folder: the model, its program, what was run with which versions.

    Ctrl-C saves and says how to go on. A killed run of one of our algorithms goes on from its last checkpoint, to the
    same result bit for bit; stock algorithms keep no checkpoints.
    """
    import torch

    from sb3_progpolicy.experiment import config as configs
    from sb3_progpolicy.experiment import folder as folders
    from sb3_progpolicy.experiment import run

    torch.set_num_threads(num_threads)
    console = plain_console(stderr=True)
    with run.terminable(), contextlib.ExitStack() as stack:
        if resume is not None:
            _refuse_decided(context)
            if (resume / folders.CONFIG).is_file():
                stack.enter_context(folders.locked(resume))
            folder, wrapper, arguments = resume, None, {**folders.read_arguments(resume), **_given(context)}
            model, config = run.resume(folder, n_timesteps, max(0, verbose - 1), allow_pickle)
            folders.describe_run(folder, config, arguments)
        else:
            if trained_agent and init_program:
                raise ValueError("-i and --init-program are two starts; give one of them")
            config = configs.make_config(
                algo,
                env,
                secrets.randbelow(2**31) if seed < 0 else seed,
                n_timesteps,
                parse_pairs("--env-kwargs", env_kwargs or ()),
                {
                    **parse_pairs("--hyperparams", hyperparams or ()),
                    **({"init_program": init_program} if init_program else {}),
                },
                device,
            )
            model, wrapper = run.build_model(config, tensorboard_log or None, max(0, verbose - 1))
            if trained_agent:
                run.start_from(model, trained_agent, allow_pickle)
            arguments = _plain(context.params)
            folder = folders.create_run(log_folder, config, arguments)
            stack.enter_context(folders.locked(folder))
        if verbose:
            console.print(f"{config.algo} on {config.env}, seed {config.seed}, {config.n_timesteps} steps: {folder}")
        kept = {name: arguments.get(name, context.params[name]) for name in folders.KEPT_OPTIONS}
        try:
            run.train(model, config, folder, wrapper, run.TrainingOptions(progress, **kept))
        except run.Interrupted as interruption:
            _say_how_to_go_on(interruption, folder, config, progress)
            raise typer.Exit(1 if interruption.reason else 130) from None
    if verbose:
        _show_result(folder, console)


def _plain(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: str(value) if isinstance(value, Path) else value for name, value in options.items()}


def _given(context: typer.Context) -> dict[str, Any]:
    """The options on the command line, as against those that have their defaults."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    return _plain(
        {name: context.params[name] for name, source in sources.items() if source and source.name == "COMMANDLINE"}
    )


def _refuse_decided(context: typer.Context) -> None:
    given = _given(context)
    flags = {option: parameter.name for parameter in context.command.params for option in parameter.opts}
    for flag in _DECIDED:
        if flags[flag] in given:
            raise ValueError(f"{flag} is not accepted with --resume; a resumed run keeps what it was started with")


def _say_how_to_go_on(interruption: Any, folder: Path, config: Any, progress: bool) -> None:
    flag = " -P" if progress else ""
    again = f"progpolicy train --resume {shlex.quote(str(folder))}{flag}"
    if not interruption.resumable:
        start = f"progpolicy train --algo {config.algo} --env {shlex.quote(config.env)}"
        again = f"{start} -i {shlex.quote(str(folder))} --allow-pickle{flag}"
        again += "\n  which trains anew, from its parameters; give the other options again"
    # Not by rich, which would break the command into lines of the terminal's width.
    saved = f"saved at step {interruption.timesteps} in {folder}. To go on:"
    if interruption.reason:
        typer.echo(f"progpolicy: {' '.join(interruption.reason.split())}; {saved} {again}", err=True)
    else:
        typer.echo(f"\nInterrupted; {saved}\n  {again}", err=True)


def _show_result(folder: Path, console: Console) -> None:
    from sb3_progpolicy.experiment.folder import PROGRAM
    from sb3_progpolicy.programs.program import load_program

    if (folder / PROGRAM).is_file():
        typer.echo(str(load_program(folder / PROGRAM)))
    console.print(f"Saved in {folder}", highlight=False)
