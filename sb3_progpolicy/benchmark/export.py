"""Rows of a benchmark as text, and training curves as rows."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as CSV; mappings are written as JSON, ``None`` as nothing.

    :param rows: with the same names in all; those of the first make the header
    """
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: json.dumps(v, sort_keys=True) if isinstance(v, Mapping) else v for k, v in row.items()})
    return buffer.getvalue()


def curve_rows(cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the training curves of cells, one row for each evaluation and variation.

    :param cells: of :meth:`~sb3_progpolicy.benchmark.store.Store.cells`
    """
    names = ("timesteps", "variation", "success_rate", "steps_mean", "steps_std", "optimal_steps_mean")
    return [
        {"method": cell["method"], "env": cell["env"], "seed": cell["seed"], **{name: point[name] for name in names}}
        for cell in cells
        if cell["result"] is not None
        for point in cell["result"]["curve"]
    ]
