"""Runs a suite to the end: hands cells to an engine, keeps what comes back, and shows how far it is."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sb3_progpolicy.benchmark.engines import Engine, Outcome
from sb3_progpolicy.benchmark.store import DONE, FAILED, MAX_ATTEMPTS, RUNNING, Store
from sb3_progpolicy.benchmark.suite import Cell, Suite

#: Seconds between two signs of life.
LIFE = 20.0
#: Seconds between two looks at what other runners do.
LOOK = 1.0


@dataclass
class Progress:
    """How far a suite is.

    :param cells: of the suite
    :param done: keys of those that are done
    :param failed: keys of those that cannot be done
    :param elsewhere: keys of those that other runners work on
    :param running: for each cell that is being run here, when it began and how many steps it has made
    :param seconds: that the cells done here took
    """

    cells: Sequence[Cell]
    done: set[str] = field(default_factory=set)
    failed: set[str] = field(default_factory=set)
    elsewhere: set[str] = field(default_factory=set)
    running: dict[str, tuple[float, int]] = field(default_factory=dict)
    seconds: list[tuple[str, float]] = field(default_factory=list)

    @property
    def left(self) -> int:
        """How many cells nobody has begun with."""
        return len(self.cells) - len(self.done) - len(self.failed) - len(self.running) - len(self.elsewhere)

    def remaining(self, jobs: int, now: float) -> float | None:
        """Return the seconds until all is done, from what cells of the same method took; ``None`` before the first.

        :param jobs: cells at a time
        :param now: by the clock that :attr:`running` is read with
        """
        if not self.seconds:
            return None
        method = {cell.key: cell.method for cell in self.cells}
        by_method: dict[str, list[float]] = {}
        for key, seconds in self.seconds:
            by_method.setdefault(method[key], []).append(seconds)
        overall = sum(seconds for _, seconds in self.seconds) / len(self.seconds)
        expected = {name: sum(values) / len(values) for name, values in by_method.items()}
        ended = self.done | self.failed | self.elsewhere
        total = 0.0
        for cell in self.cells:
            if cell.key in ended:
                continue
            began = self.running.get(cell.key)
            spent = 0.0 if began is None else now - began[0]
            total += max(0.0, expected.get(cell.method, overall) - spent)
        return total / jobs


def run_suite(
    suite: Suite,
    store: Store,
    engine: Engine,
    source: str,
    report: Callable[[Progress], None] = lambda progress: None,
    selected: Sequence[Cell] | None = None,
) -> Progress:
    """Run the cells of a suite that are not done yet.

    Several runners may do so with one store. An interruption (Ctrl-C, a termination) lets the cells save what they can
    go on from; after a ``kill -9`` the next call goes on from their last checkpoints.

    :param suite: what to run
    :param store: of the results
    :param engine: what runs the cells
    :param source: the suite's file, as it stands in the command that reproduces a cell
    :param report: is called about once a second
    :param selected: those of the suite's cells that are to be run; all by default
    :return: where it stands in the end
    """
    cells = {cell.key: cell for cell in (suite.cells if selected is None else selected)}
    keys = list(cells)
    store.add(suite, [reproduction(source, cell) for cell in suite.cells])
    store.retry_failed(keys)
    progress = Progress(list(cells.values()))
    attempts: dict[str, int] = {}
    last_sign = time.monotonic()
    try:
        while True:
            while len(engine.running) < engine.jobs and (key := store.claim(keys)) is not None:
                progress.running[key] = (time.monotonic(), 0)
                engine.start(cells[key])
            statuses = store.statuses(keys)
            progress.done = {key for key, status in statuses.items() if status == DONE}
            progress.failed = {key for key, status in statuses.items() if status == FAILED}
            running = {key for key, status in statuses.items() if status == RUNNING}
            progress.elsewhere = running - set(engine.running)
            if not running and not engine.running and not progress.left:
                break
            for key in engine.running:
                progress.running[key] = (progress.running[key][0], engine.timesteps(key))
            report(progress)
            for outcome in engine.wait(LOOK):
                _keep(outcome, store, progress, attempts)
            if time.monotonic() - last_sign >= LIFE:
                last_sign = time.monotonic()
                store.show_life()
    finally:
        for outcome in engine.stop():
            if outcome.result is not None:
                store.finish(outcome.key, outcome.result)
            else:
                store.release(outcome.key)
    report(progress)
    return progress


def _keep(outcome: Outcome, store: Store, progress: Progress, attempts: dict[str, int]) -> None:
    began, _ = progress.running.pop(outcome.key)
    if outcome.result is not None:
        store.finish(outcome.key, outcome.result)
        progress.seconds.append((outcome.key, time.monotonic() - began))
        return
    attempts[outcome.key] = attempts.get(outcome.key, 0) + 1
    if outcome.interrupted and attempts[outcome.key] < MAX_ATTEMPTS:
        store.release(outcome.key)
    else:
        store.fail(outcome.key, outcome.error)


def reproduction(source: str, cell: Cell) -> str:
    """Return the command that runs one cell alone.

    :param source: the suite's file
    :param cell: of it
    """
    name = shlex.quote(Path(source).name if Path(source).is_absolute() else source)
    chosen = f"--method {shlex.quote(cell.method)} --env {shlex.quote(cell.config.env)} --seed {cell.config.seed}"
    return f"progpolicy benchmark run {name} {chosen} --store one.db"
