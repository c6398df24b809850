from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_progpolicy.programs import (
    ActionSpec,
    Condition,
    Controller,
    IfThenElse,
    Program,
    ProgramRunner,
    join_inputs,
)
from tests.programs.strategies import build_program, condition, hanoi_program, programs, seeds

TORCH_CELLS = {"rnn": torch.nn.RNN, "gru": torch.nn.GRU, "lstm": torch.nn.LSTM}


def affine_condition(weights, bias=0.0):
    return Condition("affine", (), (), (), (), tuple(weights), bias)


def box_program(body, n_inputs=2, bound=100.0, temperature=1.0):
    names = tuple(f"x{index}" for index in range(n_inputs))
    return Program(body, n_inputs, ActionSpec("box", (1,), (-bound,), (bound,)), False, names, ("y",), temperature)


def constant(value, n_inputs=2):
    return Controller(((0.0,) * n_inputs,), (value,))


@pytest.mark.parametrize("cell", TORCH_CELLS)
@pytest.mark.parametrize("hidden_size", [1, 3])
def test_conditions_equal_torch_cells(cell, hidden_size):
    rng = np.random.default_rng(0)
    network = TORCH_CELLS[cell](4, hidden_size, dtype=torch.float64)
    parts = {name: parameter.detach().numpy().tolist() for name, parameter in network.named_parameters()}
    readout = tuple(rng.normal(size=hidden_size).tolist())
    test = Condition(
        cell,
        tuple(map(tuple, parts["weight_ih_l0"])),
        tuple(map(tuple, parts["weight_hh_l0"])),
        tuple(parts["bias_ih_l0"]),
        tuple(parts["bias_hh_l0"]),
        readout,
        0.25,
    )
    runner = ProgramRunner(box_program(IfThenElse(test, constant(1.0, 4), constant(0.0, 4)), 4), n_envs=3)
    inputs = rng.normal(scale=3, size=(50, 3, 4))
    hidden, _ = network(torch.as_tensor(inputs))
    expected = hidden.detach().numpy() @ np.array(readout) + 0.25
    for step, x in enumerate(inputs):
        runner.act(x)
        np.testing.assert_allclose(runner.condition_values[:, 0], expected[step], atol=1e-12)


@given(program=programs, seed=seeds)
@settings(max_examples=40, deadline=None)
def test_batch_gives_the_same_bits_as_one_at_a_time(program, seed):
    rng = np.random.default_rng(seed)
    together, alone = ProgramRunner(program, n_envs=3), [ProgramRunner(program) for _ in range(3)]
    for _ in range(20):
        x = rng.normal(size=(3, program.n_inputs))
        actions = together.act(x)
        for row, runner in enumerate(alone):
            np.testing.assert_array_equal(runner.act(x[row : row + 1])[0], actions[row])
        np.testing.assert_array_equal(
            together.condition_values, np.concatenate([runner.condition_values for runner in alone])
        )


@given(program=programs, seed=seeds)
@settings(max_examples=40, deadline=None)
def test_crisp_action_is_that_of_the_first_condition_that_holds(program, seed):
    rng = np.random.default_rng(seed)
    runner = ProgramRunner(program, n_envs=4)
    for _ in range(5):
        x = rng.normal(size=(4, program.n_inputs))
        actions = runner.act(x)
        for row in range(4):
            holds = [bool(value >= 0) for value in runner.condition_values[row]]
            taken = [*holds, True].index(True)
            assert runner.branch[row] == taken
            assert runner.mixture_weights[row].tolist() == [float(k == taken) for k in range(len(program.controllers))]
            controller = program.controllers[taken]
            output = np.array(controller.weights) @ x[row] + controller.bias
            np.testing.assert_allclose(actions[row], expected_action(program.action, output), rtol=1e-6)


def expected_action(action, output):
    if action.kind == "box":
        return np.clip(output, action.low, action.high)
    if action.kind == "multi_binary":
        return output > 0
    if action.kind == "discrete":
        return output.argmax() + action.start
    parts, first = [], 0
    for size in action.sizes:
        parts.append(output[first : first + size].argmax())
        first += size
    return parts


def test_condition_of_exactly_zero_holds():
    program = box_program(IfThenElse(affine_condition((1.0, 0.0)), constant(1.0), constant(2.0)))
    runner = ProgramRunner(program, n_envs=3)
    assert runner.act([[0.0, 0.0], [-1e-300, 0.0], [1.0, 0.0]])[:, 0].tolist() == [1.0, 2.0, 1.0]


def test_condition_that_is_not_reached_still_reads_every_step():
    rng = np.random.default_rng(1)
    inner = condition(rng, "gru", 2, 2)
    reached = box_program(IfThenElse(inner, constant(1.0), constant(2.0)))
    hidden_behind = box_program(IfThenElse(affine_condition((0.0, 0.0), 1.0), constant(0.0), reached.body))
    runner, reference = ProgramRunner(hidden_behind), ProgramRunner(reached)
    for x in rng.normal(size=(10, 1, 2)):
        assert runner.act(x) == 0.0
        reference.act(x)
        assert runner.condition_values[0, 1] == reference.condition_values[0, 0]


def test_memory_is_kept_until_reset():
    program, x = hanoi_program(), np.ones((1, 17))
    runner = ProgramRunner(program)
    runner.act(x)
    first = runner.condition_values.copy()
    runner.act(x)
    assert not np.array_equal(runner.condition_values, first)
    runner.reset()
    runner.act(x)
    np.testing.assert_array_equal(runner.condition_values, first)


@given(program=programs, seed=seeds)
@settings(max_examples=40, deadline=None)
def test_soft_masses_follow_the_formula(program, seed):
    runner = ProgramRunner(program, n_envs=3, semantics="soft")
    runner.act(np.random.default_rng(seed).normal(size=(3, program.n_inputs)))
    chosen = 1 / (1 + np.exp(-runner.condition_values / program.temperature))
    for k in range(len(program.controllers)):
        last = k == len(program.conditions)
        expected = np.prod(1 - chosen[:, :k], axis=1) * (1 if last else chosen[:, k])
        np.testing.assert_allclose(runner.mixture_weights[:, k], expected, atol=1e-12)
    np.testing.assert_allclose(runner.mixture_weights.sum(axis=1), 1)


def two_constants(action, first, second, bias):
    def controller(outputs):
        return Controller(((0.0,),) * len(outputs), tuple(outputs))

    body = IfThenElse(affine_condition((0.0,), bias), controller(first), controller(second))
    return Program(body, 1, action, False, ("x",), tuple(f"y{index}" for index in range(action.n_outputs)))


LOG3 = float(np.log(3))  # sigmoid(log 3) = 3/4


@pytest.mark.parametrize(
    ("action", "first", "second", "crisp", "soft"),
    [
        # 3/4 of (0.45, 0.55, 0) and 1/4 of (1, 0, 0): action 1 leads in the first, action 0 in the mixture
        (ActionSpec("discrete", (3,), start=5), np.log([0.45, 0.55, 1e-9]), [50.0, 0.0, 0.0], 6, 5),
        (
            ActionSpec("multi_discrete", (2, 2)),
            [*np.log([0.45, 0.55]), 0.0, 9.0],
            [50.0, 0.0, 0.0, 9.0],
            [1, 1],
            [0, 1],
        ),
        # 3/4 * 0.45 + 1/4 * 1 is above one half, the output -0.2 is not above zero
        (ActionSpec("multi_binary", (2,)), [np.log(0.45 / 0.55), 1.0], [50.0, 1.0], [0, 1], [1, 1]),
        (ActionSpec("box", (1,), (-9.0,), (9.0,)), [2.0], [6.0], [2.0], [3.0]),
        (ActionSpec("box", (1,), (-9.0,), (2.5,)), [2.0], [6.0], [2.0], [2.5]),
    ],
)
def test_soft_semantics_mixes_what_the_action_space_says(action, first, second, crisp, soft):
    program = two_constants(action, tuple(map(float, first)), tuple(map(float, second)), LOG3)
    np.testing.assert_allclose(ProgramRunner(program).act([[0.0]])[0], crisp)
    np.testing.assert_allclose(ProgramRunner(program, semantics="soft").act([[0.0]])[0], soft, rtol=1e-6)


@given(program=programs, seed=seeds)
@settings(max_examples=30, deadline=None)
def test_soft_semantics_becomes_crisp_as_temperature_falls(program, seed):
    crisp = ProgramRunner(program, n_envs=4)
    soft = ProgramRunner(replace(program, temperature=1e-9), n_envs=4, semantics="soft")
    for x in np.random.default_rng(seed).normal(size=(5, 4, program.n_inputs)):
        expected = crisp.act(x)
        clear = (np.abs(crisp.condition_values) > 1e-6).all(axis=1)
        np.testing.assert_allclose(soft.act(x)[clear], expected[clear], rtol=1e-6)


@pytest.mark.parametrize(("kind", "dtype"), [("discrete", "int64"), ("box", "float32"), ("multi_binary", "int8")])
def test_action_types_are_those_of_gymnasium(kind, dtype):
    program = build_program(0, ["gru"], kind, True)
    assert ProgramRunner(program).act(np.zeros((1, program.n_inputs))).dtype == dtype


def test_inputs_are_joined_in_the_order_of_section_2_4():
    program = replace(hanoi_program(), action=ActionSpec("discrete", (6,), start=10))
    observations = np.arange(18.0).reshape(2, 9)
    joined = join_inputs(program, observations, [10, 13], [0.5, -1.0], [False, True])
    expected = [[*observations[0], 1, 0, 0, 0, 0, 0, 0.5, 0], [*observations[1], 0, 0, 0, 1, 0, 0, -1.0, 1]]
    assert joined.tolist() == expected


def test_before_the_first_action_its_place_is_zero():
    joined = join_inputs(hanoi_program(), np.ones(9))
    assert joined.tolist() == [[1.0] * 9 + [0.0] * 8]


@pytest.mark.parametrize(
    ("action", "given", "expected"),
    [
        (ActionSpec("multi_discrete", (2, 3)), [[1, 0], [0, 2]], [[0, 1, 1, 0, 0], [1, 0, 0, 0, 1]]),
        (ActionSpec("multi_binary", (2,)), [[1, 0], [1, 1]], [[1, 0], [1, 1]]),
        (ActionSpec("box", (2,), (-1.0, -1.0), (1.0, 1.0)), [[0.5, -1], [0, 1]], [[0.5, -1], [0, 1]]),
    ],
)
def test_previous_action_is_one_hot_or_raw(action, given, expected):
    names = tuple(f"x{index}" for index in range(1 + action.history_size + 2))
    controller = Controller(((0.0,) * len(names),) * action.n_outputs, (0.0,) * action.n_outputs)
    outputs = tuple(f"y{index}" for index in range(action.n_outputs))
    program = Program(controller, 1, action, True, names, outputs)
    joined = join_inputs(program, [[7.0], [7.0]], given, 0.0, True)
    assert joined.tolist() == [[7.0, *row, 0.0, 1.0] for row in expected]


def test_without_interaction_the_input_is_the_observation():
    program = build_program(0, [], "discrete", False)
    assert join_inputs(program, np.ones((2, 5)), [0, 0], 3.0, True).tolist() == [[1.0] * 5] * 2


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ((np.zeros(8),), "9"),
        ((np.zeros(9), 6), "previous_action"),
        ((np.zeros(9), -1), "previous_action"),
        ((np.zeros(9), 0.5), "previous_action"),
        ((np.zeros(9), [0, 1]), "previous_action"),
        ((np.zeros(9), 0, [1.0, 2.0]), "previous_reward"),
        ((np.zeros((2, 9)), [0, 0], 0.0, [True]), "previous_done"),
    ],
)
def test_inputs_that_do_not_fit_are_refused(arguments, fault):
    with pytest.raises(ValueError, match=fault):
        join_inputs(hanoi_program(), *arguments)


@pytest.mark.parametrize(
    ("keywords", "fault"),
    [({"semantics": "fuzzy"}, "fuzzy"), ({"n_envs": 0}, "n_envs=0"), ({"program": 3}, "int given")],
)
def test_runner_refuses_arguments_that_do_not_fit(keywords, fault):
    with pytest.raises(ValueError, match=fault):
        ProgramRunner(**{"program": hanoi_program(), **keywords})


@pytest.mark.parametrize("x", [np.zeros(17), np.zeros((2, 17)), np.full((1, 17), np.nan), np.full((1, 17), np.inf)])
def test_runner_refuses_inputs_that_do_not_fit_and_keeps_its_memory(x):
    runner = ProgramRunner(hanoi_program())
    runner.act(np.ones((1, 17)))
    before = runner.condition_values.copy()
    with pytest.raises(ValueError, match="inputs"):
        runner.act(x)
    np.testing.assert_array_equal(runner.condition_values, before)


@given(st.data())
@settings(max_examples=20, deadline=None)
def test_very_large_inputs_do_not_overflow(data):
    program = data.draw(programs)
    runner = ProgramRunner(program, semantics=data.draw(st.sampled_from(["crisp", "soft"])))
    for sign in (1, -1):
        action = runner.act(np.full((1, program.n_inputs), sign * 1e30))
        assert np.isfinite(action).all()
        assert np.isfinite(runner.mixture_weights).all()
