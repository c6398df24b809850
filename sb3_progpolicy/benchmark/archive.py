"""Everything that a store knows of a suite, as one compressed file: to keep, and to merge what machines did apart."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_progpolicy.benchmark.cell import CellResult
from sb3_progpolicy.benchmark.store import Store
from sb3_progpolicy.benchmark.suite import Cell, Suite
from sb3_progpolicy.programs.files import write_atomically

FORMAT, VERSION = "sb3-progpolicy benchmark", 1
MAX_BYTES = 2**30


def write_archive(store: Store, suite: str | None, path: Path) -> None:
    """Write a suite's cells and what came of them: rows, curves, programs.

    :param store: which has them
    :param suite: its name; may be left out where there is only one
    :param path: of the file, JSON compressed with gzip
    :raises ValueError: if there is no such suite
    """
    name = store.checked_suite(suite)
    rows = store.raw_rows(name)
    cells = [
        {
            "cell": cell["cell"],
            "command": cell["command"],
            "result": None if cell["result"] is None else {**cell["result"], "rows": rows[cell["key"]]},
        }
        for cell in store.cells(name)
    ]
    content = json.dumps({"format": FORMAT, "version": VERSION, "suite": name, "cells": cells}, separators=(",", ":"))
    write_atomically(path, gzip.compress(content.encode(), mtime=0))


@dataclass(frozen=True)
class Archive:
    """What a file of :func:`write_archive` holds.

    :param suite: its cells
    :param commands: that reproduce them, one each
    :param results: of them, one each; ``None`` where there is none
    """

    suite: Suite
    commands: list[str]
    results: list[CellResult | None]


def read_archive(path: Path) -> Archive:
    """Read a file of :func:`write_archive` and check all of it.

    :param path: of the file
    :raises ValueError: if it is not such a file
    """
    try:
        with gzip.open(path) as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES} bytes are not accepted")
        described = json.loads(content)
        if not isinstance(described, Mapping) or described.get("format") != FORMAT:
            raise ValueError("it has another format")
        if described.get("version") != VERSION:
            raise ValueError(f"it has version {described.get('version')!r:.20}; this release reads {VERSION}")
        entries: list[Mapping[str, Any]] = described["cells"]
        suite = Suite(described["suite"], tuple(Cell.from_json(entry["cell"]) for entry in entries))
        results = [None if entry["result"] is None else CellResult(**entry["result"]) for entry in entries]
        return Archive(suite, [entry["command"] for entry in entries], results)
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist") from None
    except (OSError, EOFError, zlib.error, ValueError, TypeError, LookupError) as error:
        raise ValueError(f"{path} is not what 'benchmark export --archive' writes: {error}") from None


def take_over(store: Store, archive: Archive) -> tuple[int, int]:
    """Take over results from an archive. A cell that the store has a result of keeps it.

    :param store: to take them over into
    :param archive: which has them
    :return: how many results were new, and how many were known
    """
    store.add(archive.suite, archive.commands, keep_members=True)
    pairs = zip(archive.suite.cells, archive.results, strict=True)
    new = [store.finish(cell.key, result) for cell, result in pairs if result]
    return sum(new), len(new) - sum(new)
