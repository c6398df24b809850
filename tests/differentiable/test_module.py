"""The differentiable program against the semantics of section 2.2 written out naively."""

import copy

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_progpolicy.differentiable.conditions import Conditions
from sb3_progpolicy.differentiable.module import ProgramModule
from sb3_progpolicy.programs import ActionSpec, Program, ProgramRunner

CELLS = ("affine", "min", "rnn", "gru", "lstm")
ACTIONS = {
    "discrete": ActionSpec("discrete", (4,)),
    "box": ActionSpec("box", (3,), (-9.0,) * 3, (9.0,) * 3),
    "multi_discrete": ActionSpec("multi_discrete", (3, 2)),
    "multi_binary": ActionSpec("multi_binary", (3,)),
}
N_INPUTS, DEPTH, N_STEPS, N_SEQUENCES = 5, 4, 12, 6


def make_module(kind="discrete", cell="gru", size=2, depth=DEPTH, seed=0, temperature=0.7):
    th.manual_seed(seed)
    module = ProgramModule(N_INPUTS, ACTIONS[kind], depth, cell, size, temperature)
    with th.no_grad():
        module.search.logits.normal_()
        module.controllers.weight.normal_()
        if module.conditions.recurrent:
            module.conditions.readout.normal_(std=3)
    return module


def make_inputs(seed=1, n_steps=N_STEPS):
    return th.randn(n_steps, N_SEQUENCES, N_INPUTS, generator=th.Generator().manual_seed(seed))


def meaning(kind, outputs):
    """What section 2.2 mixes: probabilities of discrete actions, values of continuous ones."""
    if kind == "box":
        return outputs
    if kind == "multi_binary":
        return outputs.sigmoid()
    return th.cat([part.softmax(-1) for part in outputs.split(list(ACTIONS[kind].sizes), -1)], -1)


def meaning_of_mixture(kind, parameters):
    """The same of what the module returns: log-probabilities, log-odds or means."""
    if kind == "box":
        return parameters
    return parameters.sigmoid() if kind == "multi_binary" else parameters.exp()


def naive(module, kind, inputs, crisp=False):
    """Section 2.2 word by word: run every program recursively, then add them up with their probabilities."""
    tests, _ = module.conditions(inputs, module.initial_state(inputs.shape[1]))
    outputs = module.controllers(inputs).unflatten(-1, (module.n_controllers, -1))

    def program(n_conditions, k):
        if k == n_conditions:
            return meaning(kind, outputs[..., module.depth - 1 + n_conditions, :])
        weight = (tests[..., k, None] >= 0).float() if crisp else (tests[..., k, None] / module.temperature).sigmoid()
        return weight * meaning(kind, outputs[..., k, :]) + (1 - weight) * program(n_conditions, k + 1)

    programs = [program(n, 0) for n in range(module.depth)]
    choices = module.search.logits.softmax(-1)
    total = th.zeros_like(programs[0])
    for n, value in enumerate(programs):
        probability = th.tensor(1.0)
        for k in range(n):
            probability = probability * choices[k, 1]
        if n < module.depth - 1:
            probability = probability * choices[n, 0]
        total = total + probability * value
    return total, programs


def parameters_of(module, inputs, **kwargs):
    return module(inputs, module.initial_state(inputs.shape[1]), **kwargs)[0]


def as_program(module, kind, n_conditions):
    spec = ACTIONS[kind]
    return Program(
        module.to_syntax(n_conditions),
        N_INPUTS,
        spec,
        False,
        tuple(f"x{i}" for i in range(N_INPUTS)),
        tuple(f"a{i}" for i in range(spec.n_outputs)),
        temperature=float(module.temperature),
    )


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("kind", ACTIONS)
@pytest.mark.parametrize("crisp", [False, True])
def test_mixture_is_the_sum_of_all_programs_run_recursively(kind, cell, crisp):
    module, inputs = make_module(kind, cell), make_inputs()
    expected, _ = naive(module, kind, inputs, crisp)
    mixed = meaning_of_mixture(kind, parameters_of(module, inputs, crisp=crisp))
    th.testing.assert_close(mixed, expected, atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("depth", [1, 2, 5])
def test_mixture_weights_are_non_negative_and_sum_to_one(depth):
    module = make_module(depth=depth)
    values, _ = module.conditions(make_inputs(), module.initial_state(N_SEQUENCES))
    for crisp in (False, True):
        weights = module.mixture_weights(values, crisp)
        assert weights.shape == (N_STEPS, N_SEQUENCES, 2 * depth - 1)
        assert (weights >= 0).all()
        th.testing.assert_close(weights.sum(-1), th.ones(N_STEPS, N_SEQUENCES))


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("kind", ACTIONS)
def test_extracted_program_computes_what_it_computed_inside_the_mixture(kind, cell):
    module, inputs = make_module(kind, cell), make_inputs().double()
    extracted = [module.extract(n_conditions).double() for n_conditions in range(DEPTH)]
    # In double precision: single precision would blur the sixth digit.
    _, programs = naive(module.double(), kind, inputs)
    for n_conditions, expected in enumerate(programs):
        computed = meaning_of_mixture(kind, parameters_of(extracted[n_conditions], inputs))
        th.testing.assert_close(computed, expected, atol=1e-6, rtol=1e-6)
        assert extracted[n_conditions].search.most_likely() == n_conditions


def test_extraction_copies_and_takes_the_most_likely_program():
    module, inputs = make_module(), make_inputs()
    with th.no_grad():
        module.search.logits.copy_(th.tensor([[0.0, 2.0], [2.0, 0.0], [0.0, 0.0]]))
    extracted = module.extract()
    assert extracted.depth == 2
    before = parameters_of(extracted, inputs)
    with th.no_grad():
        for parameter in module.parameters():
            parameter.add_(1.0)
    th.testing.assert_close(parameters_of(extracted, inputs), before, atol=0, rtol=0)


@pytest.mark.parametrize("n_conditions", [-1, DEPTH])
def test_extraction_of_a_program_that_is_not_in_the_graph_is_refused(n_conditions):
    with pytest.raises(ValueError, match="this graph has 0 to 3"):
        make_module().extract(n_conditions)


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("kind", ACTIONS)
@pytest.mark.parametrize("semantics", ["soft", "crisp"])
def test_program_as_plain_data_acts_as_the_module(kind, cell, semantics):
    module, inputs = make_module(kind, cell), make_inputs()
    for n_conditions in range(DEPTH):
        parameters = parameters_of(module.extract(n_conditions), inputs, crisp=semantics == "crisp").detach()
        if kind == "box":
            expected = parameters.clamp(-9, 9)
        elif kind == "multi_binary":
            expected = (parameters > 0).long()
        else:
            expected = th.stack([part.argmax(-1) for part in parameters.split(list(ACTIONS[kind].sizes), -1)], -1)
        runner = ProgramRunner(as_program(module, kind, n_conditions), N_SEQUENCES, semantics)
        for x, wanted in zip(inputs.numpy(), expected.numpy(), strict=True):
            acted = runner.act(x).reshape(N_SEQUENCES, -1)
            np.testing.assert_allclose(acted, wanted, atol=1e-4)


@pytest.mark.parametrize("cell", CELLS)
def test_towards_temperature_zero_the_soft_program_is_the_crisp_one(cell):
    module, inputs = make_module("box", cell), make_inputs()
    distances = []
    for temperature in (1.0, 0.1, 1e-6):
        module.temperature.fill_(temperature)
        soft, crisp = (parameters_of(module, inputs, crisp=crisp) for crisp in (False, True))
        distances.append((soft - crisp).abs().max().item())
    assert distances[0] > distances[1] > distances[2]
    assert distances[2] < 1e-5


def block_mask(conditions):
    gates = conditions.rnn.weight_hh_l0.shape[0] // conditions.hidden_size
    return th.block_diag(*[th.ones(conditions.size, conditions.size)] * conditions.n_conditions).repeat(gates, 1)


def train_a_little(conditions, inputs, n_steps=5):
    optimizer = th.optim.Adam(conditions.parameters(), lr=0.1)
    state = th.zeros(1, N_SEQUENCES, conditions.hidden_size)
    for _ in range(n_steps):
        tests, _ = conditions(inputs, (state, state))
        optimizer.zero_grad()
        (tests - 1).square().mean().backward()
        optimizer.step()


@pytest.mark.parametrize("cell", ["rnn", "gru", "lstm"])
@pytest.mark.parametrize("copied", [False, True])
def test_recurrence_stays_block_diagonal_under_adam(cell, copied):
    conditions = Conditions(N_INPUTS, 3, cell, 2)
    conditions = copy.deepcopy(conditions) if copied else conditions
    before = conditions.rnn.weight_hh_l0.detach().clone()
    train_a_little(conditions, make_inputs())
    mask = block_mask(conditions)
    assert (conditions.rnn.weight_hh_l0[mask == 0] == 0).all()
    assert (conditions.rnn.weight_hh_l0 != before)[mask == 1].all()


@pytest.mark.parametrize("cell", ["rnn", "gru", "lstm"])
def test_fused_conditions_equal_separate_torch_cells(cell):
    th.manual_seed(0)
    conditions, inputs = Conditions(N_INPUTS, 3, cell, 2), make_inputs()
    train_a_little(conditions, inputs)
    zero = th.zeros(1, N_SEQUENCES, conditions.hidden_size)
    fused, _ = conditions(inputs, (zero, zero))
    layers = {"rnn": nn.RNN, "gru": nn.GRU, "lstm": nn.LSTM}
    for k in range(3):
        syntax, layer = conditions.to_syntax(k), layers[cell](N_INPUTS, 2)
        with th.no_grad():
            for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
                getattr(layer, f"{name}_l0").copy_(th.tensor(getattr(syntax, name)))
        hidden, _ = layer(inputs)
        alone = hidden @ th.tensor(syntax.readout) + syntax.readout_bias
        th.testing.assert_close(fused[..., k], alone, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("cell", ["rnn", "gru", "lstm"])
def test_sequence_in_one_piece_equals_two_pieces_with_the_state_between(cell):
    module, inputs = make_module(cell=cell), make_inputs()
    whole, last = module(inputs, module.initial_state(N_SEQUENCES))
    first, between = module(inputs[:5], module.initial_state(N_SEQUENCES))
    second, after = module(inputs[5:], between)
    th.testing.assert_close(th.cat((first, second)), whole)
    th.testing.assert_close(after, last)


@pytest.mark.parametrize("arguments", [{"cell": "grru"}, {"condition_size": 0}, {"depth": 0}])
def test_values_that_make_no_program_are_refused(arguments):
    with pytest.raises(ValueError, match="is not accepted"):
        ProgramModule(N_INPUTS, ACTIONS["discrete"], **arguments)
