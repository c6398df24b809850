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

    It reads the module's parameters in place (they have to be on the CPU) and computes what the module computes
    under the soft semantics, W included.

    :param module: the program mixture; W and the temperature are read now, the rest at each step
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
        self._controllers = _view(module.controllers.weight).T, _view(module.controllers.bias)
        self._std = None if log_std is None else np.exp(_view(log_std))
        self.recurrent = conditions.recurrent
        if self.recurrent:
            rnn = conditions.rnn
            parameters = (rnn.weight_ih_l0, rnn.bias_ih_l0, rnn.weight_hh_l0, rnn.bias_hh_l0)
            input_weight, self._input_bias, weight, self._bias = (_view(value) for value in parameters)  # type: ignore[arg-type]
            # Copies: a contiguous transpose is faster to multiply by than a strided one.
            self._input_weight, self._weight = (np.ascontiguousarray(matrix.T) for matrix in (input_weight, weight))
            self._readout, self._readout_bias = _view(conditions.readout), _view(conditions.readout_bias)
        elif self.n_conditions:
            self._affine = _view(conditions.affine.weight).T, _view(conditions.affine.bias)

    def tests(self, inputs: Array, hidden: Array, cell: Array) -> tuple[Array, Array, Array]:
        """Return the values of B ``(n_envs, n_conditions)`` and the new states.

        :param inputs: X, ``(n_envs, n_inputs)``
        :param hidden: ``(n_envs, hidden_size)``
        :param cell: ``(n_envs, hidden_size)``, used by LSTM conditions
        """
        if not self.n_conditions:
            return np.zeros((len(inputs), 0), dtype=np.float32), hidden, cell
        if not self.recurrent:
            weight, bias = self._affine
            return inputs @ weight + bias, hidden, cell
        gates = inputs @ self._input_weight + self._input_bias
        hidden, cell = STEPS[self.cell](gates, hidden @ self._weight + self._bias, hidden, cell)
        units = hidden.reshape(len(inputs), self.n_conditions, self.size)
        return (units * self._readout).sum(-1) + self._readout_bias, hidden, cell

    def masses(self, tests: Array) -> Array:
        """Return the mass of every controller, as :meth:`ProgramModule.masses` does."""
        taken = sigmoid(tests * self._scale)
        reached = np.empty((len(tests), self.n_conditions + 1), dtype=np.float32)
        reached[:, 0] = 1
        np.cumprod(1 - taken, axis=1, out=reached[:, 1:])
        return np.concatenate((taken * reached[:, :-1] * self._at_least, reached * self._probabilities), axis=1)

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
        tests, hidden, cell = self.tests(inputs, hidden, cell)
        masses = self.masses(tests)[:, :, None]
        weight, bias = self._controllers
        outputs = (inputs @ weight + bias).reshape(len(inputs), self._n_controllers, -1)
        if self.action.kind == "box":
            mean = (masses * outputs).sum(1)
            return mean + self._std * rng.standard_normal(mean.shape, dtype=np.float32), hidden, cell
        if self.action.kind == "multi_binary":
            probabilities = (masses * sigmoid(outputs)).sum(1)
            return (rng.random(probabilities.shape) < probabilities).astype(np.int8), hidden, cell
        edges = np.cumsum(self.action.sizes)[:-1]
        drawn = [_draw(masses, component, rng) for component in np.split(outputs, edges, axis=2)]
        return drawn[0] if self.action.kind == "discrete" else np.stack(drawn, axis=1), hidden, cell


def _draw(masses: Array, outputs: Array, rng: np.random.Generator) -> NDArray[np.int64]:
    """Sample from the mixture of softmaxes of ``outputs`` ``(n_envs, n_controllers, n_choices)``."""
    odds = np.exp(outputs - outputs.max(2, keepdims=True))
    probabilities = (odds * (masses / odds.sum(2, keepdims=True))).sum(1)
    edges = np.cumsum(probabilities, axis=1)
    draws = rng.random((len(edges), 1)) * edges[:, -1:]
    return np.minimum((edges <= draws).sum(1), edges.shape[1] - 1)


def _view(tensor: th.Tensor) -> Array:
    return tensor.detach().numpy()
