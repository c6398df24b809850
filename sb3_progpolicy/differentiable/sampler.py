"""Drawing actions from a program mixture without torch's cost per call, for rollouts on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_progpolicy.differentiable.conditions import State
from sb3_progpolicy.differentiable.module import ProgramModule
from sb3_progpolicy.programs.cells import STEPS, Array, sigmoid


class ProgramSampler:
    """Runs a :class:`ProgramModule` for ``n_steps`` steps in a batch of environments and samples actions.

    It computes what the module computes under the soft semantics, W included, keeps the states of the conditions
    from one step to the next and records the values of the conditions. Box actions whose means are mixed need the
    mixture; all others are drawn by drawing a program from W and running it, with a random choice at every branch.

    :param module: the program mixture, on the CPU; its parameters are read now: one sampler for each rollout
    :param state: of the conditions at the start: two tensors ``(1, n_envs, hidden_size)``
    :param n_steps: how many times :meth:`sample` is called at most
    :param rng: source of all randomness, all of it drawn now
    :param log_std: logarithm of the standard deviations of Box actions, ``(n_outputs,)``
    """

    def __init__(
        self,
        module: ProgramModule,
        state: State,
        n_steps: int,
        rng: np.random.Generator,
        log_std: th.Tensor | None = None,
    ) -> None:
        self.action, conditions = module.action, module.conditions
        self.n_conditions, self.size, self.cell = conditions.n_conditions, conditions.size, conditions.cell
        self._in_use = module.controllers_in_use
        self._selected = None if module.search.searching else module.search.most_likely()
        self._choices = module.choices().detach().numpy()
        self._temperature = float(module.temperature)
        self._std = None if log_std is None else np.exp(_view(log_std))
        self.needs_conditions = module.search.needs_conditions and self.n_conditions > 0
        self.recurrent = conditions.recurrent and self.needs_conditions
        # Everything that is affine in X in one product: the gates of the conditions, then the controllers.
        if self.recurrent:
            rnn = conditions.rnn
            names = ("weight_ih_l0", "bias_ih_l0", "weight_hh_l0", "bias_hh_l0")
            _, input_bias, weight, self._bias = (_view(getattr(rnn, name)) for name in names)
            input_weight = _view(conditions.input_weight)
            self._weight = np.ascontiguousarray(weight.T)
            self._readout, self._readout_bias = _view(conditions.readout), _view(conditions.readout_bias)
        elif self.needs_conditions:
            input_weight, input_bias = _view(conditions.input_weight), _view(conditions.affine.bias)
        else:
            input_weight, input_bias = np.zeros((0, module.n_inputs), np.float32), np.zeros(0, np.float32)
        self._n_gates, self._n_sums = len(input_bias), conditions.n_sums
        controllers = (
            _view(parameter).reshape(module.n_controllers, self.action.n_outputs, -1)[self._in_use]
            for parameter in module.controller_parameters()
        )
        controller_weight, controller_bias = (block.reshape(-1, block.shape[-1]) for block in controllers)
        self._affine = np.ascontiguousarray(np.concatenate((input_weight, controller_weight)).T)
        self._constant = np.concatenate((input_bias, controller_bias[:, 0]))
        self._hidden, self._cell = (_view(tensor)[0] for tensor in state)
        n_envs = len(self._hidden)
        self._rows, self._step = np.arange(n_envs), 0
        #: Values of B at the steps made so far, ``(n_steps, n_envs, n_conditions)``; 0 where none is needed.
        self.condition_values = np.zeros((n_steps, n_envs, self.n_conditions), dtype=np.float32)
        self._n_controllers = module.n_controllers
        self._thresholds: Array | None = None  # where no branch is drawn
        # Noise of all steps is drawn at once, which is several times cheaper than a little at every step.
        if self.action.kind == "box":
            self._noise = rng.standard_normal((n_steps, n_envs, self.action.n_outputs), dtype=np.float32)
            if module.mixes_branches:
                self._draw_branches((n_steps, 1, n_envs), rng)
        else:
            sizes = (1,) * self.action.n_outputs if self.action.kind == "multi_binary" else self.action.sizes
            self._edges = np.cumsum(sizes)[:-1]
            self._draw_programs((n_steps, len(sizes), n_envs), rng)

    def _draw_branches(self, shape: tuple[int, int, int], rng: np.random.Generator) -> None:
        """Draw a program for every action, and how its branches will fall."""
        n_used = self.n_conditions if self._selected is None else self._selected
        self._last_controllers = np.full(shape, n_used)
        # B plus logistic noise is above 0 with the probability sigmoid(B).
        self._thresholds = self._temperature * _logistic(rng, (n_used, *shape))
        if self._selected is None:
            edges = np.cumsum(self._choices[n_used:-1])
            lengths = np.searchsorted(edges, rng.random(shape, dtype=np.float32), side="right")
            self._last_controllers += lengths
            self._thresholds[np.arange(n_used)[:, None, None, None] >= lengths] = np.inf  # not in this program

    def _draw_programs(self, shape: tuple[int, int, int], rng: np.random.Generator) -> None:
        """Draw a program for every action, how its branches will fall, and the noise of its controller's choice."""
        self._draw_branches(shape, rng)
        # Logits plus logistic noise are above 0 as often as their sigmoid says; the largest of logits plus Gumbel noise
        # is a draw from their softmax.
        size = (shape[0], shape[2], self.action.n_outputs)
        noise = _logistic if self.action.kind == "multi_binary" else _gumbel
        self._noise = noise(rng, size)

    @property
    def state(self) -> State:
        """The states of the conditions after the last step."""
        hidden, cell = (th.from_numpy(array)[None] for array in (self._hidden, self._cell))
        return hidden, cell

    def mixture_weights(self, condition_values: Array) -> Array:
        """Return the weight of every controller in use, as :meth:`ProgramModule.mixture_weights` does.

        :param condition_values: ``(n_envs, n_conditions)``
        """
        values = condition_values[:, : self._selected]
        if not values.shape[1]:
            return np.ones((len(values), 1), dtype=np.float32)
        taken = sigmoid(values / self._temperature)
        reached = np.empty((len(values), values.shape[1] + 1), dtype=np.float32)
        reached[:, 0] = 1
        np.multiply.accumulate(1 - taken, axis=1, out=reached[:, 1:])
        last = reached if self._selected is None else reached[:, -1:]
        weights = np.concatenate((taken * reached[:, :-1], last), axis=1)
        return weights * self._choices if self._selected is None else weights

    def branch_frequencies(self) -> Array:
        """Return how probable it was at the steps so far that each controller decided, ``(2 depth - 1,)``."""
        shares = np.zeros(self._n_controllers)
        condition_values = self.condition_values[: self._step].reshape(self._step * len(self._rows), self.n_conditions)
        shares[self._in_use] = self.mixture_weights(condition_values).mean(0)
        return shares

    def sample(self, inputs: Array) -> NDArray[Any]:
        """Draw one action for every environment.

        :param inputs: X, ``(n_envs, n_inputs)``
        :return: actions ``(n_envs, *action_shape)`` (Discrete without ``start``, Box flat and unclipped)
        """
        step, self._step = self._step, self._step + 1
        affine = inputs @ self._affine
        affine += self._constant
        if self.needs_conditions:
            self._run_conditions(affine[:, : self._n_gates], out=self.condition_values[step])
        outputs = affine[:, self._n_gates :].reshape(len(inputs), len(self._in_use), -1)
        if self.action.kind == "box" and self._thresholds is not None:
            return outputs[self._rows, self._controllers(step, 0)] + self._std * self._noise[step]
        if self.action.kind == "box":
            weights = self.mixture_weights(self.condition_values[step])
            return (weights[:, :, None] * outputs).sum(1) + self._std * self._noise[step]
        if self.action.kind == "discrete":
            return (outputs[self._rows, self._controllers(step, 0)] + self._noise[step]).argmax(1)
        components = np.split(outputs + self._noise[step][:, None], self._edges, axis=2)
        chosen = [part[self._rows, self._controllers(step, i)] for i, part in enumerate(components)]
        if self.action.kind == "multi_binary":
            return (np.concatenate(chosen, axis=1) > 0).astype(np.int8)
        return np.stack([logits.argmax(1) for logits in chosen], axis=1)

    def _controllers(self, step: int, component: int) -> NDArray[np.int64]:
        """Run the programs drawn for one component of the action; return which controller decides, ``(n_envs,)``."""
        assert self._thresholds is not None
        controllers = self._last_controllers[step, component]
        for k in reversed(range(len(self._thresholds))):
            np.copyto(controllers, k, where=self.condition_values[step, :, k] > self._thresholds[k, step, component])
        return controllers

    def _run_conditions(self, gates: Array, out: Array) -> None:
        """Advance the states and write the values of B into ``out``.

        :param gates: the affine part of the conditions, ``(n_envs, n_gates * hidden_size or n_conditions * n_sums)``
        :param out: ``(n_envs, n_conditions)``
        """
        if not self.recurrent:
            if self._n_sums == 1:
                out[:] = gates
            else:
                np.minimum.reduce(gates.reshape(len(gates), self.n_conditions, self._n_sums), axis=-1, out=out)
            return
        recurrent = self._hidden @ self._weight
        recurrent += self._bias
        self._hidden, self._cell = STEPS[self.cell](gates, recurrent, self._hidden, self._cell)
        if self.size == 1:
            np.multiply(self._hidden, self._readout[:, 0], out=out)
        else:
            units = self._hidden.reshape(len(gates), self.n_conditions, self.size)
            np.add.reduce(units * self._readout, -1, out=out)
        out += self._readout_bias


def _gumbel(rng: np.random.Generator, size: tuple[int, ...]) -> Array:
    exponential = rng.standard_exponential(size, dtype=np.float32)
    return -np.log(np.maximum(exponential, np.finfo(np.float32).tiny))


def _logistic(rng: np.random.Generator, size: tuple[int, ...]) -> Array:
    return _gumbel(rng, size) - _gumbel(rng, size)


def _view(tensor: th.Tensor) -> Array:
    return tensor.detach().numpy()
