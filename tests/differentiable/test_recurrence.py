"""The written-out recurrence against PyTorch's own layers."""

import pytest
import torch as th
from torch import nn

from sb3_progpolicy.differentiable.recurrence import scan

LAYERS = {"rnn": nn.RNN, "gru": nn.GRU}


@pytest.mark.parametrize("kind", LAYERS)
@pytest.mark.parametrize(("n_steps", "n_sequences", "units"), [(1, 1, 1), (17, 4, 3), (40, 2, 6)])
def test_scan_equals_the_torch_layer_forwards_and_backwards(kind, n_steps, n_sequences, units):
    th.manual_seed(0)
    layer = LAYERS[kind](5, units).double()
    inputs = th.randn(n_steps, n_sequences, 5, dtype=th.float64)
    hidden = th.randn(1, n_sequences, units, dtype=th.float64, requires_grad=True)
    weights = th.randn(n_steps, n_sequences, units, dtype=th.float64)

    def gradients(outputs):
        layer.zero_grad()
        hidden.grad = None
        (outputs * weights).sum().backward()
        return [parameter.grad.clone() for parameter in layer.parameters()] + [hidden.grad.clone()]

    expected, _ = layer(inputs, hidden)
    gates = nn.functional.linear(inputs, layer.weight_ih_l0, layer.bias_ih_l0)
    computed = scan(kind, gates, layer.weight_hh_l0, layer.bias_hh_l0, hidden[0])
    th.testing.assert_close(computed, expected)
    for ours, theirs in zip(gradients(computed), gradients(expected), strict=True):
        th.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("kind", LAYERS)
def test_gradient_is_that_of_the_weights_of_the_forward_pass(kind):
    layer = LAYERS[kind](2, 2)
    gates = nn.functional.linear(th.ones(3, 1, 2), layer.weight_ih_l0, layer.bias_ih_l0)
    gates = gates.detach().requires_grad_()
    gradients = []
    for step_between in (False, True):
        gates.grad = None
        outputs = scan(kind, gates, layer.weight_hh_l0, layer.bias_hh_l0, th.zeros(1, 2))
        if step_between:
            layer.weight_hh_l0.data.add_(1.0)  # as an optimizer does, in place
        outputs.sum().backward()
        gradients.append(gates.grad.clone())
    th.testing.assert_close(gradients[0], gradients[1], atol=0, rtol=0)
