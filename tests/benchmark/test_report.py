"""Statistics, tables and pages of a benchmark."""

import csv
import io
import json
import shutil
import subprocess

import numpy as np
import pytest

from sb3_progpolicy.benchmark import tables
from sb3_progpolicy.benchmark.report import write_report
from sb3_progpolicy.benchmark.statistics import interquartile_mean, mean_over_seeds, performance_profile, score_of
from sb3_progpolicy.pretrained import load_pretrained


def row(method="reptile_ppo", n=6, seed=0, steps=63.0, semantics="crisp", success=1.0, part="unseen", **changes):
    return {
        "method": method,
        "env": "Hanoi-v0",
        "seed": seed,
        "set": part,
        "relation": "trained" if part == "train" else "extrapolated",
        "variation": {"n_discs": n},
        "semantics": semantics,
        "episodes": 1,
        "success_rate": success,
        "steps_mean": steps,
        "steps_std": 0.0,
        "optimal_steps_mean": float(2**n - 1),
        "capped": False,
        "versions": "python=3",
        "commit": "abc",
        **changes,
    }


ROWS = [
    *(row(seed=seed) for seed in range(3)),
    *(row(seed=seed, semantics="soft", steps=1.0) for seed in range(3)),
    *(row("ppo", seed=seed, semantics=None, steps=500.0, success=0.0, capped=True) for seed in range(3)),
    *(row(n=7, seed=seed, steps=127.0 * (1 + seed)) for seed in range(3)),
    *(row("ppo", 7, seed, 500.0, None, 0.0) for seed in range(3)),
    *(row("<b>_&", n=3, seed=seed, steps=7.0, semantics=None, part="train") for seed in range(2)),
]


def cell(method, seed, program=None, curve=True):
    points = [
        {"timesteps": t, "variation": {"n_discs": 5}, "steps_mean": 500.0 / (1 + t), "success_rate": 1.0}
        for t in (0, 10)
    ]
    result = {"curve": points if curve else [], "program": program, "processor_seconds": 36.0}
    return {"method": method, "env": "Hanoi-v0", "seed": seed, "result": result}


def test_score_is_the_planners_share_of_the_steps():
    assert score_of(row(steps=63.0)) == 1
    assert score_of(row(steps=126.0)) == 0.5
    assert score_of(row(steps=20.0, success=0.0)) == 0, "a cap below the optimum is no success"
    assert score_of(row(steps=100.0, optimal_steps_mean=None, cap=500)) == 0.8
    assert score_of(row(steps=100.0, optimal_steps_mean=None, cap=200)) == 0.5, "the cap is that of the cell"
    assert score_of(row(steps=100.0, success=0.9, optimal_steps_mean=None, cap=None)) == 0.9


def test_interquartile_mean_leaves_out_the_outer_quarters():
    scores = {"a": np.array([0.0, 0.4, 0.5]), "b": np.array([0.6, 0.7, 1.0, 1.0, 1.0])}
    interval = interquartile_mean(scores)
    assert interval.value == pytest.approx(np.mean([0.5, 0.6, 0.7, 1.0]))
    assert interval.low < interval.value < interval.high <= 1
    assert interquartile_mean(scores) == interval, "the bootstrap has a seed"


def test_bootstrap_draws_seeds_within_each_task():
    # Tasks differ much, seeds little: only an interval within tasks is narrow.
    scores = {"easy": np.array([0.99, 1.0, 1.0, 0.98] * 3), "hard": np.array([0.01, 0.0, 0.02, 0.0] * 3)}
    interval = interquartile_mean(scores)
    assert interval.high - interval.low < 0.05


def test_interval_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    inside = 0
    for _ in range(100):
        interval = mean_over_seeds(rng.normal(0.5, 0.1, 10))
        inside += interval.low <= 0.5 <= interval.high
    assert 80 <= inside <= 100


def test_one_seed_has_no_interval():
    interval = mean_over_seeds(np.array([3.0]))
    assert (interval.low, interval.value, interval.high) == (3.0, 3.0, 3.0)


def test_profile_counts_every_task_alike():
    scores = {"a": np.array([1.0, 0.0]), "b": np.array([0.5] * 8)}
    assert performance_profile(scores, np.array([0.0, 0.4, 0.6, 1.0])).tolist() == [1.0, 0.75, 0.25, 0.25]


def test_table_is_of_crisp_programs():
    found = {(entry.method, entry.variation["n_discs"]): entry for entry in tables.entries(ROWS)}
    assert (found["reptile_ppo", 6].mean, found["reptile_ppo", 6].seeds) == (63.0, 3)
    assert found["reptile_ppo", 7].ratio == pytest.approx(2.0)
    assert found["ppo", 6].capped


def test_markdown_table():
    text = tables.markdown(ROWS).replace("\N{NO-BREAK SPACE}", " ")
    assert "| reptile_ppo | 3 | **63 ± 0 (1.00)** |" in text
    assert "| ppo† | 3 | 500 ± 0 [0%] |" in text, "nobody is best who solves nothing"
    assert "**7 ± 0 (1.00)**°" in text
    assert "6\\*" in text


def test_latex_table_compiles_where_there_is_latex(tmp_path):
    text = tables.latex(ROWS)
    assert "$<$b$>$" in text or "<b>\\_\\&" in text
    if shutil.which("pdflatex") is None:
        pytest.skip("pdflatex is not installed")
    document = "\\documentclass{article}\\usepackage{booktabs}\\begin{document}\n" + text + "\\end{document}\n"
    (tmp_path / "table.tex").write_text(document, encoding="utf-8")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "table.tex"]
    subprocess.run(command, cwd=tmp_path, check=True, stdout=subprocess.DEVNULL, timeout=120)


def test_scores_are_those_of_one_set():
    scores = tables.scores_by_method(ROWS)
    assert set(scores) == {"reptile_ppo", "ppo"}
    assert scores["reptile_ppo"]["Hanoi-v0 7"].tolist() == pytest.approx([1.0, 0.5, 1 / 3])
    assert set(tables.scores_by_method(ROWS, part="train")) == {"<b>_&"}


def test_curves_end_with_the_shortest_seed():
    cells = [cell("ppo", 0), cell("ppo", 1)]
    cells[1]["result"]["curve"].pop()
    times, values = tables.curves_by_method(cells, "Hanoi-v0")["ppo"]
    assert times.tolist() == [0]
    assert values.shape == (2, 1)


def write(folder):
    program = load_pretrained("Hanoi-v0")
    program.save(folder / "program.json")
    text = (folder / "program.json").read_text(encoding="utf-8")
    cells = [cell("reptile_ppo", 0, text), cell("ppo", 0), cell("<b>_&", 0, curve=False)]
    return write_report("a <suite>", cells, ROWS, folder / "report")


def test_page_needs_no_other_file_and_shows_all(tmp_path):
    page = write(tmp_path).read_text(encoding="utf-8")
    assert page.count("<svg") == 3
    for text in ("reptile_ppo", "a &lt;suite&gt;", "&lt;b&gt;_&amp;", "Program for Hanoi-v0", "63 ± 0"):
        assert text in page
    for outside in ("<script", "src=", "@import", "<link", "<b>_&"):
        assert outside not in page
    rows = list(csv.DictReader(io.StringIO((tmp_path / "report" / "table.csv").read_text(encoding="utf-8"))))
    assert json.loads(rows[0]["variation"]) == {"n_discs": 6}
    for name in ("curves", "means_Hanoi-v0", "profiles_Hanoi-v0"):
        assert (tmp_path / "report" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_same_results_give_the_same_page(tmp_path):
    pages = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        pages.append(write(tmp_path / name).read_text(encoding="utf-8"))
    assert pages[0] == pages[1]


def test_page_opens_in_a_browser_without_an_error(tmp_path):
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("Chromium is not installed")
    page = write(tmp_path)
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", f"file://{page}"]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    assert "Learned programs" in shown
    assert shown.count("<tr>") == 1 + 3


def test_nothing_to_report_is_said(tmp_path):
    with pytest.raises(ValueError, match="no cell of planning is done yet"):
        write_report("planning", [], [], tmp_path)
