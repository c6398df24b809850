"""``progpolicy show`` and ``progpolicy envs``."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder
from sb3_progpolicy.cli.streams import quiet_stdout
from sb3_progpolicy.experiment.sources import find_source
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.program import Program

FORMATS = ("text", "latex", "dot", "python", "png")
_OF_SUFFIX = {".txt": "text", ".tex": "latex", ".dot": "dot", ".py": "python", ".png": "png"}


def show(
    run_or_name: Annotated[str, typer.Argument(help="run folder, program (.json), model (.zip) or pretrained name")],
    format_: Annotated[
        str | None, typer.Option("--format", help=f"{', '.join(FORMATS)}; by default as the file's name ends, or text")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="file to write; png: <environment>.png by default")
    ] = None,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Print a program as text, LaTeX, Graphviz or standalone Python, or draw it."""
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
        content = _printed(source.program, format_)
    if output is None and isinstance(content, bytes):
        output = Path(f"{(source.env_id or 'program').rpartition(':')[2].replace('/', '-')}.png")
    if output is None:
        typer.echo(content, nl=False)
    else:
        write_atomically(output, content)
        typer.echo(f"Wrote {output}", err=True)


def _printed(program: Program, format_: str) -> str | bytes:
    from sb3_progpolicy import programs

    if format_ == "png":
        return _drawn(program)
    if format_ == "text":
        return programs.export_text(program)
    export: Any = {
        "latex": programs.export_latex,
        "dot": programs.export_graphviz,
        "python": programs.export_python,
    }[format_]
    return export(program)


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


def envs() -> None:
    """List the environments with their parameters, training variations and unseen variations."""
    from rich.console import Console
    from rich.table import Table

    from progpolicy_envs import DOMAINS

    table = Table(show_lines=True)
    for name in ("environment", "parameters", "trained on", "unseen"):
        table.add_column(name, overflow="fold")
    for domain in DOMAINS.values():
        with quiet_stdout():
            parameters = _parameters(domain.id)
        table.add_row(
            domain.id,
            "\n".join(f"{name}: {parameter.allowed}" for name, parameter in parameters.items()),
            _listed(domain.train),
            _listed(domain.unseen),
        )
    Console().print(table)


def _parameters(env_id: str) -> Mapping[str, Any]:
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    return getattr(load_env_creator(str(gym.spec(env_id).entry_point)), "variations", {})


def _listed(variations: Any) -> str:
    values: dict[str, dict[str, None]] = {}
    for variation in variations:
        for name, value in variation.items():
            values.setdefault(name, {})[str(value)] = None
    return "\n".join(f"{name}: {', '.join(seen)}" for name, seen in values.items())
