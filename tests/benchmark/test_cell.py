"""What a cell trains on and returns."""

import dataclasses
import json

import numpy as np
import pytest

from progpolicy_envs import DOMAINS
from sb3_progpolicy.benchmark import cell as cells
from sb3_progpolicy.benchmark.cell import run_cell
from sb3_progpolicy.benchmark.suite import parse_suite
from sb3_progpolicy.evaluation import evaluate_any
from sb3_progpolicy.experiment.run import trained_variations
from tests.benchmark.small import SMALL


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


def test_an_environment_without_a_goal_is_refused_by_name(tmp_path, monkeypatch):
    def without_goal(*arguments, **options):
        return [dataclasses.replace(row, success_rate=None) for row in evaluate_any(*arguments, **options)]

    monkeypatch.setattr(cells, "evaluate_any", without_goal)
    suite = parse_suite({**SMALL, "methods": {"reptile_ppo": {"n_timesteps": 64}}, "seeds": [0]})
    with pytest.raises(ValueError, match="Hanoi-v0 reports no is_success at the end of an episode"):
        run_cell(suite.cells[0], tmp_path)


def test_limit_on_processor_time_ends_training_and_is_noted(tmp_path):
    suite = parse_suite({**SMALL, "methods": {"ppo": {"n_timesteps": 10_000_000}}, "max_minutes": 0.01})
    result = run_cell(suite.cells[0], tmp_path)
    assert result.capped
    assert result.timesteps < 1_000_000
    assert 0.5 < result.processor_seconds < 20


def test_methods_with_discrete_and_box_actions_run_on_both(tmp_path):
    pytest.importorskip("pybullet")
    methods = {"sac": {"learning_starts": 32}, "hiro": {"learning_starts": 96, "high_learning_starts": 112}}
    domains = {env: {"n_timesteps": 160, "max_steps": 5} for env in ("Hanoi-v0", "PandaReach-v0")}
    suite = parse_suite({**SMALL, "methods": methods, "domains": domains, "seeds": [0]})
    for cell in suite.cells:
        result = run_cell(cell, tmp_path / cell.key)
        assert result.timesteps == 160
        assert np.isfinite([row["steps_mean"] for row in result.rows]).all()
