"""What runs cells: processes of this machine, or a Ray cluster. Both call ``run_cell`` and nothing else."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sb3_progpolicy.benchmark.cell import NOTES, CellResult, run_cell
from sb3_progpolicy.benchmark.suite import Cell
from sb3_progpolicy.cluster import join_cluster
from sb3_progpolicy.experiment.run import Interrupted, terminable
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.programs.files import write_atomically

CELL, OUTCOME, LOG = "cell.json", "outcome.json", "log.txt"
#: Seconds that a worker has to save what it can go on from.
PATIENCE = 60.0


@dataclass(frozen=True)
class Outcome:
    """How a cell ended.

    :param key: of the cell
    :param result: what came of it
    :param error: why nothing did
    :param interrupted: whether it can be gone on with, its process having been stopped or killed
    """

    key: str
    result: CellResult | None = None
    error: str = ""
    interrupted: bool = False


class Engine(ABC):
    """Runs up to ``jobs`` cells at a time.

    :param jobs: number of cells
    :param folder: of the runs
    """

    def __init__(self, jobs: int, folder: Path) -> None:
        self.jobs, self.folder = jobs, folder

    @property
    @abstractmethod
    def running(self) -> list[str]:
        """Keys of the cells that are being run."""

    @abstractmethod
    def start(self, cell: Cell) -> None:
        """Begin with a cell, or go on with it."""

    @abstractmethod
    def wait(self, seconds: float) -> list[Outcome]:
        """Wait until a cell has ended, some seconds at most, and return those that have."""

    @abstractmethod
    def stop(self) -> list[Outcome]:
        """Interrupt all cells, let them save what they can go on from, and return how they ended."""

    def timesteps(self, key: str) -> int:
        """Return how far the training of a cell is, in environment steps, as far as is known."""
        try:
            return int(json.loads((self.folder / key / NOTES).read_text(encoding="utf-8"))["timesteps"])
        except (OSError, ValueError, LookupError):
            return 0


class LocalEngine(Engine):
    """One process for each cell at a time. It ends with this process, however that ends."""

    def __init__(self, jobs: int, folder: Path) -> None:
        super().__init__(jobs, folder)
        # Processes of a server that has imported what they need begin at once. Where there is no such, each imports.
        methods = multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            self._context.set_forkserver_preload(["sb3_progpolicy.benchmark.engines"])
        self._workers: dict[str, tuple[Any, Connection]] = {}

    @property
    def running(self) -> list[str]:
        """Keys of the cells that are being run."""
        return list(self._workers)

    def start(self, cell: Cell) -> None:
        """Begin with a cell, or go on with it."""
        folder = self.folder / cell.key
        folder.mkdir(parents=True, exist_ok=True)
        (folder / OUTCOME).unlink(missing_ok=True)
        write_atomically(folder / CELL, json.dumps(cell.to_json()))
        ours, theirs = self._context.Pipe()
        worker = self._context.Process(target=_work, args=(str(folder), theirs))
        worker.start()
        theirs.close()  # so that the worker, which waits for the end of the other one, sees it when this process ends
        self._workers[cell.key] = (worker, ours)

    def wait(self, seconds: float) -> list[Outcome]:
        """Wait until a cell has ended, some seconds at most, and return those that have."""
        end = time.monotonic() + seconds
        while True:
            ended = [key for key, (worker, _) in self._workers.items() if worker.exitcode is not None]
            if ended or time.monotonic() >= end:
                return [self._outcome(key) for key in ended]
            time.sleep(0.05)

    def stop(self) -> list[Outcome]:
        """Interrupt all cells, let them save what they can go on from, and return how they ended."""
        for worker, _ in self._workers.values():
            worker.terminate()
        end = time.monotonic() + PATIENCE
        for worker, _ in self._workers.values():
            worker.join(max(0.0, end - time.monotonic()))
            if worker.exitcode is None:
                worker.kill()
                worker.join()
        return [self._outcome(key) for key in list(self._workers)]

    def _outcome(self, key: str) -> Outcome:
        worker, pipe = self._workers.pop(key)
        pipe.close()
        path = self.folder / key / OUTCOME
        if not path.is_file():
            return Outcome(key, error=f"its process ended with {worker.exitcode}", interrupted=True)
        return read_outcome(key, json.loads(path.read_text(encoding="utf-8")))


class RayEngine(Engine):
    """Tasks of a Ray cluster: one that runs already, by its address, or one that is started on this machine.

    :param jobs: number of cells at a time
    :param folder: of the runs, on each machine
    :param address: of a cluster, such as ``"auto"``; ``None`` starts one here
    :raises ValueError: if Ray is not installed, or the cluster cannot be reached
    """

    def __init__(self, jobs: int, folder: Path, address: str | None = None) -> None:
        super().__init__(jobs, folder)
        self._ray, self._started = join_cluster(address, jobs)
        self._remote = self._ray.remote(num_cpus=1, max_retries=0)(outcome_of)
        self._tasks: dict[Any, str] = {}

    @property
    def running(self) -> list[str]:
        """Keys of the cells that are being run."""
        return list(self._tasks.values())

    def start(self, cell: Cell) -> None:
        """Begin with a cell, or go on with it where its folder is on the machine that gets it."""
        self._tasks[self._remote.remote(cell.to_json(), str(self.folder.absolute() / cell.key))] = cell.key

    def wait(self, seconds: float) -> list[Outcome]:
        """Wait until a cell has ended, some seconds at most, and return those that have."""
        if not self._tasks:
            time.sleep(seconds)
            return []
        ended, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=seconds)
        outcomes = []
        for task in ended:
            key = self._tasks.pop(task)
            try:
                outcomes.append(read_outcome(key, self._ray.get(task)))
            except self._ray.exceptions.RayError as error:
                outcomes.append(Outcome(key, error=str(error).partition("\n")[0], interrupted=True))
        return outcomes

    def stop(self) -> list[Outcome]:
        """Cancel all cells; what they had saved at their last checkpoint stays."""
        for task in self._tasks:
            self._ray.cancel(task, force=True)
        outcomes = [Outcome(key, error="interrupted", interrupted=True) for key in self._tasks.values()]
        self._tasks.clear()
        if self._started:
            self._ray.shutdown()
        return outcomes


def _local(jobs: int, folder: Path, address: str | None) -> Engine:
    if address is not None:
        raise ValueError("--ray-address is accepted with --engine ray only")
    return LocalEngine(jobs, folder)


ENGINES = MappingProxyType({"local": _local, "ray": RayEngine})


def make_engine(name: str, jobs: int, folder: Path, address: str | None = None) -> Engine:
    """Return an engine.

    :param name: ``"local"`` or ``"ray"``
    :param jobs: number of cells at a time, at least 1
    :param folder: of the runs
    :param address: of a Ray cluster
    :raises ValueError: if a value is not accepted
    """
    if name not in ENGINES:
        raise unknown("engine", name, ENGINES)
    if jobs < 1:
        raise ValueError(f"jobs={jobs} is not accepted; it is at least 1")
    return ENGINES[name](jobs, folder, address)


def outcome_of(described: Mapping[str, Any], folder: str) -> dict[str, Any]:
    """Run a cell and return how it ended, as JSON values.

    :param described: the cell
    :param folder: of its run
    """
    try:
        return {"result": vars(run_cell(Cell.from_json(described), Path(folder)))}
    except (Interrupted, KeyboardInterrupt):
        return {"error": "interrupted", "interrupted": True}
    except Exception as error:  # whatever it is belongs to this cell; the others go on
        line = str(error).partition("\n")[0]
        return {"error": f"{type(error).__name__}: {line}"}


def read_outcome(key: str, described: Mapping[str, Any]) -> Outcome:
    """Return what :func:`outcome_of` described.

    :param key: of the cell
    :param described: how it ended
    """
    result = described.get("result")
    return Outcome(
        key,
        result=None if result is None else CellResult(**result),
        error=described.get("error", ""),
        interrupted=described.get("interrupted", False),
    )


def _end_with(pipe: Connection) -> None:
    """Wait for the end of the other process and end this one at once."""
    with contextlib.suppress(EOFError, OSError):
        pipe.recv()
    os._exit(1)


def _work(folder: str, pipe: Connection) -> None:
    """Run the cell that is described in a folder: what a process of :class:`LocalEngine` does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the runner's; it then asks for an end by SIGTERM
    with (Path(folder) / LOG).open("ab") as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
    threading.Thread(target=_end_with, args=(pipe,), daemon=True).start()
    with terminable():
        outcome = outcome_of(json.loads((Path(folder) / CELL).read_text(encoding="utf-8")), folder)
    write_atomically(Path(folder) / OUTCOME, json.dumps(outcome))
