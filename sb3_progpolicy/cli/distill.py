"""``progpolicy distill``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder, parse_variations
from sb3_progpolicy.cli.streams import plain_console, quiet_stdout

if TYPE_CHECKING:
    from sb3_progpolicy.imitation import Comparison, Imitation
    from sb3_progpolicy.programs.program import Program


def distill(
    teacher: Annotated[
        str, typer.Option("--from", help="planner, or a model (.zip), run folder, program (.json) or pretrained name")
    ],
    env: Annotated[str | None, typer.Option("--env", help="environment id; by default the model's")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="file of the program, .json")] = None,
    variations: Annotated[
        list[str] | None, typer.Option("--set", help="variations to learn on; by default the training ones")
    ] = None,
    n_timesteps: Annotated[int, typer.Option("--n-timesteps", "-n", min=1, help="states to label")] = 30_000,
    max_conditions: Annotated[int, typer.Option("--max-conditions", min=0, help="of the program at most")] = 11,
    cell: Annotated[
        str,
        typer.Option(
            "--cell", help="of the conditions: affine, min (up to three tests at once), or gru, which remembers"
        ),
    ] = "affine",
    seed: Annotated[int, typer.Option("--seed", min=0, help="of all draws")] = 0,
    interaction: Annotated[
        bool, typer.Option("--interaction", help="let it read its previous action, reward and done flag, too")
    ] = False,
    augment: Annotated[
        str | None,
        typer.Option(
            "--augment", help="more than the training variations, for PandaStack: taller_towers or begun_towers"
        ),
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="of the comparison with the teacher")] = 30,
    as_json: Annotated[bool, typer.Option("--json", help="a JSON object on stdout, nothing else")] = False,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Learn a program from what a planner or a trained model does, and compare the two.

    With -o c.json, an interrupted run leaves its best program in c.part.json, and goes on when it is started again
    (with --cell gru it begins anew). What is in c.json is replaced when all is done.
    """
    if output is not None:
        check_folder(output)
        if output.suffix.lower() != ".json":
            raise ValueError(f"-o {str(output)!r} is not accepted; the file is a .json")
    chosen = parse_variations(variations) if variations else None
    with quiet_stdout():
        import torch

        torch.set_num_threads(1)
        who, env_id, env_kwargs = _find_teacher(teacher, env, allow_pickle)
        arguments = {
            "n_timesteps": n_timesteps,
            "max_conditions": max_conditions,
            "cell": cell,
            "seed": seed,
            "augment": augment,
            "interaction": interaction,
        }
        program = _imitated(who, env_id, output, {"tasks": chosen, "env_kwargs": env_kwargs, **arguments})
        from sb3_progpolicy.imitation import compare_with_teacher

        compared = compare_with_teacher(who, program, env_id, chosen, episodes, env_kwargs=env_kwargs)
    if as_json:
        typer.echo(json.dumps({"env": env_id, "n_conditions": len(program.conditions), **compared.to_json()}, indent=1))
        return
    typer.echo(str(program), nl=False)
    _print_comparison(compared, program, episodes)
    if output is not None:
        typer.echo(f"Wrote {output}", err=True)


def _find_teacher(name: str, env: str | None, allow_pickle: bool) -> tuple[Any, str, dict[str, Any]]:
    """Return the teacher, the environment id and its constructor arguments."""
    if name == "planner":
        if env is None:
            raise ValueError("--from planner needs --env")
        return name, env, {}
    from sb3_progpolicy.experiment.sources import find_source

    source = find_source(name, allow_pickle).within(env)
    assert source.env_id is not None
    return source.model if source.program is None else source.program, source.env_id, source.env_kwargs


def _imitated(teacher: Any, env_id: str, output: Path | None, arguments: dict[str, Any]) -> Program:
    """Imitate with a progress bar; the best program so far is in a file of its own after each round."""
    from rich.progress import Progress

    from sb3_progpolicy.imitation import imitate

    keeps_state = output is not None and arguments["cell"] != "gru"
    state = output.with_suffix(".state.npz") if output is not None and keeps_state else None
    part = output.with_suffix(".part.json") if output is not None else None
    with Progress(console=plain_console(stderr=True)) as progress:
        bar = progress.add_task(f"Imitating on {env_id}", total=None)

        def show(so_far: Imitation) -> None:
            name = next(iter(so_far.teacher))
            reached = f"{so_far.result[name]:.3g}" if name in so_far.result else "-"
            words = f"{so_far.n_states} states, {name} {reached} (teacher {so_far.teacher[name]:.3g})"
            progress.update(bar, completed=so_far.round, total=so_far.n_rounds, description=words)
            if part is not None:
                so_far.program.save(part)

        program = imitate(teacher, env_id, callback=show, checkpoint=state, **arguments)
    if output is not None:
        program.save(output)
    for file in (state, part):
        if file is not None:
            file.unlink(missing_ok=True)
    return program


def _print_comparison(compared: Comparison, program: Program, episodes: int) -> None:
    from rich.table import Table

    console = plain_console()
    table = Table(title=f"{episodes} episodes")
    for name in ("", "teacher", "program"):
        table.add_column(name, justify="right" if name else "left")
    for name, value in compared.teacher.items():
        shown = [f"{number:.0%}" if name == "success" else f"{number:g}" for number in (value, compared.program[name])]
        table.add_row(name, *shown)
    console.print(table)
    if program.action.kind == "discrete":
        line = f"{1 - compared.distance:.1%} of its actions are the teacher's."
    else:
        line = f"Its actions are {compared.distance:.3f} of half their range from the teacher's, on average."
    console.print(line, highlight=False)
