"""``progpolicy show``."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder
from sb3_progpolicy.cli.streams import quiet_stdout
from sb3_progpolicy.experiment.sources import find_source
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.program import Program

FORMATS = ("text", "latex", "dot", "python", "c", "javascript", "png", "html", "onnx")
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
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Print a program as text, LaTeX, Graphviz, Python, C or JavaScript, draw it, or write a page or an ONNX model."""
    if format_ is None:
        format_ = _OF_SUFFIX.get(output.suffix.lower(), "text") if output is not None else "text"
    if format_ not in FORMATS:
        raise unknown("format", format_, FORMATS)
    if output is not None:
        check_folder(output)
    with quiet_stdout():
        source = find_source(run_or_name, allow_pickle)
        if source.program is None:
            raise ValueError(f"{run_or_name} is not a program; ProgPolicy and PRLPolicy learn programs")
        content = _printed(source.program, format_, source.env_kwargs)
    if output is None and isinstance(content, bytes):
        output = Path(_file_stem(source.program.metadata.get("env")) + f".{format_}")
    if output is None:
        typer.echo(content, nl=False)
        if format_ == "text":
            typer.echo(f"Learned by {source.program.learned_by}.", err=True)
    else:
        write_atomically(output, content)
        typer.echo(f"Wrote {output}", err=True)


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
    if format_ == "text":
        return programs.export_text(program)
    export: Any = {
        "latex": programs.export_latex,
        "dot": programs.export_graphviz,
        "python": programs.export_python,
        "c": programs.export_c,
        "javascript": programs.export_javascript,
    }[format_]
    return export(program)


def _page(program: Program, env_kwargs: dict[str, Any]) -> str:
    from sb3_progpolicy.pages import export_html

    page = export_html(program, env_kwargs=env_kwargs)
    assert page is not None
    return page


def _drawn(program: Program) -> bytes:
    from sb3_progpolicy.programs import plot_program

    try:
        import matplotlib
    except ImportError:
        raise ValueError('png needs matplotlib: pip install "sb3-progpolicy[plot]"') from None
    matplotlib.use("Agg")
    buffer = io.BytesIO()
    plot_program(program).figure.savefig(buffer, format="png", dpi=150, bbox_inches="tight")
    return buffer.getvalue()


def _model(program: Program) -> bytes:
    from sb3_progpolicy.programs import export_onnx

    buffer = io.BytesIO()
    try:
        export_onnx(program, buffer)
    except ImportError as error:
        raise ValueError(str(error)) from None
    return buffer.getvalue()
