"""A condition that is on or off: what it does, and how it is printed. All exports are tested with it, too."""

import dataclasses
import re

import matplotlib
import numpy as np
import pytest

from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.programs import (
    ActionSpec,
    Condition,
    Controller,
    IfThenElse,
    Program,
    ProgramRunner,
    export_graphviz,
    export_latex,
    export_python,
    export_text,
    load_program,
    plot_program,
)

matplotlib.use("Agg")
NAMES = ("rises", "falls", "noise")
SWITCH = Condition(
    "switch", ((2.0, 0.0, 0.0), (0.0, 1.0, -0.5)), ((0.0,), (0.0,)), (-1.0, -0.75), (0.0, 0.0), (1.0,), -0.5
)


def program(condition=SWITCH):
    controllers = (Controller(((0.0,) * 3, (0.0,) * 3), bias) for bias in ((0.0, 1.0), (1.0, 0.0)))
    body = IfThenElse(condition, *controllers)
    return Program(body, 3, ActionSpec("discrete", (2,)), False, NAMES, ("low", "high"))


def test_it_turns_on_and_off_and_stays_between_and_on_wins():
    runner = ProgramRunner(program())
    inputs = [(0, 0, 0), (1, 0, 0), (0, 0, 0), (0, 0.5, 0), (0, 1, 0), (0, 0, 0), (1, 1, 0), (0, 0.5, -1), (0.5, 0, 0)]
    held = [int(runner.act([step])[0]) for step in inputs]
    assert held == [0, 1, 1, 1, 0, 0, 1, 0, 1], "off at first, on at 0 already"
    runner.reset()
    assert runner.act([(0, 0, 0)])[0] == 0


def test_file_keeps_it(tmp_path):
    program().save(tmp_path / "switch.json")
    assert load_program(tmp_path / "switch.json") == program()


def test_text():
    assert export_text(program()).partition("\n\n")[2].partition("\n\n")[2] == (
        "B1 = 0.50 while on, -0.50 while off\n"
        "    on when  -1 + 2*rises >= 0\n"
        "    off when -0.75 + falls - 0.50*noise >= 0\n"
        "\n"
        "Switch: a step turns it on where its first line holds, off where only the second does; else it stays.\n"
        "All memory starts at 0 and is kept until the task changes.\n"
    )


@pytest.mark.parametrize(("constant", "often"), [(-1.0, "never"), (0.0, "always")])
def test_what_reads_nothing_happens_always_or_never(constant, often):
    latch = dataclasses.replace(SWITCH, weight_ih=(SWITCH.weight_ih[0], (0.0,) * 3), bias_ih=(-1.0, constant))
    assert f"    on when  -1 + 2*rises >= 0\n    off {often}\n" in export_text(program(latch))
    assert f"\\noff {often}" in export_graphviz(program(latch))
    axes = plot_program(program(latch))
    assert f"off {often}" in [text.get_text() for text in axes.texts]
    matplotlib.pyplot.close(axes.figure)


def test_text_of_switches_that_read_each_other():
    two = dataclasses.replace(
        SWITCH, weight_ih=SWITCH.weight_ih * 2, weight_hh=((0.0, 0.0), (0.0, 3.0), (0.0, 0.0), (0.0, 0.0)),
        bias_ih=SWITCH.bias_ih * 2, bias_hh=(0.0,) * 4, readout=(1.0, 1.0),
    )  # fmt: skip
    text = export_text(program(two))
    assert "B1 = -0.50 + h1 + h2\n    its memory: 2 switch units\n" in text
    assert "    h2 on when -0.75 + 3*h2 + falls - 0.50*noise >= 0\n" in text
    assert "    h1 off when -1 + 2*rises >= 0\n" in text


def test_other_prints():
    dot = export_graphviz(program())
    assert "B1 = 0.50 while on, -0.50 while off\\non when  -1  +2 rises  >= 0\\noff when  " in dot
    latex = export_latex(program())
    assert r"1 & \text{if } p \ge 0 \\ 0 & \text{else if } q \ge 0 \\ h_{1} & \text{otherwise}" in latex
    assert r"\text{(rows: on, off)}" in latex
    axes = plot_program(program(), decimals=2)
    rows = {}
    for text in axes.texts:
        rows.setdefault(text.get_position()[1], []).append(text.get_text())
    matplotlib.pyplot.close(axes.figure)
    lines = [" ".join(row) for row in rows.values()]
    minus = "\N{MINUS SIGN}"
    assert any(f"B1 = 0.50 while on, {minus}0.50 while off" in line for line in lines)
    assert any(f"on when  {minus}1 +2 rises ≥ 0" in line for line in lines)
    assert any(f"off when {minus}0.75 +falls {minus}0.50 noise ≥ 0" in line for line in lines)


def test_python_needs_no_tanh_and_its_variables_are_no_names_of_inputs():
    source = export_python(dataclasses.replace(program(), input_names=("on1_1", "off1_1", "h1_1")))
    assert "tanh" not in source
    assert re.search(r"h1_1 = 1\.0 if on1_1 >= 0\.0 else 0\.0 if off1_1 >= 0\.0 else h1_1", source)
    namespace = {"__name__": "exported"}
    exec(source, namespace)
    policy, runner = namespace["ProgramPolicy"](), ProgramRunner(program())
    for inputs in np.random.default_rng(0).integers(0, 2, size=(60, 3)).astype(float):
        assert policy.act(inputs) == runner.act(inputs[None])[0]


def test_it_has_no_gradient_and_training_from_it_is_refused():
    with pytest.raises(ValueError, match="cell='switch' is not accepted"):
        ReptilePPO("ProgPolicy", "Acrobot-v1", n_envs=1, policy_kwargs={"cell": "switch"})
    with pytest.raises(ValueError, match="init_program: a switch has no gradient"):
        ReptilePPO("ProgPolicy", "Acrobot-v1", n_envs=1, init_program=program())
