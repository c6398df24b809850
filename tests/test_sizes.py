"""``python benchmarks/sizes.py`` on one task."""

import csv
import sys
from pathlib import Path

import pytest

pytest.importorskip("sklearn")
BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def test_sizes_of_a_program_a_network_and_a_tree_for_one_task(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import sizes
    import study

    monkeypatch.setattr(study, "RESULTS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["sizes.py", "--envs", "Hanoi-v0", "--episodes", "1", "--rounds", "1"])
    sizes.main()
    assert "tree, depth 8" in capsys.readouterr().out
    with (tmp_path / "sizes.csv").open() as file:
        program, simple, network, tree = csv.DictReader(file)
    assert (program["numbers"], program["mul_add"], program["comparisons"]) == ("108", "210", "5")
    assert (program["success"], program["unseen_success"]) == ("1.0", "1.0")
    assert (simple["policy"], simple["numbers"], simple["unseen_success"]) == ("program, simplified", "24", "1.0")
    # 17 inputs, two layers of 64 and 6 scores; the constants start at 0.
    assert int(network["numbers"]) == 64 * 17 + 64 * 64 + 6 * 64
    assert int(network["mul_add"]) == 2 * int(network["numbers"])
    assert network["success"] == ""
    assert (tree["mul_add"], tree["policy"].split(",")[1]) == ("0", " depth 8")
    assert '"scikit-learn"' in (tmp_path / "sizes.json").read_text()
