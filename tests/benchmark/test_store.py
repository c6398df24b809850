"""Cells are counted once, however many runners there are and whichever of them die."""

import multiprocessing
import os
import sqlite3
import subprocess
import sys
from contextlib import closing

import pytest

from sb3_progpolicy.benchmark.cell import CellResult
from sb3_progpolicy.benchmark.store import Store, open_store
from sb3_progpolicy.benchmark.suite import parse_suite
from sb3_progpolicy.cli import run
from tests.benchmark.small import RESULT, ROW, SMALL


def test_two_runners_never_take_the_same_cell(url):
    suite = parse_suite({**SMALL, "seeds": list(range(20))})
    keys = [cell.key for cell in suite.cells]
    one, other = Store(url), Store(url)
    for store in (one, other):
        store.add(suite, ["command"] * len(keys))
    taken = [store.claim(keys) for _ in range(10) for store in (one, other)]
    assert sorted(taken) == sorted(keys)
    assert one.claim(keys) is None
    one.release(keys[0])
    other.release(keys[1])
    assert {one.statuses(keys)[key] for key in keys[:2]} <= {"waiting", "running"}
    for store in (one, other):
        store.close()


def claim_all(url, keys, pipe):
    store = Store(url)
    taken = []
    while (key := store.claim(keys)) is not None:
        taken.append(key)
    pipe.send(taken)
    store.close()


def test_runners_in_processes_share_the_cells(url):
    suite = parse_suite({**SMALL, "seeds": list(range(40))})
    keys = [cell.key for cell in suite.cells]
    with open_store(url) as store:
        store.add(suite, ["command"] * len(keys))
    context = multiprocessing.get_context("spawn")
    pipes, processes = [], []
    for _ in range(2):
        ours, theirs = context.Pipe()
        processes.append(context.Process(target=claim_all, args=(url, keys, theirs)))
        processes[-1].start()
        pipes.append(ours)
    taken = [key for pipe in pipes for key in pipe.recv()]
    for process in processes:
        process.join()
    # A runner that has ended gives its cells to the other, on this machine at once; none is held by both at a time.
    assert set(taken) == set(keys)


def test_result_counts_once_and_wholly(url):
    suite = parse_suite(SMALL)
    keys = [cell.key for cell in suite.cells]
    one, other = Store(url), Store(url)
    one.add(suite, ["first", "second"])
    assert one.claim(keys) == keys[0]
    with pytest.raises(Exception, match=r"(?i)constraint"):  # the same row twice: nothing of the result is kept
        one.finish(keys[0], CellResult(rows=[ROW, ROW]))
    assert one.statuses(keys)[keys[0]] == "running"
    assert one.rows("small") == []
    assert one.finish(keys[0], RESULT)
    assert not other.finish(keys[0], RESULT), "a runner that was thought dead comes back"
    assert [(row["seed"], row["steps_mean"], row["command"]) for row in other.rows("small")] == [(0, 63.0, "first")]
    for store in (one, other):
        store.close()


def test_cell_of_a_dead_runner_is_taken_over_but_not_for_ever(tmp_path, monkeypatch):
    suite = parse_suite(SMALL)
    keys = [cell.key for cell in suite.cells]
    store = Store(str(tmp_path / "results.db"))
    store.add(suite, ["", ""])
    process = subprocess.Popen([sys.executable, "-c", "pass"])
    process.wait()
    here = store.owner.split(":")[0]
    for attempt in range(3):
        monkeypatch.setattr(store, "owner", f"{here}:{process.pid}:{attempt}")
        assert store.claim(keys[:1]) == keys[0]
    assert store.claim(keys[:1]) is None
    assert store.statuses(keys)[keys[0]] == "failed"
    assert store.errors(keys) == {keys[0]: "its process died 3 times"}
    store.retry_failed(keys)
    monkeypatch.setattr(store, "owner", "elsewhere:1:x")
    assert store.claim(keys[:1]) == keys[0]
    monkeypatch.setattr(store, "owner", f"{here}:{os.getpid()}:y")
    assert store.claim(keys[:1]) is None, "another machine's runner has shown life"
    monkeypatch.setattr("sb3_progpolicy.benchmark.store.STALE", -1.0)
    assert store.claim(keys[:1]) == keys[0]
    store.close()


def test_reading_makes_nothing_in_another_programs_database(tmp_path, capsys):
    path = tmp_path / "other.db"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE notes (text)")
    before = path.read_bytes()
    assert run(["benchmark", "status", str(path)]) == 2
    assert "is not a store: it has no table cells, members, rows" in capsys.readouterr().err
    assert path.read_bytes() == before


@pytest.mark.parametrize("prefix", ["", "sqlite:///"])
def test_reading_makes_no_store(tmp_path, capsys, prefix):
    path = tmp_path / "none.db"
    assert run(["benchmark", "status", f"{prefix}{path}"]) == 2
    assert "none.db does not exist" in capsys.readouterr().err
    assert not path.exists()
