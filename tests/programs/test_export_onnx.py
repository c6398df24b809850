"""The ONNX model, run by onnxruntime, against the interpreter."""

import io
import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from sb3_progpolicy import load_pretrained, pretrained_names
from sb3_progpolicy.programs import ProgramRunner, export_onnx
from sb3_progpolicy.programs.interpreter import _distribution
from sb3_progpolicy.programs.syntax import STATELESS
from tests.programs.hostile import with_hostile_texts
from tests.programs.strategies import CELLS, KINDS, build_program, hanoi_program, small_program

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
TIE = 1e-9  # runtimes add in another order


def session(program, semantics="crisp"):
    buffer = io.BytesIO()
    export_onnx(program, buffer, semantics)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(buffer.getvalue(), options, providers=["CPUExecutionProvider"])


def memory(runner):
    """The runner's memory by the names of the model's inputs."""
    held = {}
    for index, cell in enumerate(runner._cells, start=1):
        if cell.cell not in STATELESS:
            held[f"h{index}"] = cell.h
        if cell.cell == "lstm":
            held[f"c{index}"] = cell.c
    return {name: value.copy() for name, value in held.items()}


def decided(runner, taken):
    """Rows in which neither a condition nor a choice hangs on the last bits; of a Box the conditions count."""
    action = runner.program.action
    sure = np.all(np.abs(runner.condition_values) > TIE, axis=1)
    if action.kind == "multi_binary":
        threshold = 0.5 if runner.semantics == "soft" else 0.0
        return sure & np.all(np.abs(taken - threshold) > TIE, axis=1)
    if action.kind == "box":
        return sure
    for part in np.split(taken, np.cumsum(action.sizes)[:-1], axis=1):
        if part.shape[1] > 1:
            best = np.sort(part, axis=1)
            sure &= best[:, -1] - best[:, -2] > TIE
    return sure


def check_step(model, runner, x):
    """One step of both from the same memory; return the share of rows in which the action was compared."""
    given = memory(runner)
    seen = {}
    choose = runner._choose

    def watched(outputs):
        seen["outputs"] = outputs
        return choose(outputs)

    runner._choose = watched
    expected = runner.act(x)
    runner._choose = choose
    names = [output.name for output in model.get_outputs()]
    got = dict(zip(names, model.run(None, {"x": x, **given}), strict=True))
    action = got.pop("action")
    assert (action.shape, action.dtype) == (expected.shape, expected.dtype)
    close = {"controller_outputs": seen["outputs"]}
    close |= {f"{name}_next": value for name, value in memory(runner).items()}
    if runner.program.conditions:
        close["condition_values"] = runner.condition_values
    sure = np.all(np.abs(runner.condition_values) > TIE, axis=1)
    np.testing.assert_allclose(got.pop("mixture_weights")[sure], runner.mixture_weights[sure], rtol=1e-9, atol=1e-12)
    assert set(got) == set(close)
    for name, value in close.items():
        np.testing.assert_allclose(got[name], value, rtol=1e-9, atol=1e-10)
    outputs = seen["outputs"]
    if runner.semantics == "soft":
        outputs = _distribution(runner.program.action, outputs)
    sure = decided(runner, np.einsum("nk,nko->no", runner.mixture_weights, outputs))
    if runner.program.action.kind == "box":
        np.testing.assert_allclose(action[sure], expected[sure], rtol=1e-6, atol=1e-7)
    else:
        np.testing.assert_array_equal(action[sure], expected[sure])
    return sure.mean()


@pytest.mark.parametrize("semantics", ["crisp", "soft"])
@pytest.mark.parametrize("kind", KINDS)
def test_model_computes_what_the_runner_does_step_by_step(kind, semantics):
    shares = []
    for seed in range(len(CELLS)):
        program = build_program(seed, [*CELLS[seed:], *CELLS[:seed]], kind, bool(seed % 2), hidden_size=seed + 1)
        model, runner, rng = (
            session(program, semantics),
            ProgramRunner(program, 200, semantics),
            np.random.default_rng(1),
        )
        shares += [check_step(model, runner, rng.normal(size=(200, program.n_inputs))) for _ in range(10)]
    assert np.mean(shares) > 0.6, "some programs have an output that is 0, and a tie is decided by rounding"


@pytest.mark.parametrize("semantics", ["crisp", "soft"])
@pytest.mark.parametrize("cell", CELLS)
def test_model_carries_its_memory_through_a_game(cell, semantics):
    program = hanoi_program(seed=3, cell=cell)
    model, runner, rng = session(program, semantics), ProgramRunner(program, 50, semantics), np.random.default_rng(0)
    state, outputs = memory(runner), [output.name for output in model.get_outputs()]
    for _ in range(20):
        x = rng.choice([-1.0, 0.0, 0.5, 1.0], size=(50, 17))
        got = dict(zip(outputs, model.run(None, {"x": x, **state}), strict=True))
        state = {name: got[f"{name}_next"] for name in state}
        expected = runner.act(x)
        np.testing.assert_allclose(got["condition_values"], runner.condition_values, rtol=1e-6, atol=1e-6)
    assert np.mean(got["action"] == expected) > 0.9


@pytest.mark.parametrize("semantics", ["crisp", "soft"])
@pytest.mark.parametrize("name", pretrained_names())
def test_model_of_a_shipped_program_takes_its_actions(name, semantics):
    program = load_pretrained(name)
    x = np.random.default_rng(0).normal(size=(5_000, program.n_inputs))
    assert check_step(session(program, semantics), ProgramRunner(program, 5_000, semantics), x) > 0.99


@pytest.mark.parametrize("semantics", ["crisp", "soft"])
@pytest.mark.parametrize("kind", KINDS)
def test_model_of_one_controller_without_inputs_runs(kind, semantics):
    program = build_program(1, [], kind, False, n_observations=0)
    check_step(session(program, semantics), ProgramRunner(program, 3, semantics), np.zeros((3, 0)))


def test_first_condition_that_is_exactly_zero_decides():
    program = build_program(1, ["affine", "affine"], "discrete", False)
    program = replace(program, body=replace(program.body, condition=replace(
        program.conditions[0], readout=(0.0,) * 5, readout_bias=0.0
    )))  # fmt: skip
    (weights,) = session(program).run(["mixture_weights"], {"x": np.ones((1, 5))})
    assert weights.tolist() == [[1.0, 0.0, 0.0]]


def test_file_says_its_names_and_is_the_same_every_time(tmp_path):
    program = with_hostile_texts(small_program(np.random.default_rng(3)), np.random.default_rng(4))
    paths = [tmp_path / "a.onnx", tmp_path / "b.onnx"]
    for path in paths:
        assert export_onnx(program, path) is None
    assert paths[0].read_bytes() == paths[1].read_bytes()
    model = onnx.load(paths[0])
    onnx.checker.check_model(model, full_check=True)
    texts = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    assert texts["input_names"] == list(program.input_names)
    assert texts["output_names"] == list(program.output_names)
    assert texts["semantics"] == "crisp"


def test_missing_onnx_and_unknown_semantics_are_named(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="semantics='hard' is not accepted; it is 'crisp' or 'soft'"):
        export_onnx(hanoi_program(), tmp_path / "x.onnx", "hard")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match=r'pip install "sb3-progpolicy\[onnx\]"'):
        export_onnx(hanoi_program(), tmp_path / "x.onnx")
    assert not (tmp_path / "x.onnx").exists()
