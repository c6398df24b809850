"""The benchmark: suites are checked, and cells are done once however they are interrupted."""

import json
import multiprocessing
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from progpolicy_envs import DOMAINS
from sb3_progpolicy.benchmark.cell import CellResult, run_cell, trained_variations
from sb3_progpolicy.benchmark.engines import LocalEngine, Outcome, make_engine
from sb3_progpolicy.benchmark.runner import Progress, reproduction, run_suite
from sb3_progpolicy.benchmark.store import Store, open_store
from sb3_progpolicy.benchmark.suite import Cell, load_suite, parse_suite
from sb3_progpolicy.cli import run
from sb3_progpolicy.experiment.methods import METHODS

SUITES = Path(__file__).parents[1] / "benchmarks" / "suites"
SMALL = {
    "name": "small",
    "methods": {"ppo": {"n_envs": 4, "n_steps": 32, "batch_size": 64, "n_timesteps": 256}},
    "domains": {"Hanoi-v0": {"max_steps": 20}},
    "seeds": [0, 1],
    "episodes": 1,
    "curve_points": 2,
    "curve_episodes": 1,
}
ROW = {
    "set": "unseen",
    "relation": "extrapolated",
    "variation": {"n_discs": 6},
    "semantics": "crisp",
    "episodes": 1,
    "success_rate": 1.0,
    "steps_mean": 63.0,
    "steps_std": 0.0,
    "optimal_steps_mean": 63.0,
}
RESULT = CellResult(rows=[ROW], timesteps=256, versions={"python": "3"}, commit="abc")


def store_url(kind, folder):
    """SQLite always, PostgreSQL where the address of one is given."""
    if kind == "sqlite":
        return str(folder / "results.db")
    url = os.environ.get("PROGPOLICY_TEST_POSTGRESQL")
    if url is None:
        pytest.skip("PROGPOLICY_TEST_POSTGRESQL has no address of a PostgreSQL database")
    import sqlalchemy as sa

    engine = sa.create_engine(url)
    with engine.begin() as connection:
        for table in ("rows", "members", "cells"):
            connection.execute(sa.text(f"DROP TABLE IF EXISTS {table}"))
    engine.dispose()
    return url


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path):
    return store_url(request.param, tmp_path)


@pytest.mark.parametrize("name", ["smoke", "planning", "panda", "paper"])
def test_shipped_suites_are_accepted(name):
    suite = load_suite(SUITES / f"{name}.yml")
    assert suite.name == name
    assert len({cell.key for cell in suite.cells}) == len(suite.cells)
    if name != "paper":
        compared = {method for method, entry in METHODS.items() if entry.compared}
        assert {cell.method for cell in suite.cells} == compared
        assert len(compared) == 9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds": [0, 0]}, "seeds=.* is not accepted"),
        ({"seeds": 3}, "seeds=3 is not accepted"),
        ({"methods": {"ppoo": {}}}, "unknown algorithm 'ppoo'; nearest: ppo"),
        ({"methods": {"ppo": {"n_stepps": 3}}}, "ppo on Hanoi-v0: unknown hyperparameter 'n_stepps'; nearest: n_steps"),
        ({"methods": ["ppo"]}, "methods=.* is not accepted; it is a mapping"),
        ({"domains": {"CartPole-v1": {}}}, "'CartPole-v1' is not one of this package's environments"),
        ({"episodes": 0}, "episodes=0 is not accepted; it is a whole number from 1"),
        ({"episods": 3}, "unknown entry 'episods'; nearest: episodes"),
        ({"max_minutes": "long"}, "max_minutes='long' is not accepted; it is a number from 0"),
        ({"name": None}, "name is missing"),
    ],
)
def test_mistake_in_a_suite_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        parse_suite({**SMALL, **change})


def test_variant_of_a_method_has_a_name_of_its_own():
    suite = parse_suite({**SMALL, "methods": {"long": {"algo": "ppo", "n_timesteps": 512}, "ppo": {}}})
    long, usual = suite.cells[:2]
    assert (long.method, long.config.algo, long.config.n_timesteps) == ("long", "ppo", 512)
    assert (usual.method, usual.config.n_timesteps) == ("ppo", 1_000_000)
    assert Cell.from_json(json.loads(json.dumps(long.to_json()))).key == long.key


def test_key_follows_from_all_that_decides_the_result():
    changes = [{}, {"episodes": 2}, {"max_minutes": 1}, {"domains": {"Hanoi-v0": {}}}, {"curve_points": 3}]
    changes.append({"methods": {"ppo": {"gamma": 0.9}}})
    keys = {parse_suite({**SMALL, **change}).cells[0].key for change in changes}
    assert len(keys) == len(changes)
    assert parse_suite(SMALL).cells[0].key == parse_suite({**SMALL, "name": "other"}).cells[0].key


def test_what_a_configuration_trains_on():
    hanoi = DOMAINS["Hanoi-v0"]
    methods = {"ppo": {}, "prl": {}, "reptile_ppo": {}, "two": {"algo": "reptile_ppo", "tasks": {"n_discs": [1, 2]}}}
    suite = parse_suite({**SMALL, "methods": methods, "seeds": [0]})
    trained = [trained_variations(cell.config, hanoi) for cell in suite.cells]
    fixed = {"n_discs": 3, "source": 0, "target": 2}
    assert trained == [(fixed,), (fixed,), hanoi.train, ({**fixed, "n_discs": 1}, {**fixed, "n_discs": 2})]


def test_cell_has_a_row_for_each_variation_and_semantics(tmp_path):
    suite = parse_suite({**SMALL, "methods": {"reptile_ppo": {"n_timesteps": 4096}}, "seeds": [0]})
    result = run_cell(suite.cells[0], tmp_path)
    found = [(row["set"], row["relation"], row["variation"]["n_discs"], row["semantics"]) for row in result.rows]
    expected = [("train", "trained", n, kind) for kind in ("soft", "crisp") for n in (1, 2, 3, 4)]
    assert found == expected + [("unseen", "extrapolated", n, kind) for kind in ("soft", "crisp") for n in (6, 7, 8)]
    assert all(row["steps_mean"] <= 20 for row in result.rows)
    assert [point["variation"] for point in result.curve] == [{"n_discs": 5}] * len(result.curve)
    assert len(result.curve) >= 2
    assert json.loads(result.program)["format"] == "sb3-progpolicy program"
    assert (result.timesteps, result.capped) == (4096, False)
    again = run_cell(suite.cells[0], tmp_path)
    assert (again.rows, again.curve) == (result.rows, result.curve), "trained already: evaluated again"


def test_limit_on_processor_time_ends_training_and_is_noted(tmp_path):
    suite = parse_suite({**SMALL, "methods": {"ppo": {"n_timesteps": 10_000_000}}, "max_minutes": 0.01})
    result = run_cell(suite.cells[0], tmp_path)
    assert result.capped
    assert result.timesteps < 1_000_000
    assert 0.5 < result.processor_seconds < 20


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


@pytest.mark.parametrize("victim", ["runner", "worker"])
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


def test_methods_with_discrete_and_box_actions_run_on_both(tmp_path):
    pytest.importorskip("pybullet")
    methods = {"sac": {"learning_starts": 32}, "hiro": {"learning_starts": 96, "high_learning_starts": 112}}
    domains = {env: {"n_timesteps": 160, "max_steps": 5} for env in ("Hanoi-v0", "PandaReach-v0")}
    suite = parse_suite({**SMALL, "methods": methods, "domains": domains, "seeds": [0]})
    for cell in suite.cells:
        result = run_cell(cell, tmp_path / cell.key)
        assert result.timesteps == 160
        assert np.isfinite([row["steps_mean"] for row in result.rows]).all()
