"""``progpolicy verify``."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder, parse_variations
from sb3_progpolicy.cli.streams import plain_console, quiet_stdout
from sb3_progpolicy.experiment.sources import Source, find_program

if TYPE_CHECKING:
    from sb3_progpolicy.analysis.verify import Verification
    from sb3_progpolicy.programs.program import Program

FAILS = 1


def verify(
    run_or_name: Annotated[str, typer.Argument(help="run folder, program (.json), model (.zip) or pretrained name")],
    variations: Annotated[
        list[str] | None, typer.Option("--set", help="variations: n_discs=5,6,7; by default the training ones")
    ] = None,
    all_starts: Annotated[
        bool, typer.Option("--all-starts", help="every start, however many; an error where they cannot be counted")
    ] = False,
    from_any_state: Annotated[
        bool, typer.Option("--from-any-state", help="begin in every legal state (Hanoi)")
    ] = False,
    starts: Annotated[int | None, typer.Option("--starts", min=1, help="draw so many of each variation")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the draw")] = 0,
    env: Annotated[str | None, typer.Option("--env", help="another environment than it was trained in")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="certificate (.json), or film of the counterexample (.gif)")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="a JSON list on stdout, nothing else")] = False,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Run a program from every start of a variation, and say from which it fails.

    Exit code 1 if it fails anywhere. Where starts cannot be counted, as in physics, some are drawn. With -o and a
    certificate, an interrupted run goes on when it is started again.
    """
    from sb3_progpolicy.analysis.verify import certificate
    from sb3_progpolicy.programs.files import write_atomically
    from sb3_progpolicy.surroundings import own_env_kwargs

    if output is not None:
        check_folder(output)
        if output.suffix.lower() not in (".json", ".gif"):
            raise ValueError(f"-o {str(output)!r} is not accepted; give a certificate (.json) or a film (.gif)")
    if all_starts and starts is not None:
        raise ValueError("--all-starts and --starts are not accepted together")
    is_certificate = output is not None and output.suffix.lower() == ".json"
    state = output.with_suffix(".state.json") if output is not None and is_certificate else None
    with quiet_stdout():
        program, env_id = find_program(run_or_name, env, allow_pickle)
        rows = _verified(program, env_id, variations, all_starts, from_any_state, starts, seed, state)
    if as_json:
        typer.echo(json.dumps([row.to_json() for row in rows], indent=1))
    else:
        _print_table(env_id, rows)
    failing = [row for row in rows if row.counterexample is not None]
    if output is not None and state is not None:
        command = shlex.join(["progpolicy", *sys.argv[1:]])
        write_atomically(output, json.dumps(certificate(program, env_id, rows, command), indent=1) + "\n")
        state.unlink(missing_ok=True)
    elif output is not None and failing:
        from sb3_progpolicy.experiment.film import record

        reset = failing[0].counterexample or {}
        played = Source(run_or_name, env_id, program, None, own_env_kwargs(program, env_id))
        record(played, output, reset["options"], seed=reset.get("seed", 0))
        typer.echo(f"Wrote {output}", err=True)
    elif output is not None:
        typer.echo("No start fails, so there is no film.", err=True)
    if failing:
        raise typer.Exit(FAILS)


def _verified(
    program: Program,
    env_id: str,
    pairs: list[str] | None,
    all_starts: bool,
    any_state: bool,
    starts: int | None,
    seed: int,
    state: Path | None,
) -> list[Verification]:
    from rich.progress import Progress

    from sb3_progpolicy.analysis import verify as verifying

    chosen = parse_variations(pairs) if pairs else None
    with Progress(console=plain_console(stderr=True), transient=True) as bar:
        task = bar.add_task("starts", total=None)

        def progress(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        return verifying.verify(
            program,
            env_id,
            chosen,
            from_any_state=any_state,
            all_starts=all_starts,
            n_starts=starts,
            seed=seed,
            progress=progress,
            checkpoint=state,
        )


def _print_table(env_id: str, rows: list[Verification]) -> None:
    from rich.table import Table

    exhaustive = all(row.exhaustive for row in rows)
    table = Table(title=f"{env_id}: {'every start' if exhaustive else 'tested on drawn starts'}")
    for name in list(dict.fromkeys(name for row in rows for name in row.variation)):
        table.add_column(name)
    for name in ("starts", "solved", "optimal", "worst ratio", "at least"):
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(
            *(str(value) for value in row.variation.values()),
            f"{row.starts}{'' if row.exhaustive else ' drawn'}",
            str(row.solved),
            "-" if row.optimal is None else str(row.optimal),
            "-" if row.worst_ratio is None else f"{row.worst_ratio:.2f}",
            "-" if row.success_bound is None else f"{row.success_bound:.2%}",
        )
    console = plain_console()
    console.print(table)
    for row in rows:
        if row.counterexample is not None:
            console.print(f"It fails from {json.dumps(row.counterexample)}", soft_wrap=True, highlight=False)
