"""``progpolicy evaluate``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, default_variations, parse_variations
from sb3_progpolicy.cli.streams import plain_console, quiet_stdout
from sb3_progpolicy.experiment.sources import Source, evaluate_source, find_source
from sb3_progpolicy.nearest import unknown

if TYPE_CHECKING:
    from sb3_progpolicy.evaluation import Evaluation
    from sb3_progpolicy.programs.interpreter import Semantics

SEMANTICS: tuple[Semantics, ...] = ("soft", "crisp")


def evaluate(
    run_or_name: Annotated[str, typer.Argument(help="run folder, program (.json), model (.zip) or pretrained name")],
    variations: Annotated[
        list[str] | None, typer.Option("--set", help="variations: n_discs=5,6,7 or n_discs=1-8, several multiply")
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="on each variation")] = 1,
    semantics: Annotated[str, typer.Option("--semantics", help="soft, crisp or both")] = "both",
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the environments")] = 0,
    max_steps: Annotated[
        int | None, typer.Option("--max-steps", min=1, help="cap of an episode in place of the environment's")
    ] = None,
    env: Annotated[str | None, typer.Option("--env", help="another environment than it was trained in")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="a JSON list on stdout, nothing else")] = False,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Measure success and steps on variations, next to the steps of the domain's planner.

    An episode that fails counts as the cap: --max-steps, or else the environment's limit of steps. Without --set: the
    domain's training sizes and all larger ones. Where the environment reports no success: returns and lengths of
    episodes.
    """
    if semantics not in (*SEMANTICS, "both"):
        raise unknown("semantics", semantics, (*SEMANTICS, "both"))
    with quiet_stdout():
        source = find_source(run_or_name, allow_pickle)
        rows = _evaluate(source, variations, episodes, semantics, seed, max_steps, env)
    learned_by = None if source.program is None else source.program.learned_by
    if as_json:
        typer.echo(json.dumps([{**row.to_json(), "learned_by": learned_by} for row in rows], indent=2))
    else:
        _print_table(rows, None if learned_by is None else f"learned by {learned_by}")


def _evaluate(
    source: Source,
    pairs: list[str] | None,
    episodes: int,
    semantics: str,
    seed: int,
    max_steps: int | None,
    env: str | None,
) -> list[Evaluation]:
    import torch

    torch.set_num_threads(1)
    source = source.within(env)
    assert source.env_id is not None
    chosen = parse_variations(pairs) if pairs else default_variations(source.env_id)
    kinds = [kind for kind in SEMANTICS if semantics in (kind, "both")]
    return evaluate_source(source, chosen, episodes, kinds, seed=seed, max_steps=max_steps)


def _print_table(rows: list[Evaluation], caption: str | None) -> None:
    from rich.table import Table

    table = Table(title=f"{rows[0].env}, {rows[0].episodes} episode(s) each", caption=caption)
    names = list(dict.fromkeys(name for row in rows for name in row.variation))
    for name in [*names, "semantics"]:
        table.add_column(name)
    goal = any(row.success_rate is not None for row in rows)
    for name in ("success", "steps", "optimum", "ratio") if goal else ("return", "steps"):
        table.add_column(name, justify="right")
    previous = rows[0].semantics
    for row in rows:
        if row.semantics != previous:
            table.add_section()
            previous = row.semantics
        about = (*(str(row.variation.get(name, "")) for name in names), row.semantics or "-")
        steps = _with_deviation(row.steps_mean, row.steps_std)
        if not goal:
            table.add_row(*about, _with_deviation(row.return_mean, row.return_std), steps)
            continue
        table.add_row(
            *about,
            "-" if row.success_rate is None else f"{row.success_rate:.0%}",
            steps,
            "-" if row.optimal_steps_mean is None else f"{row.optimal_steps_mean:g}",
            "-" if row.ratio is None else f"{row.ratio:.2f}",
        )
    plain_console().print(table)


def _with_deviation(mean: float, deviation: float) -> str:
    return f"{mean:g} ± {deviation:.1f}" if deviation else f"{mean:g}"
