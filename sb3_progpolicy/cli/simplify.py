"""``progpolicy simplify``."""

from __future__ import annotations

import importlib.util
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder, default_variations, parse_variations
from sb3_progpolicy.cli.streams import plain_console, quiet_stdout
from sb3_progpolicy.experiment.sources import find_program

if TYPE_CHECKING:
    from sb3_progpolicy.analysis.simplify import Simplification
    from sb3_progpolicy.programs.program import Program


def simplify(
    run_or_name: Annotated[str, typer.Argument(help="run folder, program (.json), model (.zip) or pretrained name")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="file of the small program, .json")] = None,
    variations: Annotated[
        list[str] | None, typer.Option("--set", help="variations to look at; by default the training ones")
    ] = None,
    equally_good: Annotated[
        str,
        typer.Option(
            "--equally-good",
            help="program: keep to its actions; planner: to any of a shortest solution; outcome: to success and steps",
        ),
    ] = "program",
    tie: Annotated[bool, typer.Option("--tie/--no-tie", help="one rule for all directions, if there is one")] = True,
    starts: Annotated[int, typer.Option("--starts", min=1, help="of each variation, drawn if it has more")] = 300,
    time_limit: Annotated[float, typer.Option("--time-limit", min=1, help="seconds for each rule")] = 60,
    max_weight: Annotated[int, typer.Option("--max-weight", min=1, max=1000, help="largest whole number")] = 8,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the drawn starts")] = 0,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="of the comparison, on each variation")] = 20,
    terms: Annotated[
        int | None,
        typer.Option("--terms", min=1, help="continuous actions or outcome: take the program of so many terms"),
    ] = None,
    finetune: Annotated[
        int | None, typer.Option("--finetune", min=1, help="continuous actions: then train it on for so many steps")
    ] = None,
    curve: Annotated[
        Path | None,
        typer.Option("--curve", help="continuous actions or outcome: .csv or .png, success and steps by terms"),
    ] = None,
    env: Annotated[str | None, typer.Option("--env", help="another environment than it was trained in")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="a JSON object on stdout, nothing else")] = False,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Find the program with the fewest whole numbers that makes the same decisions on the training variations.

    It says how few any program of the same form needs, and then measures both, on larger variations too.
    """
    if output is not None:
        check_folder(output)
        if output.suffix.lower() != ".json":
            raise ValueError(f"-o {str(output)!r} is not accepted; the file is a .json")
    if curve is not None:
        check_folder(curve, "--curve")
        if curve.suffix.lower() not in (".csv", ".png"):
            raise ValueError(f"--curve {str(curve)!r} is not accepted; the file is a .csv or a .png")
        if curve.suffix.lower() == ".png" and importlib.util.find_spec("matplotlib") is None:
            raise ValueError('png needs matplotlib: pip install "sb3-progpolicy[plot]"')
    from sb3_progpolicy.analysis.simplify import simplify as simplified

    with quiet_stdout():
        program, env_id = find_program(run_or_name, env, allow_pickle)
        if curve is not None and program.action.kind != "box" and equally_good != "outcome":
            raise ValueError("--curve is for continuous actions, or with --equally-good outcome")
        found = simplified(
            program,
            env_id,
            parse_variations(variations) if variations else None,
            equally_good=equally_good,  # type: ignore[arg-type]
            tie=tie,
            n_starts=starts,
            time_limit=time_limit,
            max_weight=max_weight,
            n_terms=terms,
            finetune=finetune,
            seed=seed,
        )
        if output is not None:
            found.program.save(output)
        if curve is not None and found.curve:
            _write_curve(found, curve)
        elif curve is not None:
            typer.echo("No number can be left out, so there is no curve.", err=True)
        rows = _compared(program, found.program, env_id, episodes, seed)
    if as_json:
        typer.echo(json.dumps({**found.to_json(), "evaluation": rows}, indent=1))
        return
    typer.echo(str(found.program), nl=False)
    _print_summary(found, rows, env_id)
    if output is not None:
        typer.echo(f"Wrote {output}", err=True)


def _write_curve(found: Simplification, path: Path) -> None:
    """Write what programs of fewer and of more terms reach, as a table or a picture."""
    from sb3_progpolicy.analysis.simplify import CURVE
    from sb3_progpolicy.programs.files import write_atomically

    if path.suffix.lower() == ".csv":
        rows = [",".join(CURVE), *(",".join(str(getattr(point, name)) for name in CURVE) for point in found.curve)]
        write_atomically(path, "\n".join(rows) + "\n")
        return
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(6, 5), layout="constrained")
    terms = [point.terms for point in found.curve]
    above.plot(terms, [100 * point.success_rate for point in found.curve], "o-", color="#0f6b5c")
    above.set(ylabel="success, %", ylim=(-4, 104), title="On the training variations")
    below.plot(terms, [point.steps_mean for point in found.curve], "o-", color="#b4531f")
    below.set(ylabel="steps", xlabel="terms", ylim=(0, None))
    for axes in (above, below):
        axes.axvline(found.terms_after, color="#8a8a8a", linestyle=":")
        axes.spines[["top", "right"]].set_visible(False)
        axes.xaxis.get_major_locator().set_params(integer=True)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    plt.close(figure)
    write_atomically(path, buffer.getvalue())


def _compared(original: Program, small: Program, env_id: str, episodes: int, seed: int) -> list[dict[str, object]]:
    """Evaluate both on the same episodes of all variations."""
    from sb3_progpolicy.evaluation import evaluate_program

    variations = default_variations(env_id)
    both = [evaluate_program(program, env_id, variations, episodes, seed=seed) for program in (original, small)]
    return [
        {
            "variation": dict(before.variation),
            "episodes": episodes,
            **{f"{name}_before": getattr(before, name) for name in ("success_rate", "steps_mean")},
            **{f"{name}_after": getattr(after, name) for name in ("success_rate", "steps_mean")},
            "optimal_steps_mean": before.optimal_steps_mean,
        }
        for before, after in zip(*both, strict=True)
    ]


def _print_summary(found: Simplification, rows: list[dict[str, object]], env_id: str) -> None:
    from rich.table import Table

    console = plain_console()
    bound = found.terms_lower_bound
    words = (
        "no program of this form has fewer"
        if bound == found.terms_after
        else (f"none of this form has less than {bound}" if bound else "fewer may do")
    )
    tied = f", one rule for all {found.symmetry}" if found.symmetry else ""
    console.print(
        f"\n{found.terms_before} numbers before, {found.terms_after} {'term' if found.terms_after == 1 else 'terms'} "
        f"now{tied}; {words}. {found.situations} situations from {'all' if found.exhaustive else 'drawn'} "
        f"{found.starts} starts, {found.seconds} s.",
        soft_wrap=True,
        highlight=False,
    )
    for note in found.notes:
        console.print(note, soft_wrap=True, highlight=False)
    table = Table(title=f"{env_id}, {rows[0]['episodes']} episodes each")
    for name in ("variation", "success before", "after", "steps before", "after", "planner"):
        table.add_column(name, justify="left" if name == "variation" else "right")
    for row in rows:
        optimal = row["optimal_steps_mean"]
        table.add_row(
            ", ".join(f"{name}={value}" for name, value in row["variation"].items()),  # type: ignore[attr-defined]
            f"{row['success_rate_before']:.0%}",
            f"{row['success_rate_after']:.0%}",
            f"{row['steps_mean_before']:g}",
            f"{row['steps_mean_after']:g}",
            "-" if optimal is None else f"{optimal:g}",
        )
    console.print(table)
