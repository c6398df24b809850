"""The command line: train, evaluate, show, render, play, envs. Each command imports what it needs when it runs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import typer

from sb3_progpolicy.cli import envs, evaluate, play, render, show, train
from sb3_progpolicy.cli.parsing import repeat_flags
from sb3_progpolicy.nearest import unknown

app = typer.Typer(
    name="progpolicy",
    help="Learn readable programs by reinforcement learning, evaluate, show and render them.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)
COMMANDS: dict[str, Callable[..., None]] = {
    "train": train.train,
    "evaluate": evaluate.evaluate,
    "show": show.show,
    "render": render.render,
    "play": play.play,
    "envs": envs.envs,
}
for _name, _command in COMMANDS.items():
    app.command(_name)(_command)

#: Base of the errors that the parser raises; where it lives depends on Typer's version.
_ParserError: type[Exception] = typer.BadParameter.__mro__[2]
USAGE_ERROR, INTERRUPTED = 2, 130


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0, 2 for anything that is not accepted, 130 when interrupted.

    :param arguments: without the program's name; ``sys.argv`` by default
    """
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Run the command line and return the exit code.

    :param arguments: without the program's name
    """
    given = list(arguments)
    try:
        if given and not given[0].startswith("-") and given[0] not in COMMANDS:
            raise unknown("command", given[0], COMMANDS)
        code = app(repeat_flags(given), prog_name="progpolicy", standalone_mode=False)
    except _ParserError as error:
        return _fail(error.format_message())  # type: ignore[attr-defined]
    except (ValueError, OSError, ModuleNotFoundError) as error:
        return _fail(str(error))
    except (KeyboardInterrupt, typer.Abort):
        sys.stderr.write("interrupted\n")
        return INTERRUPTED
    return code if isinstance(code, int) else 0


def _fail(message: str) -> int:
    sys.stderr.write("progpolicy: " + " ".join(message.split()) + "\n")
    return USAGE_ERROR
