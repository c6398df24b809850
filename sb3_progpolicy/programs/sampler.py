"""Drawing actions from a program mixture without torch's cost per call, for rollouts on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_progpolicy.programs.cells import STEPS, Array, sigmoid
from sb3_progpolicy.programs.modules import ProgramModule


class ProgramSampler:
    """Runs a :class:`ProgramModule` one step at a time for a batch of environments and samples actions.

    It computes what the module computes under the soft semantics, W included.

    :param module: the program mixture, on the CPU; its parameters are read now: one sampler for each rollout
    :param log_std: logarithm of the standard deviations of Box actions, ``(n_outputs,)``
    """

    def __init__(self, module: ProgramModule, log_std: th.Tensor | None = None) -> None:
        self.action, conditions = module.action, module.conditions
        self.n_conditions, self.size, self.cell = conditions.n_conditions, conditions.size, conditions.cell
        with th.no_grad():
            self._at_least = _view(module.search.at_least())
            self._probabilities = _view(module.search.probabilities())
        self._scale = 1 / float(module.temperature)
        self._n_controllers = module.n_controllers
        self._std = None if log_std is None else np.exp(_view(log_std))
        self.needs_conditions = module.search.needs_conditions and self.n_conditions > 0
        self.recurrent = conditions.recurrent and self.needs_conditions
        # Everything that is affine in X in one product: the gates of the conditions, then the controllers.
        if self.recurrent:
            rnn = conditions.rnn
            names = ("weight_ih_l0", "bias_ih_l0", "weight_hh_l0", "bias_hh_l0")
            input_weight, input_bias, weight, self._bias = (_view(getattr(rnn, name)) for name in names)
            self._weight = np.ascontiguousarray(weight.T)
            self._readout, self._readout_bias = _view(conditions.readout), _view(conditions.readout_bias)
        elif self.needs_conditions:
            input_weight, input_bias = _view(conditions.affine.weight), _view(conditions.affine.bias)
        else:
            input_weight, input_bias = np.zeros((0, module.n_inputs), np.float32), np.zeros(0, np.float32)
        self._n_gates = len(input_bias)
        controllers = module.controllers
        self._affine = np.ascontiguousarray(np.concatenate((input_weight, _view(controllers.weight))).T)
        self._constant = np.concatenate((input_bias, _view(controllers.bias)))
        self._edges = np.cumsum(self.action.sizes)[:-1]
        self._mass_sum, self._n_samples = np.zeros(self._n_controllers), 0

    def tests(self, gates: Array, hidden: Array, cell: Array) -> tuple[Array, Array, Array]:
        """Return the values of B ``(n_envs, n_conditions)`` and the new states.

        :param gates: the affine part of the conditions, ``(n_envs, n_gates * hidden_size)``
        :param hidden: ``(n_envs, hidden_size)``
        :param cell: ``(n_envs, hidden_size)``, used by LSTM conditions
        """
        if not self.needs_conditions:
            return np.zeros((len(gates), self.n_conditions), dtype=np.float32), hidden, cell
        if not self.recurrent:
            return gates, hidden, cell
        hidden, cell = STEPS[self.cell](gates, hidden @ self._weight + self._bias, hidden, cell)
        if self.size == 1:
            return hidden * self._readout[:, 0] + self._readout_bias, hidden, cell
        units = hidden.reshape(len(gates), self.n_conditions, self.size)
        return (units * self._readout).sum(-1) + self._readout_bias, hidden, cell

    def masses(self, tests: Array) -> Array:
        """Return the mass of every controller, as :meth:`ProgramModule.masses` does."""
        taken = sigmoid(tests * self._scale)
        reached = np.empty((len(tests), self.n_conditions + 1), dtype=np.float32)
        reached[:, 0] = 1
        np.cumprod(1 - taken, axis=1, out=reached[:, 1:])
        return np.concatenate((taken * reached[:, :-1] * self._at_least, reached * self._probabilities), axis=1)

    def branch_frequencies(self) -> Array:
        """Return the share of the samples drawn so far that each controller decided, ``(2 depth - 1,)``."""
        return self._mass_sum / max(1, self._n_samples)

    def sample(
        self, inputs: Array, hidden: Array, cell: Array, rng: np.random.Generator
    ) -> tuple[NDArray[Any], Array, Array]:
        """Draw one action for every environment.

        :param inputs: X, ``(n_envs, n_inputs)``
        :param hidden: ``(n_envs, hidden_size)``
        :param cell: ``(n_envs, hidden_size)``
        :param rng: source of all randomness
        :return: actions ``(n_envs, *action_shape)`` (Discrete without ``start``, Box flat and unclipped), new states
        """
        affine = inputs @ self._affine + self._constant
        tests, hidden, cell = self.tests(affine[:, : self._n_gates], hidden, cell)
        masses = self.masses(tests)
        self._mass_sum += masses.sum(0)
        self._n_samples += len(masses)
        outputs = affine[:, self._n_gates :].reshape(len(inputs), self._n_controllers, -1)
        if self.action.kind == "box":
            mean = (masses[:, :, None] * outputs).sum(1)
            return mean + self._std * rng.standard_normal(mean.shape, dtype=np.float32), hidden, cell
        if self.action.kind == "multi_binary":
            probabilities = (masses[:, :, None] * sigmoid(outputs)).sum(1)
            return (rng.random(probabilities.shape) < probabilities).astype(np.int8), hidden, cell
        if self.action.kind == "discrete":
            return _draw(masses, outputs, rng), hidden, cell
        drawn = [_draw(masses, component, rng) for component in np.split(outputs, self._edges, axis=2)]
        return np.stack(drawn, axis=1), hidden, cell


def _draw(masses: Array, outputs: Array, rng: np.random.Generator) -> NDArray[np.int64]:
    """Sample from the mixture of softmaxes: first a controller by its mass, then an action by its softmax.

    :param masses: ``(n_envs, n_controllers)``
    :param outputs: ``(n_envs, n_controllers, n_choices)``
    """
    rows = np.arange(len(masses))
    edges = masses.cumsum(1)
    # The last edge is left out, so that rounding cannot lead past the last controller.
    controllers = (edges[:, :-1] <= rng.random((len(rows), 1))).sum(1)
    chosen = outputs[rows, controllers]
    # Adding Gumbel noise to the logits and taking the largest is sampling from their softmax.
    return (chosen - np.log(rng.standard_exponential(chosen.shape))).argmax(1)


def _view(tensor: th.Tensor) -> Array:
    return tensor.detach().numpy()
