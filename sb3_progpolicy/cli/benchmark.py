"""Compare methods on domains over seeds: run a suite, see how far it is, export its rows, report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sb3_progpolicy.cli.parsing import check_folder
from sb3_progpolicy.cli.streams import plain_console

if TYPE_CHECKING:
    from sb3_progpolicy.benchmark.runner import Progress
    from sb3_progpolicy.benchmark.suite import Suite

STORE = Annotated[str, typer.Option("--store", help="SQLite file or database URL that keeps the results")]
ONE_SUITE = Annotated[str | None, typer.Option("--suite", help="name of the suite, where the store has several")]
FAILED = 1


def run(
    suite: Annotated[Path, typer.Argument(help="YAML file, such as benchmarks/suites/smoke.yml")],
    store: STORE = "results.db",
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="cells at a time, one core each")] = 1,
    engine: Annotated[str, typer.Option("--engine", help="local or ray")] = "local",
    ray_address: Annotated[
        str | None, typer.Option("--ray-address", help="of a Ray cluster; by default one is started here")
    ] = None,
    runs: Annotated[
        Path | None, typer.Option("--runs", help="folder of the runs; by default beside an SQLite store")
    ] = None,
    method: Annotated[list[str] | None, typer.Option("--method", help="only this one; may be repeated")] = None,
    env: Annotated[list[str] | None, typer.Option("--env", help="only this domain; may be repeated")] = None,
    seed: Annotated[list[int] | None, typer.Option("--seed", help="only this one; may be repeated")] = None,
) -> None:
    """Run the cells of a suite that are not done yet: a training each, then its evaluation.

    It can be interrupted at any moment, killed too, and goes on when it is called again. Several calls, on several
    machines, may work on one store.
    """
    from sb3_progpolicy.benchmark.engines import make_engine
    from sb3_progpolicy.benchmark.runner import run_suite
    from sb3_progpolicy.benchmark.store import open_store
    from sb3_progpolicy.benchmark.suite import load_suite
    from sb3_progpolicy.experiment.run import terminable

    loaded = load_suite(suite)
    selected = _selected(loaded, {"method": method, "env": env, "seed": seed})
    with open_store(store) as opened, terminable():
        folder = runs or _beside(store)
        with _Display(jobs) as display:
            made = make_engine(engine, jobs, folder, ray_address)
            progress = run_suite(loaded, opened, made, str(suite), display.show, selected)
        for key, error in opened.errors([cell.key for cell in selected]).items():
            name = next(cell.name for cell in selected if cell.key == key)
            typer.echo(f"{name}: {error}; its log is in {folder / key}", err=True)
    if progress.failed:
        raise typer.Exit(FAILED)


def status(store: Annotated[str, typer.Argument(help="SQLite file or database URL")], suite: ONE_SUITE = None) -> None:
    """Show how far a suite is."""
    from collections import Counter

    from rich.table import Table

    from sb3_progpolicy.benchmark.store import DONE, FAILED, RUNNING, WAITING, open_store

    with open_store(store, create=False) as opened:
        cells = opened.cells(suite)
    kinds = (DONE, RUNNING, WAITING, FAILED)
    table = Table()
    for name in ("method", *kinds):
        table.add_column(name, justify="left" if name == "method" else "right")
    for method in dict.fromkeys(cell["method"] for cell in cells):
        counts = Counter(cell["status"] for cell in cells if cell["method"] == method)
        table.add_row(method, *(str(counts[kind] or "") for kind in kinds))
    plain_console().print(table)


def export(
    store: Annotated[str, typer.Argument(help="SQLite file or database URL")],
    as_json: Annotated[bool, typer.Option("--json", help="as a JSON list")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="as CSV, the default")] = False,
    curves: Annotated[bool, typer.Option("--curves", help="the training curves instead of the rows")] = False,
    archive: Annotated[
        Path | None, typer.Option("--archive", help="everything, as a .json.gz file for 'benchmark import'")
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="file; by default standard output")] = None,
    suite: ONE_SUITE = None,
) -> None:
    """Print the rows of a suite: one for each cell, variation and, where there is a program, semantics."""
    from sb3_progpolicy.benchmark.archive import write_archive
    from sb3_progpolicy.benchmark.export import as_csv, curve_rows
    from sb3_progpolicy.benchmark.store import open_store

    if as_json and csv:
        raise ValueError("--json and --csv are not accepted together")
    if archive is not None and (as_json or csv or curves or output):
        raise ValueError("--archive is not accepted together with --json, --csv, --curves or --output")
    for path, option in ((output, "-o"), (archive, "--archive")):
        if path is not None:
            check_folder(path, option)
    with open_store(store, create=False) as opened:
        if archive is not None:
            write_archive(opened, suite, archive)
            return
        rows = curve_rows(opened.cells(suite)) if curves else opened.rows(suite)
    text = json.dumps(rows, indent=1) + "\n" if as_json else as_csv(rows)
    if output is None:
        typer.echo(text, nl=False)
        return
    from sb3_progpolicy.programs.files import write_atomically

    write_atomically(output, text)


def import_(
    archive: Annotated[Path, typer.Argument(help="file of 'benchmark export --archive'")], store: STORE = "results.db"
) -> None:
    """Take over the results of another store, such as another machine's; what this one has it keeps."""
    from sb3_progpolicy.benchmark.archive import read_archive, take_over
    from sb3_progpolicy.benchmark.store import open_store

    content = read_archive(archive)
    with open_store(store) as opened:
        new, known = take_over(opened, content)
        outside = opened.n_outside()
    typer.echo(f"{new} cells taken over, {known} known already")
    if outside:
        typer.echo(
            f"{outside} of all cells here are of seeds or settings that the store's suite does not have, and in no "
            "table; 'benchmark run' with a suite that has them takes them in",
            err=True,
        )


def report(
    store: Annotated[str, typer.Argument(help="SQLite file or database URL")],
    output: Annotated[Path, typer.Option("-o", "--output", help="folder to write to; made if it does not exist")],
    suite: ONE_SUITE = None,
) -> None:
    """Write tables (Markdown, LaTeX, CSV), pictures and one HTML page that needs nothing else."""
    from sb3_progpolicy.benchmark.report import write_report
    from sb3_progpolicy.benchmark.store import open_store

    with open_store(store, create=False) as opened:
        cells, rows = opened.cells(suite), opened.rows(suite)
        name = suite or opened.suites()[0]
    page = write_report(name, cells, rows, output)
    typer.echo(str(page))


COMMANDS: dict[str, Callable[..., None]] = {
    "run": run,
    "status": status,
    "export": export,
    "import": import_,
    "report": report,
}


def _beside(store: str) -> Path:
    """Return the folder of the runs beside an SQLite file; for another database it is named after that, and here."""
    path = store.removeprefix("sqlite:///")
    return Path(f"{path.rpartition('/')[2] if '://' in path else path}.runs")


def _selected(suite: Suite, wanted: dict[str, Any]) -> list[Any]:
    from sb3_progpolicy.nearest import unknown

    known: dict[str, list[Any]] = {
        "method": list(dict.fromkeys(cell.method for cell in suite.cells)),
        "env": list(dict.fromkeys(cell.config.env for cell in suite.cells)),
        "seed": list(dict.fromkeys(cell.config.seed for cell in suite.cells)),
    }
    for name, values in wanted.items():
        for value in values or ():
            if value not in known[name]:
                raise unknown(f"{name} of the suite", str(value), [str(entry) for entry in known[name]])
    return [
        cell
        for cell in suite.cells
        if all(
            not wanted[name] or value in wanted[name]
            for name, value in (("method", cell.method), ("env", cell.config.env), ("seed", cell.config.seed))
        )
    ]


class _Display:
    """A table that shows what is being run, what is done, what is left and when it will end."""

    def __init__(self, jobs: int) -> None:
        from rich.live import Live

        self.jobs = jobs
        self.console = plain_console(stderr=True)
        self.live = Live(console=self.console, refresh_per_second=1, transient=True)
        self._said: set[str] = set()

    def __enter__(self) -> _Display:
        if self.console.is_terminal:
            self.live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        if self.console.is_terminal:
            self.live.__exit__(*error)

    def show(self, progress: Progress) -> None:
        """Draw the table, or say in a line what has ended where there is no terminal."""
        if self.console.is_terminal:
            self.live.update(self._table(progress))
        for kind in ("done", "failed"):
            for cell in progress.cells:
                if cell.key in getattr(progress, kind) and cell.key not in self._said:
                    self._said.add(cell.key)
                    if not self.console.is_terminal:
                        count = f"{len(progress.done) + len(progress.failed)}/{len(progress.cells)}"
                        self.console.print(f"{count} {cell.name}: {kind}", highlight=False, soft_wrap=True)

    def _table(self, progress: Progress) -> Any:
        from rich.table import Table

        now = time.monotonic()
        remaining = progress.remaining(self.jobs, now)
        counts = f"{len(progress.done)} done, {len(progress.running)} running, {progress.left} left"
        counts += f", {len(progress.elsewhere)} elsewhere" if progress.elsewhere else ""
        counts += f", {len(progress.failed)} failed" if progress.failed else ""
        end = "" if remaining is None else time.strftime(", ends about %H:%M", time.localtime(time.time() + remaining))
        table = Table(title=counts + end)
        for name in ("method", "domain", "seed", "steps", "time"):
            table.add_column(name, justify="right" if name in ("seed", "steps", "time") else "left")
        for cell in progress.cells:
            if cell.key in progress.running:
                began, steps = progress.running[cell.key]
                share = f"{steps / cell.config.n_timesteps:.0%}"
                minutes = f"{(now - began) / 60:.0f} min"
                table.add_row(cell.method, cell.config.env, str(cell.config.seed), share, minutes)
        return table
