"""Suites are run to the end through interruptions and kills, on every engine."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sb3_progpolicy.benchmark.engines import LocalEngine, Outcome, make_engine
from sb3_progpolicy.benchmark.runner import Progress, reproduction, run_suite
from sb3_progpolicy.benchmark.store import Store, open_store
from sb3_progpolicy.benchmark.suite import parse_suite
from sb3_progpolicy.cli import run
from tests.benchmark.small import RESULT, SMALL


def test_suite_is_run_once_and_exported(tmp_path, capsys):
    file, store = tmp_path / "suite.yml", tmp_path / "results.db"
    file.write_text(json.dumps(SMALL))
    command = ["benchmark", "run", str(file), "--store", str(store), "--jobs", "2"]
    assert run(command) == 0
    assert run(["benchmark", "export", str(store), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 2 * 7
    assert {(row["method"], row["env"], row["seed"]) for row in rows} == {
        ("ppo", "Hanoi-v0", 0),
        ("ppo", "Hanoi-v0", 1),
    }
    assert {row["relation"] for row in rows if row["set"] == "train"} == {"easier", "trained", "extrapolated"}
    row = rows[0]
    assert row["command"] == "progpolicy benchmark run suite.yml --method ppo --env Hanoi-v0 --seed 0 --store one.db"
    assert row["versions"].startswith("python=3")
    assert (row["timesteps"], row["capped"], row["semantics"]) == (256, False, None)
    before = time.monotonic()
    assert run(command) == 0
    assert time.monotonic() - before < 10, "what is done is not done again"
    assert run(["benchmark", "export", str(store), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == rows

    file.write_text(json.dumps({**SMALL, "episodes": 2}))
    assert run([*command, "--seed", "0"]) == 0
    assert run(["benchmark", "export", str(store), "--json"]) == 0
    changed = json.loads(capsys.readouterr().out)
    assert {(row["seed"], row["episodes"]) for row in changed} == {(0, 2)}, (
        "rows of the old configuration are not mixed in"
    )

    assert run(["benchmark", "export", str(store), "--curves"]) == 0
    header, *points = capsys.readouterr().out.splitlines()
    assert header.startswith("method,env,seed,timesteps,variation")
    assert len(points) == 3, "before, in the middle and at the end"
    assert run(["benchmark", "status", str(store)]) == 0
    assert "ppo" in capsys.readouterr().out

    assert run(["benchmark", "report", str(store), "-o", str(tmp_path / "report")]) == 0
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert {"index.html", "table.md", "table.tex", "table.csv", "curves.svg", "curves.png"} <= names


def test_mistakes_on_the_command_line_are_named(tmp_path, capsys):
    file, store = tmp_path / "suite.yml", tmp_path / "results.db"
    file.write_text(json.dumps(SMALL))
    for arguments, message in [
        (["run", str(file), "--store", str(store), "--method", "pppo"], "unknown method of the suite 'pppo'"),
        (["run", str(file), "--store", str(store), "--engine", "slurm"], "unknown engine 'slurm'"),
        (["run", str(file), "--store", str(store), "--ray-address", "auto"], "--engine ray only"),
        (["run", str(tmp_path / "none.yml"), "--store", str(store)], "none.yml"),
        (["export", str(tmp_path / "none.db")], "none.db does not exist"),
        (["export", str(store), "--suite", "other"], "the store has: none"),
        (["export", str(store), "--json", "--csv"], "not accepted together"),
        (["run", str(file), "--store", "nodialect://here"], "cannot be opened as a store"),
    ]:
        assert run(["benchmark", *arguments]) == 2, arguments
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("victim", ["runner", pytest.param("worker", marks=pytest.mark.slow)])
def test_killed_cells_are_gone_on_with_to_the_same_rows(tmp_path, capsys, victim):
    settings = {"n_timesteps": 98_304, "n_envs": 32, "n_steps": 32, "length_coef": 0.0}
    suite = {**SMALL, "methods": {"reptile_ppo": settings}, "seeds": [0]}
    file = tmp_path / "suite.yml"
    file.write_text(json.dumps(suite))
    command = [sys.executable, "-c", "from sb3_progpolicy.cli import main; main()", "benchmark", "run", str(file)]
    stores = {name: tmp_path / f"{name}.db" for name in ("whole", "killed")}
    assert run(["benchmark", "run", str(file), "--store", str(stores["whole"])]) == 0
    runner = subprocess.Popen([*command, "--store", str(stores["killed"])], stderr=subprocess.DEVNULL)
    (key,) = [cell.key for cell in parse_suite(suite).cells]
    model = tmp_path / "killed.db.runs" / key / "model.zip"
    deadline = time.monotonic() + 120
    while not model.is_file():
        assert time.monotonic() < deadline
        assert runner.poll() is None
        time.sleep(0.02)
    if victim == "runner":
        runner.kill()
        runner.wait()
        assert run(["benchmark", "run", str(file), "--store", str(stores["killed"])]) == 0
    else:
        os.kill(worker_of(runner.pid), signal.SIGKILL)
        assert runner.wait(180) == 0
    capsys.readouterr()
    rows = []
    for store in stores.values():
        assert run(["benchmark", "export", str(store), "--json"]) == 0
        own = json.loads(capsys.readouterr().out)
        for row in own:
            for name in ("processor_seconds", "wall_seconds"):
                del row[name]
        rows.append(own)
    assert rows[0] == rows[1]
    assert len(rows[0]) == 14
    curves = [Store(str(store)).cells("small")[0]["result"]["curve"] for store in stores.values()]
    assert curves[0] == curves[1]


def worker_of(pid):
    """Return the process that has a run folder's lock: a grandchild, which the fork server has made."""
    families = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        families.setdefault(int(fields[1]), []).append(int(status.parent.name))
    grandchildren = [grandchild for child in families.get(pid, []) for grandchild in families.get(child, [])]
    assert grandchildren, "only where there is /proc"
    return max(grandchildren)


def test_interrupted_run_gives_its_cells_back(tmp_path):
    suite = {**SMALL, "methods": {"ppo": {"n_timesteps": 100_000_000}}, "seeds": [0]}
    file, store = tmp_path / "suite.yml", tmp_path / "results.db"
    file.write_text(json.dumps(suite))
    command = [
        sys.executable,
        "-c",
        "from sb3_progpolicy.cli import main; main()",
        "benchmark",
        "run",
        str(file),
        "--store",
        str(store),
    ]
    runner = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not list((tmp_path / "results.db.runs").glob("*/config.yml")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    runner.terminate()
    _, said = runner.communicate(timeout=90)
    assert runner.returncode == 130, said
    assert sqlite3.connect(store).execute("SELECT status, owner FROM cells").fetchall() == [("waiting", None)]


class Scripted(LocalEngine):
    """An engine whose cells end as told."""

    def __init__(self, jobs, folder, endings):
        super().__init__(jobs, folder)
        self.endings, self.begun = endings, []

    @property
    def running(self):
        return [key for key in self.begun if key is not None]

    def start(self, cell):
        self.begun.append(cell.key)

    def wait(self, seconds):
        key = self.begun.pop()
        return [Outcome(key, **self.endings.pop(0))]

    def stop(self):
        return []


def test_cell_that_fails_is_named_and_the_others_go_on(tmp_path):
    suite = parse_suite(SMALL)
    lost, broken, done = {"interrupted": True, "error": "gone"}, {"error": "ValueError: no"}, {"result": RESULT}
    seen = []
    with open_store(str(tmp_path / "results.db")) as store:
        engine = Scripted(1, tmp_path, [lost, done, broken])
        progress = run_suite(suite, store, engine, "suite.yml", lambda now: seen.append(len(now.done)))
        assert (len(progress.done), len(progress.failed)) == (1, 1)
        assert list(store.errors([cell.key for cell in suite.cells]).values()) == ["ValueError: no"]
        again = run_suite(suite, store, Scripted(1, tmp_path, [done]), "suite.yml")
        assert (len(again.done), len(again.failed)) == (2, 0), "a later call tries again what has failed"
    assert seen[-1] == 1


def test_time_that_is_left_is_told_from_cells_of_the_same_method():
    suite = parse_suite({**SMALL, "methods": {"ppo": {}, "sac": {}}, "seeds": [0, 1]})
    ppo, sac, ppo_1, sac_1 = (cell.key for cell in suite.cells)
    progress = Progress(suite.cells)
    assert progress.remaining(1, now=0) is None
    progress.done, progress.seconds = {ppo, sac}, [(ppo, 10.0), (sac, 100.0)]
    progress.running = {sac_1: (50.0, 0)}
    assert progress.remaining(2, now=80.0) == (10 + (100 - 30)) / 2
    assert progress.left == 1
    assert ppo_1 not in progress.running


def test_reproduction_names_one_cell():
    cell = parse_suite({**SMALL, "methods": {"as printed": {"algo": "ppo"}}}).cells[0]
    expected = "progpolicy benchmark run s.yml --method 'as printed' --env Hanoi-v0 --seed 0 --store one.db"
    assert reproduction("s.yml", cell) == expected


def test_ray_and_processes_give_equal_rows(tmp_path, capsys):
    pytest.importorskip("ray")
    file = tmp_path / "suite.yml"
    file.write_text(json.dumps(SMALL))
    rows = []
    for engine in ("local", "ray"):
        store = tmp_path / f"{engine}.db"
        assert run(["benchmark", "run", str(file), "--store", str(store), "--engine", engine, "--jobs", "2"]) == 0
        capsys.readouterr()
        assert run(["benchmark", "export", str(store), "--json"]) == 0
        own = json.loads(capsys.readouterr().out)
        rows.append([{k: v for k, v in row.items() if not k.endswith("_seconds")} for row in own])
    assert rows[0] == rows[1]
    assert len(rows[0]) == 14


def test_unknown_engine_and_jobs_are_refused(tmp_path):
    with pytest.raises(ValueError, match="unknown engine 'lokal'; nearest: local"):
        make_engine("lokal", 1, tmp_path)
    with pytest.raises(ValueError, match="jobs=0 is not accepted"):
        make_engine("local", 0, tmp_path)
