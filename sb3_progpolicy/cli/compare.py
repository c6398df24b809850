"""``progpolicy compare``."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder, default_variations, parse_variations
from sb3_progpolicy.cli.streams import plain_console, quiet_stdout


def compare(
    runs: Annotated[
        list[str], typer.Argument(help="two or more of: run folder, program (.json), model (.zip), pretrained name")
    ],
    variations: Annotated[
        list[str] | None, typer.Option("--set", help="variations to evaluate on: n_discs=1-7")
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="on each variation")] = 20,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the environments")] = 0,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="picture to draw, .png or .svg")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
    env: Annotated[str | None, typer.Option("--env", help="another environment than they were trained in")] = None,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Evaluate several runs on the same episodes and show them side by side, as a table and as a picture.

    Each run acts in an environment made with the arguments that it was trained with; where these differ, it is said.
    The picture also has the training curves of the runs that were trained with --eval-freq.
    """
    import torch

    from sb3_progpolicy.experiment.comparison import compare_sources, draw_comparison
    from sb3_progpolicy.experiment.sources import find_source
    from sb3_progpolicy.programs.files import write_atomically

    torch.set_num_threads(1)
    if len(runs) < 2:
        raise ValueError(f"{len(runs)} run given; two or more are compared")
    if output is not None:
        if output.suffix.lower() not in (".png", ".svg"):
            raise ValueError(f"-o {str(output)!r} is not accepted; the file is a .png or an .svg")
        check_folder(output)
    with quiet_stdout():
        sources = [find_source(name, allow_pickle).within(env) for name in runs]
        env_id = sources[0].env_id
        assert env_id is not None
        chosen = parse_variations(variations) if variations else default_variations(env_id)
        compared = compare_sources(sources, chosen, episodes, seed)
        learned = [None if source.program is None else source.program.learned_by for source in sources]
    made_with = [source.env_kwargs for source in sources]
    if any(one != made_with[0] for one in made_with):
        each = ", ".join(f"{source.name} in {source.env_kwargs or 'the one of the defaults'}" for source in sources)
        typer.echo(f"The environments differ: each run acts in the one that it was trained in, {each}.", err=True)
    if as_json:
        described = [
            {"run": run.name, **row.to_json(), "learned_by": how, "env_kwargs": own}
            for run, how, own in zip(compared, learned, made_with, strict=True)
            for row in run.rows
        ]
        typer.echo(json.dumps(described, indent=2))
    else:
        _print_table(compared, learned)
    if output is not None:
        buffer = io.BytesIO()
        draw_comparison(compared).savefig(buffer, format=output.suffix[1:].lower(), dpi=150)
        write_atomically(output, buffer.getvalue())
        typer.echo(f"Wrote {output}", err=True)


def _print_table(compared: Any, learned: Sequence[str | None]) -> None:
    from rich.table import Table

    first = compared[0].rows
    shown = "returns" if first[0].success_rate is None else "steps [share solved]"
    table = Table(title=f"{first[0].env}, {first[0].episodes} episode(s) each, {shown}")
    names = list(dict.fromkeys(name for row in first for name in row.variation))
    for name in names:
        table.add_column(name)
    for run, how in zip(compared, learned, strict=True):
        table.add_column(f"{run.name}\n{how}" if how else run.name, justify="right", overflow="fold")
    table.add_column("planner", justify="right")
    for number, row in enumerate(first):
        cells = []
        for run in compared:
            own = run.rows[number]
            if own.success_rate is None:
                cells.append(f"{own.return_mean:.1f} ± {own.return_std:.1f}")
                continue
            solved = "" if own.success_rate == 1 else f" [{own.success_rate:.0%}]"
            cells.append(f"{own.steps_mean:.1f}{solved}")
        optimum = "-" if row.optimal_steps_mean is None else f"{row.optimal_steps_mean:.1f}"
        table.add_row(*(str(row.variation.get(name, "")) for name in names), *cells, optimum)
    plain_console().print(table)
