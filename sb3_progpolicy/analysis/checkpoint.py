"""How far a verification has come, in a file, so that an interrupted one goes on."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_progpolicy.programs.files import write_atomically

#: Seconds between two writes.
INTERVAL = 30.0


class Checkpoint:
    """The state of a verification: rows of variations that are done, and the counts of the present one.

    :param path: of the file; ``None`` keeps nothing. One that exists is gone on from
    :param origin: what the verification is of, as JSON values
    :raises ValueError: if the file is of another verification or is damaged
    """

    def __init__(self, path: Path | None, origin: Mapping[str, Any]) -> None:
        self.path, self.origin = path, json.loads(json.dumps(dict(origin)))
        self.rows: list[dict[str, Any]] = []
        self.counts: dict[str, Any] = {}
        self._written = time.monotonic()
        if path is not None and path.exists():
            self._read(path)

    def _read(self, path: Path) -> None:
        try:
            state = json.loads(path.read_text(encoding="utf-8"))
            known, self.rows, self.counts = state["origin"], list(state["rows"]), dict(state["counts"])
            different = [name for name in {**known, **self.origin} if known.get(name) != self.origin.get(name)]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is not the state of a verification ({error}); remove it to begin anew") from None
        if different:
            raise ValueError(
                f"{path} is of a verification with another {', '.join(different)}; give the same arguments, or remove "
                "it to begin anew"
            )

    def row(self, row: Mapping[str, Any]) -> None:
        """Note that a variation is done."""
        self.rows.append(dict(row))
        self.counts = {}
        self._write()

    def count(self, counts: Mapping[str, Any]) -> None:
        """Note how far the present variation is; it is written every :data:`INTERVAL` seconds."""
        self.counts = dict(counts)
        if time.monotonic() - self._written >= INTERVAL:
            self._write()

    def _write(self) -> None:
        self._written = time.monotonic()
        if self.path is not None:
            state = {"origin": self.origin, "rows": self.rows, "counts": self.counts}
            write_atomically(self.path, json.dumps(state, allow_nan=False) + "\n")
