"""A suite's results as a file, and back."""

import gzip
import json

import pytest

from sb3_progpolicy.benchmark.archive import read_archive, take_over, write_archive
from sb3_progpolicy.benchmark.cell import CellResult
from sb3_progpolicy.benchmark.store import open_store
from sb3_progpolicy.benchmark.suite import parse_suite
from sb3_progpolicy.cli import run
from tests.benchmark.small import RESULT, ROW, SMALL

SUITE = parse_suite(SMALL)
KEYS = [cell.key for cell in SUITE.cells]


def fill(url, done, result=RESULT):
    with open_store(url) as store:
        store.add(SUITE, ["first", "second"])
        for key in done:
            assert store.finish(key, result)


def state(url):
    with open_store(url) as store:
        return store.rows("small"), store.cells("small"), store.statuses(KEYS)


def test_archive_holds_all_that_the_store_knows(url, tmp_path):
    result = CellResult(
        rows=[ROW, {**ROW, "semantics": None, "optimal_steps_mean": None}],
        curve=[{"timesteps": 1}], program="{}", timesteps=9, capped=True, versions={"python": "3"}, commit="abc",
    )  # fmt: skip
    fill(url, KEYS[:1], result)
    archive, other = tmp_path / "small.json.gz", str(tmp_path / "other.db")
    with open_store(url) as store:
        write_archive(store, None, archive)
    with open_store(other) as store:
        assert take_over(store, read_archive(archive)) == (1, 0)
        assert take_over(store, read_archive(archive)) == (0, 1)
    assert state(other) == state(url)
    with open_store(other) as store:
        write_archive(store, "small", tmp_path / "again.json.gz")
    assert (tmp_path / "again.json.gz").read_bytes() == archive.read_bytes()


def test_what_two_machines_did_apart_comes_together(tmp_path, capsys):
    stores = [str(tmp_path / f"{name}.db") for name in "ab"]
    for store, key, steps in zip(stores, KEYS, (63.0, 70.0), strict=True):
        fill(store, [key], CellResult(rows=[{**ROW, "steps_mean": steps}]))
    archive = str(tmp_path / "b.json.gz")
    assert run(["benchmark", "export", stores[1], "--archive", archive]) == 0
    assert run(["benchmark", "import", archive, "--store", stores[0]]) == 0
    said = capsys.readouterr()
    assert "1 cells taken over, 0 known already" in said.out
    assert "in no table" not in said.err
    rows, _, statuses = state(stores[0])
    assert [(row["seed"], row["steps_mean"]) for row in rows] == [(0, 63.0), (1, 70.0)]
    assert set(statuses.values()) == {"done"}


def test_results_of_another_configuration_do_not_change_the_suite(tmp_path, capsys):
    old = parse_suite({**SMALL, "episodes": 2})
    archive, store = tmp_path / "old.json.gz", str(tmp_path / "now.db")
    with open_store(str(tmp_path / "old.db")) as opened:
        opened.add(old, ["old"] * 2)
        opened.finish(old.cells[0].key, RESULT)
        write_archive(opened, None, archive)
    fill(store, KEYS[:1])
    before = state(store)
    with open_store(store) as opened:
        assert take_over(opened, read_archive(archive)) == (1, 0)
        assert opened.n_outside() == len(old.cells)
    assert state(store) == before
    capsys.readouterr()
    assert run(["benchmark", "import", str(archive), "--store", store]) == 0
    assert f"{len(old.cells)} of all cells here are of seeds or settings" in capsys.readouterr().err


def packed(document):
    """Without the time, which would make other test names in each process that collects them."""
    text = document if isinstance(document, str) else json.dumps(document)
    return gzip.compress(text.encode(), mtime=0)


@pytest.mark.parametrize(("content", "message"), [
    (b"", "is not what"),
    (b"{}", "Not a gzipped file"),
    (packed("{"), "is not what"),
    (packed("[]"), "another format"),
    (packed({"format": "sb3-progpolicy benchmark", "version": 9}), "version 9; this.* 1"),
    (packed({"format": "sb3-progpolicy benchmark", "version": 1})[:-9], "is not what"),
    (packed({"format": "sb3-progpolicy benchmark", "version": 1, "suite": "x", "cells": [{"cell": {}}]}),
     "is not what"),
])  # fmt: skip
def test_other_files_are_refused(tmp_path, content, message):
    (tmp_path / "archive").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_archive(tmp_path / "archive")


def test_missing_file_is_named_and_no_store_made(tmp_path, capsys):
    store = tmp_path / "s.db"
    assert run(["benchmark", "import", str(tmp_path / "nowhere.gz"), "--store", str(store)]) == 2
    assert "nowhere.gz does not exist" in capsys.readouterr().err
    assert not store.exists()
