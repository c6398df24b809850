"""The command line: a module for each command, which imports what it needs when it runs."""

from __future__ import annotations

import functools
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Annotated, Any

import typer

from sb3_progpolicy.cli import (
    benchmark,
    card,
    compare,
    distill,
    envs,
    evaluate,
    plan,
    play,
    render,
    show,
    simplify,
    train,
    tune,
    verify,
)
from sb3_progpolicy.cli.parsing import repeat_flags
from sb3_progpolicy.nearest import unknown

app = typer.Typer(
    name="progpolicy",
    help="Learn readable programs by reinforcement learning, evaluate, show and render them.",
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
COMMANDS: dict[str, Callable[..., None]] = {
    "train": train.train,
    "tune": tune.tune,
    "evaluate": evaluate.evaluate,
    "compare": compare.compare,
    "card": card.card,
    "distill": distill.distill,
    "show": show.show,
    "simplify": simplify.simplify,
    "verify": verify.verify,
    "render": render.render,
    "play": play.play,
    "plan": plan.plan,
    "envs": envs.envs,
}


def _aborting(command: Callable[..., None]) -> Callable[..., None]:
    """Let Ctrl-C be an ``Abort``, which every version of Typer hands on."""

    @functools.wraps(command)
    def call(**options: Any) -> None:
        try:
            command(**options)
        except KeyboardInterrupt:
            raise typer.Abort from None

    return call


for _name, _command in COMMANDS.items():
    app.command(_name)(_aborting(_command))
_benchmark = typer.Typer(help=benchmark.__doc__, no_args_is_help=True)
for _name, _command in benchmark.COMMANDS.items():
    _benchmark.command(_name)(_aborting(_command))
app.add_typer(_benchmark, name="benchmark")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"progpolicy {version('sb3-progpolicy')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Learn readable programs by reinforcement learning, evaluate, show and render them."""


#: Base of the errors that the parser raises; where it lives depends on Typer's version.
_ParserError: type[Exception] = typer.BadParameter.__mro__[2]
USAGE_ERROR, UNEXPECTED_ERROR, INTERRUPTED = 2, 1, 130
TRACEBACK, MAX_LINE = "PROGPOLICY_TRACEBACK", 1000


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0, 2 for what is not accepted, 1 for an unexpected error, 130 when interrupted.

    2 is also for training that has met a number that is not finite.

    :param arguments: without the program's name; ``sys.argv`` by default
    """
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Run the command line and return the exit code.

    :param arguments: without the program's name
    """
    given = list(arguments) or ["--help"]
    try:
        if given and not given[0].startswith("-") and given[0] not in (*COMMANDS, "benchmark"):
            raise unknown("command", given[0], (*COMMANDS, "benchmark"))
        code = app(repeat_flags(given), prog_name="progpolicy", standalone_mode=False)
    except _ParserError as error:
        _say(error.format_message())  # type: ignore[attr-defined]
        return USAGE_ERROR
    except (KeyboardInterrupt, typer.Abort):
        sys.stderr.write("interrupted\n")
        return INTERRUPTED
    except Exception as error:
        if os.environ.get(TRACEBACK, "0") != "0" or "--verbose 2" in " ".join(given).replace("=", " "):
            traceback.print_exc()
        if isinstance(error, (ValueError, OSError, ModuleNotFoundError, FloatingPointError)):
            _say(str(error))
            return USAGE_ERROR
        _say(f"unexpected {type(error).__name__}: {str(error)[:200]}; its report is in {_write_report(given)}")
        return UNEXPECTED_ERROR
    return code if isinstance(code, int) else 0


def _say(message: str) -> None:
    line = " ".join(message.split())
    sys.stderr.write(f"progpolicy: {line if len(line) <= MAX_LINE else line[:MAX_LINE] + ' ...'}\n")


def _write_report(given: Sequence[str]) -> str:
    """Write what is known of the error in hand to the temporary folder and return the file's name."""
    with tempfile.NamedTemporaryFile("w", prefix="progpolicy-", suffix=".txt", delete=False, encoding="utf-8") as file:
        file.write(f"progpolicy {version('sb3-progpolicy')}, Python {sys.version}\n{list(given)}\n\n")
        file.write(traceback.format_exc())
    return file.name
