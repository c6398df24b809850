"""Programs whose conditions remember: for teachers whose action is not a function of the present input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.imitation.conversion import significant
from sb3_progpolicy.imitation.decision_list import Floats, Scaler
from sb3_progpolicy.imitation.losses import Loss
from sb3_progpolicy.imitation.tuning import branch_chances
from sb3_progpolicy.programs.syntax import Cell, Condition, Controller, Expression, IfThenElse

if TYPE_CHECKING:
    import torch as th

    from sb3_progpolicy.differentiable.module import Conditions

#: Cells of conditions that remember.
RECURRENT_CELLS: tuple[Cell, ...] = ("gru",)
_RESTARTS = 4
_TEMPERATURES = (1.0, 0.1)
_LEARNING_RATE = 0.02
_MAX_NORM = 1.0  # of the gradient


@dataclass(frozen=True)
class Sequences:
    """Labelled states in the order in which they were visited.

    :param inputs: ``(n_steps, n_sequences, n_inputs)``
    :param targets: labels, ``(n_steps, n_sequences, n_outputs)``
    :param weights: ``(n_steps, n_sequences)``; 0 where there is nothing
    """

    inputs: NDArray[np.float32]
    targets: Floats
    weights: Floats

    @classmethod
    def of(cls, parts: list[tuple[NDArray[np.float32], Floats, Floats]]) -> Sequences:
        """Put rounds side by side; shorter ones end early.

        :param parts: inputs, targets and weights of each round
        """
        length = max(len(inputs) for inputs, _, _ in parts)

        def joined(index: int) -> Any:
            padded = []
            for part in parts:
                array = part[index]
                padded.append(np.pad(array, [(0, length - len(array)), *[(0, 0)] * (array.ndim - 1)]))
            return np.concatenate(padded, axis=1)

        return cls(joined(0), joined(1), joined(2))


def fit_sequences(
    loss: Loss, data: Sequences, readable: NDArray[np.bool_], n_conditions: int, horizon: int, seed: int, n_steps: int
) -> tuple[Expression, float]:
    """Return the program with memory of the least loss, and that loss with crisp decisions.

    Adam on the expected loss of the branch that the conditions' sigmoids draw, through whole sequences, from several
    starts; the sigmoids become crisp meanwhile. The bias of the gate that keeps the memory is drawn for spans up to
    ``horizon`` (Tallec and Ollivier 2018).

    :param loss: of the action space
    :param data: labelled states
    :param readable: which inputs may be read, ``(n_inputs,)``
    :param n_conditions: of the program
    :param horizon: steps over which it may have to remember
    :param seed: of the starts
    :param n_steps: of Adam, from each start
    """
    import torch as th

    there = data.weights > 0
    scaler = Scaler.of(data.inputs[there], readable)
    flat = scaler(data.inputs.reshape(-1, data.inputs.shape[-1]))[:, :-1]
    inputs = th.tensor(flat, dtype=th.float32).unflatten(0, data.inputs.shape[:2])
    targets = th.tensor(data.targets[there], dtype=th.float32)
    weights = th.tensor(data.weights[there] / data.weights[there].mean(), dtype=th.float32)
    mask = th.tensor(there)
    best: tuple[float, _Start] | None = None
    for start in range(_RESTARTS):
        with th.random.fork_rng(devices=[]):
            th.manual_seed(seed + start)
            program = _Start(inputs.shape[-1], n_conditions, data.targets.shape[-1], horizon)
        reached = program.fit(loss, inputs, targets, weights, mask, n_steps)
        if best is None or reached < best[0]:
            best = reached, program
    assert best is not None
    return best[1].to_syntax(scaler), best[0]


class _Start:
    """Conditions with one unit each, and their controllers, while they are fitted."""

    def __init__(self, n_inputs: int, n_conditions: int, n_outputs: int, horizon: int) -> None:
        import torch as th

        from sb3_progpolicy.differentiable.module import Conditions

        self.conditions = Conditions(n_inputs, n_conditions, "gru")
        with th.no_grad():
            for name in ("bias_ih_l0", "bias_hh_l0"):
                keeps: Any = getattr(self.conditions.rnn, name)
                spans = 1 + th.rand(n_conditions) * max(1, horizon - 1)
                keeps[n_conditions : 2 * n_conditions] = 0.5 * th.log(spans)
        shape = (n_conditions + 1, n_outputs, n_inputs + 1)
        self.controllers = (0.1 * th.randn(shape)).requires_grad_()

    def fit(
        self,
        loss: Loss,
        inputs: th.Tensor,
        targets: th.Tensor,
        weights: th.Tensor,
        mask: th.Tensor,
        n_steps: int,
    ) -> float:
        """Fit all numbers; return the mean loss of the branches that act."""
        import torch as th

        parameters = [*self.conditions.parameters(), self.controllers]
        optimizer = th.optim.Adam(parameters, lr=_LEARNING_RATE)
        first, last = _TEMPERATURES
        for step in range(n_steps):
            done = step / n_steps
            optimizer.param_groups[0]["lr"] = _LEARNING_RATE * (1 - done) + 1e-4
            values, losses = self._run(loss, inputs, targets, mask)
            chances = branch_chances(values / (first * (last / first) ** done))
            objective = ((chances * losses).sum(dim=1) * weights).mean()
            optimizer.zero_grad()
            objective.backward()
            th.nn.utils.clip_grad_norm_(parameters, _MAX_NORM)
            optimizer.step()
        with th.no_grad():
            values, losses = self._run(loss, inputs, targets, mask)
            holds = th.cat([values >= 0, th.ones(len(values), 1, dtype=th.bool)], dim=1)
            acting = holds.float().argmax(dim=1, keepdim=True)
            return float((losses.gather(1, acting)[:, 0] * weights).mean())

    def _run(self, loss: Loss, inputs: th.Tensor, targets: th.Tensor, mask: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the conditions' values and the loss of each controller where there is a label, ``(n, ...)``."""
        import torch as th

        zeros = th.zeros(1, inputs.shape[1], self.conditions.hidden_size)
        values, _ = self.conditions(inputs, (zeros, zeros))
        known = inputs[mask]
        outputs = th.einsum("nd,kod->nko", known, self.controllers[..., :-1]) + self.controllers[..., -1]
        return values[mask], loss.expected(outputs, targets)

    def to_syntax(self, scaler: Scaler) -> Expression:
        """Return the program on raw inputs."""
        raw = scaler.to_raw(self.controllers.detach().double().numpy())
        body: Expression = _controller(raw[-1])
        for index in reversed(range(len(raw) - 1)):
            body = IfThenElse(_on_raw(self.conditions, index, scaler), _controller(raw[index]), body)
        return body


def _controller(matrix: Floats) -> Controller:
    return Controller(tuple(map(tuple, matrix[:, :-1].tolist())), tuple(matrix[:, -1].tolist()))


def _on_raw(conditions: Conditions, index: int, scaler: Scaler) -> Condition:
    fitted = conditions.to_syntax(index)
    raw = scaler.to_raw(np.column_stack([np.array(fitted.weight_ih), np.array(fitted.bias_ih)]))
    return Condition(
        cell=fitted.cell,
        weight_ih=tuple(map(tuple, raw[:, :-1].tolist())),
        weight_hh=fitted.weight_hh,
        bias_ih=tuple(raw[:, -1].tolist()),
        bias_hh=fitted.bias_hh,
        readout=fitted.readout,
        readout_bias=fitted.readout_bias,
    )


def map_numbers(
    body: Expression, condition: Callable[[Floats], Floats], output: Callable[[Floats], Floats]
) -> Expression:
    """Return a program whose numbers went through functions.

    :param body: the program
    :param condition: of any numbers of a condition
    :param output: of a controller, ``(n_outputs, n_inputs + 1)``
    """

    def matrix(rows: Any) -> Any:
        return tuple(map(tuple, condition(np.array(rows)).tolist()))

    def vector(numbers: Any) -> Any:
        return tuple(condition(np.array(numbers)).tolist())

    def controller(old: Controller) -> Controller:
        return _controller(output(np.column_stack([np.array(old.weights), np.array(old.bias)])))

    if isinstance(body, Controller):
        return controller(body)
    old = body.condition
    test = Condition(
        cell=old.cell,
        weight_ih=matrix(old.weight_ih),
        weight_hh=matrix(old.weight_hh),
        bias_ih=vector(old.bias_ih),
        bias_hh=vector(old.bias_hh),
        readout=vector(old.readout),
        readout_bias=float(condition(np.array(old.readout_bias))),
    )
    return IfThenElse(test, controller(body.then), map_numbers(body.orelse, condition, output))


def rounded_body(body: Expression, digits: int) -> Expression:
    """Return a program whose numbers have so many significant digits.

    :param body: the program
    :param digits: of each number
    """

    def short(numbers: Floats) -> Floats:
        return significant(numbers, digits)

    return map_numbers(body, short, short)
