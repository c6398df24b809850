"""``progpolicy show``."""

from __future__ import annotations

import io
import re
import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer
from gymnasium.envs.registration import load_env_creator

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder, parse_variations
from sb3_progpolicy.cli.streams import quiet_stdout
from sb3_progpolicy.experiment.sources import find_source
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.program import Program
from sb3_progpolicy.programs.syntax import inputs_read

FORMATS = ("text", "latex", "dot", "python", "c", "javascript", "png", "activity", "html", "onnx")
FOR_READING = ("text", "latex", "dot", "png", "html")
_OF_SUFFIX = {
    ".txt": "text",
    ".tex": "latex",
    ".dot": "dot",
    ".py": "python",
    ".h": "c",
    ".js": "javascript",
    ".png": "png",
    ".html": "html",
    ".onnx": "onnx",
}


def show(
    run_or_name: Annotated[str, typer.Argument(help="run folder, program (.json), model (.zip) or pretrained name")],
    format_: Annotated[
        str | None, typer.Option("--format", help=f"{', '.join(FORMATS)}; by default as the file's name ends, or text")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="file to write; png, onnx: <environment>.png by default")
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="as it was learnt, not simplified")] = False,
    variation: Annotated[
        list[str] | None, typer.Option("--set", help="activity: the variation of the episode, such as n_objects=3")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="activity: of the episode")] = 0,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Print a program as text, LaTeX, Graphviz, Python, C or JavaScript, draw it, or write a page or an ONNX model.

    The format activity is a picture of one episode: which branch acts at which step.

    What is for reading (text, latex, dot, png, html) is simplified first where that is proven to change no decision
    from any start of training. What is for running has the numbers as they were learnt.
    """
    if format_ not in (None, *FORMATS):
        raise unknown("format", format_, FORMATS)
    if output is not None:
        check_folder(output)
        if format_ is None:
            _check_ending(output)
        if output.exists() and Path(run_or_name).exists() and output.samefile(run_or_name):
            raise ValueError(f"-o {str(output)!r} is not accepted; it is the program itself")
    if format_ is None:
        format_ = _OF_SUFFIX.get(output.suffix.lower(), "text") if output is not None else "text"
    if format_ != "activity" and (variation or seed):
        raise ValueError("--set and --seed are for --format activity")
    with quiet_stdout():
        source = find_source(run_or_name, allow_pickle)
        if source.program is None:
            raise ValueError(f"{run_or_name} is not a program; ProgPolicy and PRLPolicy learn programs")
        program = source.program
        if format_ in FOR_READING and not full and not source.env_kwargs:
            program = _simplified(program, source.env_id)
        if format_ == "text":
            content: str | bytes = _text(program, full)
        elif format_ == "activity":
            content = _activity(program, source.env_id, source.env_kwargs, variation, seed)
        else:
            content = _printed(program, format_, source.env_kwargs)
    if output is None and isinstance(content, bytes):
        output = Path(
            _file_stem(source.program.metadata.get("env"))
            + ("_activity.png" if format_ == "activity" else f".{format_}")
        )
    if output is None:
        typer.echo(content, nl=False)
        if format_ == "text":
            typer.echo(f"Learned by {source.program.learned_by}.", err=True)
    else:
        write_atomically(output, content)
        typer.echo(f"Wrote {output}", err=True)


def _check_ending(output: Path) -> None:
    """Raise ``ValueError`` if a file's name does not say what to write."""
    if output.suffix and output.suffix.lower() not in _OF_SUFFIX:
        listed = ", ".join(_OF_SUFFIX)
        raise ValueError(f"-o {str(output)!r} is not accepted; it ends in {listed}, or --format says what to write")


def _file_stem(env_id: str | None) -> str:
    """The id without its module; what not every file system takes, or takes for a folder, becomes a dash."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", (env_id or "").rpartition(":")[2])[:100] or "program"


def _printed(program: Program, format_: str, env_kwargs: dict[str, Any]) -> str | bytes:
    from sb3_progpolicy import programs

    if format_ == "png":
        return _drawn(program)
    if format_ == "onnx":
        return _model(program)
    if format_ == "html":
        return _page(program, env_kwargs)
    export: Any = {
        "latex": programs.export_latex,
        "dot": programs.export_graphviz,
        "python": programs.export_python,
        "c": programs.export_c,
        "javascript": programs.export_javascript,
    }[format_]
    return export(program)


def _simplified(program: Program, env_id: str | None) -> Program:
    """Return the smallest program that is proven to make the same decisions from all starts of training, if known."""
    from sb3_progpolicy.analysis.lossless import lossless

    found = lossless(program, env_id)
    if found is None:
        return program
    typer.echo(
        f"Simplified from {found.terms_before} numbers, with the same decisions in all {found.situations} situations "
        "of training. --full shows it as it was learnt.",
        err=True,
    )
    return found.program


def _text(program: Program, full: bool) -> str:
    """The program, all of it where it is small or asked for, and what its inputs are."""
    from sb3_progpolicy.env_ids import id_from_file
    from sb3_progpolicy.programs import export_text

    whole = full or "simplified" in program.metadata
    text = export_text(program, max_terms=None if whole else 6)
    lines = _glossary(program, id_from_file(program.metadata.get("env")))
    return text + ("\n" + "\n".join(lines) + "\n" if lines else "")


def _glossary(program: Program, env_id: str | None) -> list[str]:
    """Say what the inputs mean that the program reads."""
    import gymnasium as gym

    from progpolicy_envs.documentation import observation_rows

    if env_id is None or env_id.rpartition(":")[2] not in gym.registry:
        return []
    creator = gym.spec(env_id.rpartition(":")[2]).entry_point
    docstring = (load_env_creator(creator) if isinstance(creator, str) else creator).__doc__
    rows = [row for row in observation_rows(docstring) if set(row.numbers) & inputs_read(program)]
    width = max((len(row.name) for row in rows), default=0)
    return [
        line
        for row in rows
        for line in textwrap.wrap(
            f"{row.name.ljust(width)}  {row.meaning}", 100, subsequent_indent=" " * (width + 2), break_long_words=False
        )
    ]


def _page(program: Program, env_kwargs: dict[str, Any]) -> str:
    from sb3_progpolicy.pages import export_html

    page = export_html(program, env_kwargs=env_kwargs)
    assert page is not None
    return page


def _drawn(program: Program) -> bytes:
    from sb3_progpolicy.programs import plot_program

    _use_agg("png")
    return _png(plot_program(program).figure, 150)


def _activity(
    program: Program, env_id: str | None, env_kwargs: dict[str, Any], variation: list[str] | None, seed: int
) -> bytes:
    from sb3_progpolicy.analysis.activity import plot_activity, record_activity

    _use_agg("activity")
    chosen, *others = parse_variations(variation or [])
    if others:
        raise ValueError(f"--set {' '.join(variation or [])} gives {1 + len(others)} variations; activity shows one")
    return _png(plot_activity(record_activity(program, env_id, chosen, seed, env_kwargs)).figure, 100)


def _use_agg(format_: str) -> None:
    try:
        import matplotlib
    except ImportError:
        raise ValueError(f'{format_} needs matplotlib: pip install "sb3-progpolicy[plot]"') from None
    matplotlib.use("Agg")


def _png(figure: Any, dpi: int) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, bbox_inches="tight")
    return buffer.getvalue()


def _model(program: Program) -> bytes:
    from sb3_progpolicy.programs import export_onnx

    buffer = io.BytesIO()
    try:
        export_onnx(program, buffer)
    except ImportError as error:
        raise ValueError(str(error)) from None
    return buffer.getvalue()
