"""Which branch acts at which step."""

import matplotlib
import numpy as np
import pytest

from sb3_progpolicy import load_pretrained
from sb3_progpolicy.analysis.activity import plot_activity, record_activity
from sb3_progpolicy.cli import run
from sb3_progpolicy.programs import ProgramRunner

matplotlib.use("Agg")


@pytest.fixture(scope="module")
def pushed():
    return record_activity(load_pretrained("PandaPush-v0"), variation={"n_objects": 2}, seed=1)


def test_recorded_branches_are_those_that_the_interpreter_takes(pushed):
    runner = ProgramRunner(pushed.program, len(pushed.inputs))
    runner.act(pushed.inputs)
    np.testing.assert_array_equal(pushed.branches, runner.branch)
    assert pushed.success
    assert pushed.shares.sum() == pytest.approx(1)
    assert len(pushed.shares) == len(pushed.program.controllers)


def test_each_step_is_filled_in_exactly_one_row(pushed):
    axes = plot_activity(pushed)
    filled = np.full(len(pushed.branches), -1)
    for row, bars in enumerate(axes.collections):
        for path in bars.get_paths():
            (left, _), (right, _) = path.vertices.min(axis=0), path.vertices.max(axis=0)
            assert (filled[round(left) : round(right)] == -1).all()
            filled[round(left) : round(right)] = row
    np.testing.assert_array_equal(filled, pushed.branches)
    assert len(axes.get_yticklabels()) == len(pushed.program.controllers)
    assert len(axes.lines) >= 1  # an object was finished
    assert "n_objects=2: at the goal after" in axes.get_title(loc="left")
    matplotlib.pyplot.close(axes.figure)


def test_program_without_conditions_has_one_row():
    axes = plot_activity(record_activity(load_pretrained("Hanoi-v0"), variation={"n_discs": 3}))
    assert [label.get_text() for label in axes.get_yticklabels()] == ["always"]
    matplotlib.pyplot.close(axes.figure)


def test_command_line_draws_it(tmp_path, capsys):
    picture = tmp_path / "activity.png"
    arguments = ["show", "Hanoi-v0", "--format", "activity", "-o", str(picture), "--set"]
    assert run([*arguments, "n_discs=3"]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert run([*arguments, "n_discs=3,4"]) == 2
    assert "gives 2 variations; activity shows one" in capsys.readouterr().err
