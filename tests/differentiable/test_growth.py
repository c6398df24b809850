"""A branch that is divided: nothing the program does is changed at first."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from progpolicy_envs.symmetry import Permutation, Symmetry
from sb3_progpolicy.differentiable.growth import GATE_BIAS, SHARPNESS, Division, divide
from sb3_progpolicy.differentiable.module import ProgramModule
from sb3_progpolicy.spaces import action_spec

SPACES = {
    "discrete": spaces.Discrete(3),
    "box": spaces.Box(-1, 1, (2,), np.float32),
    "multi_discrete": spaces.MultiDiscrete([2, 3]),
    "multi_binary": spaces.MultiBinary(2),
}
N_INPUTS = 4
MIRROR = Symmetry("mirror", Permutation.of([1, 0, 2, 3]), Permutation.of([1, 0, 2]))


def module_of(kind="discrete", cell="affine", n_conditions=1, depth=4, size=1, **kwargs):
    th.manual_seed(0)
    module = ProgramModule(N_INPUTS, action_spec(SPACES[kind]), depth, cell, size, **kwargs)
    module.search.select(n_conditions)
    with th.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.5 * th.randn_like(parameter))
        if module.conditions.recurrent:
            module.conditions._make_block_diagonal()
    return module


def run(module, crisp=False):
    """What a program does over a sequence, in the middle of which it has a state."""
    inputs = th.randn(6, 30, N_INPUTS, generator=th.Generator().manual_seed(1))
    with th.no_grad():
        return module(inputs, module.initial_state(30), crisp)[0]


def probabilities_of_actions(module, parameters):
    """With branches there is one more component, which lies on one that was there."""
    if not module.mixes_branches:
        return parameters
    n = len(module.controllers_in_use)
    masses, means = parameters[..., :n].exp(), parameters[..., n:].unflatten(-1, (n, -1))
    at = th.linspace(-2, 2, 9).view(9, 1)
    densities = th.exp(-0.5 * (means.unsqueeze(-2) - at).square().sum(-1))  # (..., n, 9)
    return (masses.unsqueeze(-1) * densities).sum(-2)


@pytest.mark.parametrize("crisp", [False, True])
@pytest.mark.parametrize("then", [False, True])
@pytest.mark.parametrize("cell", ["affine", "rnn", "gru", "lstm"])
@pytest.mark.parametrize(("kind", "semantics"), [*((kind, "means") for kind in SPACES), ("box", "branches")])
def test_divided_program_does_what_it_did(kind, semantics, cell, then, crisp):
    for n_conditions in (1, 2):
        module = module_of(kind, cell, n_conditions, size=2, semantics=semantics)
        before = probabilities_of_actions(module, run(module, crisp))
        divide(module, Division(then, (1.0, -0.5, 0.25, 0.0), 0.1))
        assert module.search.most_likely() == n_conditions + 1
        after = probabilities_of_actions(module, run(module, crisp))
        th.testing.assert_close(after, before, atol=1e-5, rtol=1e-5)


def test_halves_have_controllers_of_their_own():
    module = module_of("box", n_conditions=0)
    divide(module, Division(False, (1.0, 0.0, 0.0, 0.0), 0.0))
    with th.no_grad():
        rows = module.controllers.weight.unflatten(0, (module.n_controllers, -1))
        assert th.equal(rows[0], rows[module.depth])
        before = run(module, crisp=True)
        rows[0] += 1
        changed = (run(module, crisp=True) != before).any(-1)
    first = th.randn(6, 30, N_INPUTS, generator=th.Generator().manual_seed(1))[..., 0] >= 0
    assert th.equal(changed, first)


def test_first_condition_divides_the_only_controller():
    module = module_of(n_conditions=0)
    before = run(module)
    divide(module, Division(False, (1.0, 0.0, 0.0, 0.0), 0.0))
    th.testing.assert_close(run(module), before)


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("cell", ["affine", "rnn", "gru", "lstm"])
def test_new_condition_decides_as_the_division_says_whatever_the_state(cell, size):
    module = module_of(cell=cell, size=size, temperature=0.5)
    divide(module, Division(False, (1.0, -2.0, 0.0, 0.5), 0.3))
    inputs = th.randn(5, 40, N_INPUTS)
    with th.no_grad():
        values = module.conditions(inputs, module.initial_state(40))[0][..., 1]
    sums = inputs @ th.tensor([1.0, -2.0, 0.0, 0.5]) + 0.3
    clear = sums.abs() > 0.7  # a GRU or LSTM remembers a little of the step before
    assert ((values >= 0) == (sums >= 0))[clear].all()
    if cell == "affine":
        th.testing.assert_close(values, SHARPNESS * 0.5 * sums)
    if cell == "gru":
        assert module.conditions.rnn.bias_ih_l0[module.conditions.hidden_size + size] == -GATE_BIAS


def test_every_parameter_of_a_new_recurrent_condition_is_trained():
    module = module_of(cell="gru", size=2, n_conditions=0)
    divide(module, Division(False, (1.0, 0.0, 0.0, 0.0), 0.0))
    with th.no_grad():
        module.controllers.weight.add_(th.randn_like(module.controllers.weight))
    module(th.randn(6, 20, N_INPUTS), module.initial_state(20))[0][..., 0].sum().backward()
    conditions = module.conditions
    assert conditions.readout.grad[0].abs().min() > 0
    assert conditions.rnn.weight_ih_l0.grad[2 * conditions.hidden_size].abs().min() > 0


@pytest.mark.parametrize("then", [False, True])
def test_ties_stay_and_conditions_read_the_mean(then):
    module = module_of(symmetries=[MIRROR])
    before = run(module)
    divide(module, Division(then, (1.0, 0.0, 0.0, 0.0), 0.0))
    th.testing.assert_close(run(module), before, atol=1e-5, rtol=1e-5)
    x = th.randn(1, 20, N_INPUTS)
    with th.no_grad():
        value, mirrored = (
            module.conditions(inputs, module.initial_state(20))[0][..., 1] for inputs in (x, x[..., [1, 0, 2, 3]])
        )
    th.testing.assert_close(value, mirrored)


@pytest.mark.parametrize("symmetries", [(), [MIRROR]])
@pytest.mark.parametrize("then", [False, True])
def test_moments_go_with_the_controllers_and_those_of_the_conditions_are_dropped(then, symmetries):
    module = module_of(symmetries=symmetries)
    optimizer = th.optim.Adam(module.parameters())
    run_of = module(th.randn(6, 20, N_INPUTS), module.initial_state(20))[0]
    run_of[..., 0].square().sum().backward()
    optimizer.step()
    parameter = module.controllers.free if symmetries else module.controllers.weight
    rows = optimizer.state[parameter]["exp_avg"].unflatten(0, (module.n_controllers, -1))
    then_before, last_before = rows[0].clone(), rows[module.depth].clone()  # of the program with one condition
    assert not th.equal(then_before, last_before)
    divide(module, Division(then, (1.0, 0.0, 0.0, 0.0), 0.0), optimizer)
    divided, other = (then_before, last_before) if then else (last_before, then_before)
    assert th.equal(rows[0], other)
    assert th.equal(rows[1], divided)
    assert th.equal(rows[module.depth + 1], divided)
    assert not any(parameter in optimizer.state for parameter in module.conditions.parameters())


@pytest.mark.parametrize(("n_conditions", "then"), [(3, False), (0, True), (-1, False)])
def test_what_cannot_be_divided_is_refused(n_conditions, then):
    module = module_of(n_conditions=n_conditions)
    with pytest.raises(ValueError, match="is not accepted for a program of"):
        divide(module, Division(then, (0.0,) * N_INPUTS, 0.0))
