"""The sampler of rollouts against the torch module it stands in for."""

import numpy as np
import pytest
import torch as th

from sb3_progpolicy.differentiable.sampler import ProgramSampler
from tests.differentiable.test_module import ACTIONS, CELLS, N_INPUTS, make_module, meaning_of_mixture

N_DRAWS = 20_000


def make_sampler(module, n_steps=1, n_envs=1, log_std=None, seed=0):
    return ProgramSampler(module, module.initial_state(n_envs), n_steps, np.random.default_rng(seed), log_std)


def draw(module, kind, n_steps=3, log_std=None, seed=0):
    """Feed all rows the same X, so that they are independent draws; return the last actions and both states."""
    x = th.randn(n_steps, 1, N_INPUTS, generator=th.Generator().manual_seed(seed)).expand(-1, N_DRAWS, -1)
    sampler = make_sampler(module, n_steps, N_DRAWS, log_std, seed)
    for step in x.contiguous().numpy():
        actions = sampler.sample(step)
    with th.no_grad():
        parameters, state = module(x[:, :1], module.initial_state(1))
    states = tuple(tensor[0].numpy() for tensor in sampler.state)
    return actions, states, meaning_of_mixture(kind, parameters[-1, 0]), state


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("kind", ["discrete", "multi_discrete", "multi_binary"])
@pytest.mark.parametrize("selected", [False, True])
def test_frequencies_of_actions_are_the_probabilities_of_the_module(kind, cell, selected):
    module = make_module(kind, cell)
    if selected:
        module.search.select(2)
    actions, _, probabilities, _ = draw(module, kind)
    if kind == "multi_binary":
        frequencies = actions.mean(0)
    else:
        columns = actions.reshape(N_DRAWS, -1).T
        frequencies = np.concatenate(
            [np.bincount(column, minlength=n) for column, n in zip(columns, ACTIONS[kind].sizes, strict=True)]
        ) / len(actions)
    # Four standard deviations of a frequency, at most 0.5 / sqrt(N_DRAWS) each.
    np.testing.assert_allclose(frequencies, probabilities, atol=4 * 0.5 / N_DRAWS**0.5)


@pytest.mark.parametrize("cell", CELLS)
def test_box_actions_scatter_around_the_mean_of_the_module(cell):
    log_std = th.tensor([-1.0, 0.0, 0.5])
    actions, _, mean, _ = draw(make_module("box", cell), "box", log_std=log_std)
    std = log_std.exp().numpy()
    np.testing.assert_allclose(actions.mean(0), mean, atol=5 * std.max() / N_DRAWS**0.5)
    np.testing.assert_allclose(actions.std(0), std, rtol=0.03)


@pytest.mark.parametrize("cell", ["rnn", "gru", "lstm"])
@pytest.mark.parametrize("size", [1, 3])
def test_states_are_those_of_the_module(cell, size):
    module = make_module(cell=cell, size=size)
    _, (hidden, memory), _, state = draw(module, "discrete", n_steps=20)
    np.testing.assert_allclose(hidden[0], state[0][0, 0], atol=1e-5)
    np.testing.assert_allclose(memory[0], state[1][0, 0], atol=1e-5)


@pytest.mark.parametrize("depth", [1, 3])
def test_mixture_weights_are_those_of_the_module(depth):
    module = make_module(depth=depth)
    values = np.random.default_rng(0).normal(size=(7, depth - 1)).astype(np.float32)
    weights = make_sampler(module).mixture_weights(values)
    np.testing.assert_allclose(weights, module.mixture_weights(th.from_numpy(values)).detach(), atol=1e-6)
