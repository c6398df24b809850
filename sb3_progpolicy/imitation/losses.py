"""How far a controller is from the teacher's actions, and the controller that is nearest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from sb3_progpolicy.imitation.decision_list import Data, DecisionList, Floats

if TYPE_CHECKING:
    import torch as th

DELTA = 0.1  # Huber's: errors beyond it count by their size, not its square
SATURATED = 0.999
_OVERSHOOT = 0.15  # weight of too much along a direction that the teacher has shortened to fit into the bounds
_SMALL = 0.1  # labels up to it count as meant, not as shortened
_MAX_NATS = 3.0  # a wrong decision costs no more than this, however sure it is
_SUPPORTS = (0, 1, 2, 3, 4, 6, 8, 12)
_FEW = 6  # inputs


class Loss(Protocol):
    """What fitting needs to know of an action space."""

    def matrix(self, data: Data, controllers: Floats) -> Floats:
        """Return the loss of every controller in every state, ``(n, n_controllers)``."""

    def fit(self, data: Data, start: Floats | None = None, iterations: int = 8, ridge: float = 1e-4) -> Floats:
        """Return the controller of the least weighted loss, ``(n_outputs, n_inputs + 1)``."""

    def fit_sparse(self, data: Data, start: Floats, tolerance: float, always_few: bool = False) -> Floats:
        """Return the controller of fewest inputs whose mean loss is at most ``tolerance`` above the least.

        With ``always_few`` it is one of at most six inputs for each output even if none is within the tolerance.
        """

    def expected(self, outputs: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """Return the loss of outputs ``(n, n_controllers, n_outputs)`` against ``(n, n_outputs)``, differentiable."""


def list_losses(loss: Loss, program: DecisionList, data: Data) -> Floats:
    """Return the loss of a decision list in every state, ``(n,)``."""
    losses, branches = np.zeros(len(data)), program.branches(data.inputs)
    for index in range(program.n_branches):
        here = branches == index
        if here.any():
            losses[here] = loss.matrix(data.take(here), program.controllers[index : index + 1])[:, 0]
    return losses


def mean_loss(loss: Loss, program: DecisionList, data: Data) -> float:
    """Return the weighted mean loss of a decision list."""
    return float(np.average(list_losses(loss, program, data), weights=data.weights))


def huber(sizes: Floats) -> Floats:
    """Return Huber's loss of the sizes of errors."""
    return np.where(sizes < DELTA, 0.5 * sizes * sizes / DELTA, sizes - 0.5 * DELTA)


@dataclass(frozen=True)
class BoxLoss:
    """Huber's loss of clipped outputs, summed over outputs; actions are scaled to [-1, 1].

    :param bounded: which outputs are clipped, ``(n_outputs,)``
    :param direction: outputs that are one vector, which the teacher shortens to fit into the bounds; where one of
        them is saturated, more of the others is hardly wrong
    """

    bounded: np.ndarray
    direction: tuple[int, ...] = ()

    def matrix(self, data: Data, controllers: Floats) -> Floats:
        """See :meth:`Loss.matrix`."""
        n_controllers, n_outputs, width = controllers.shape
        outputs = (data.inputs @ controllers.reshape(-1, width).T).reshape(-1, n_controllers, n_outputs)
        outputs = np.where(self.bounded, np.clip(outputs, -1, 1), outputs)
        errors = outputs - data.targets[:, None]
        losses = huber(np.abs(errors))
        if self.direction:
            over = errors * np.sign(data.targets)[:, None] > 0
            losses = np.where(over, losses * self._slack(data.targets)[:, None], losses)
        return np.asarray(losses.sum(axis=2))

    def fit(self, data: Data, start: Floats | None = None, iterations: int = 8, ridge: float = 1e-4) -> Floats:
        """Return the controller by iteratively reweighted ridge regression. See :meth:`Loss.fit`."""
        n_outputs, width = data.targets.shape[1], data.inputs.shape[1]
        controller = np.zeros((n_outputs, width)) if start is None else start.copy()
        penalty = ridge * max(data.weights.sum(), 1.0) * np.eye(width)
        penalty[-1, -1] *= 1e-3
        slack = self._slack(data.targets)
        for iteration in range(iterations):
            for output in range(n_outputs):
                weights = data.weights
                if iteration or start is not None:
                    weights = weights * self.reweighted(data, controller[output], output, slack)
                scaled = data.inputs * weights[:, None]
                controller[output] = np.linalg.solve(
                    scaled.T @ data.inputs + penalty, scaled.T @ data.targets[:, output]
                )
        return controller

    def fit_sparse(self, data: Data, start: Floats, tolerance: float, always_few: bool = False) -> Floats:
        """Return each output with the fewest inputs, by backward elimination. See :meth:`Loss.fit_sparse`."""
        full = self.fit(data, start, iterations=4, ridge=1e-5)
        slack, width = self._slack(data.targets), data.inputs.shape[1]
        sparse = full.copy()
        for output in range(len(full)):
            weights = data.weights * np.maximum(self.reweighted(data, full[output], output, slack), 0.02)
            hessian = (data.inputs * weights[:, None]).T @ data.inputs / DELTA + 1e-5 * len(data) * np.eye(width)
            supports = eliminate(hessian, full[output])
            limit = self.of_output(data, full[output], output, slack) + tolerance
            least = np.inf
            for size in _SUPPORTS[: _SUPPORTS.index(_FEW) + 1] if always_few else _SUPPORTS:
                support = next(kept for kept, _ in supports if kept.sum() <= size + 1)
                row = self.fit_support(data, output, support, slack)
                reached = self.of_output(data, row, output, slack)
                if reached <= limit or (always_few and reached < least):
                    sparse[output], least = row, reached
                if reached <= limit:
                    break
        return sparse

    def expected(self, outputs: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """See :meth:`Loss.expected`."""
        import torch as th

        clipped = outputs.clamp(-1, 1)
        # A small slope beyond the bounds, so that a saturated output can come back.
        leaky = clipped + 0.05 * ((outputs - clipped) - (outputs - clipped).detach())
        outputs = th.where(th.as_tensor(self.bounded), leaky, outputs)
        errors = outputs - targets[:, None]
        sizes = errors.abs()
        losses = th.where(sizes < DELTA, 0.5 * sizes * sizes / DELTA, sizes - 0.5 * DELTA)
        if self.direction:
            slack = th.as_tensor(self._slack(targets.numpy().astype(np.float64)), dtype=losses.dtype)
            losses = th.where(errors * targets.sign()[:, None] > 0, losses * slack[:, None], losses)
        return losses.sum(dim=2)

    def _slack(self, targets: Floats) -> Floats:
        """Return how much an overshoot counts, ``(n, n_outputs)``."""
        slack = np.ones_like(targets)
        if self.direction:
            columns = list(self.direction)
            saturated = np.abs(targets[:, columns]) >= SATURATED
            shortened = saturated.any(axis=1, keepdims=True) & ~saturated & (np.abs(targets[:, columns]) > _SMALL)
            slack[:, columns] = np.where(shortened, _OVERSHOOT, 1.0)
        return slack

    def reweighted(self, data: Data, row: Floats, output: int, slack: Floats) -> Floats:
        """Return the weights whose squared loss has the gradient of this one; 0 beyond a bound that the label is at."""
        target = data.targets[:, output]
        errors = data.inputs @ row - target
        over = errors * np.sign(target) > 0
        weights = DELTA / np.maximum(np.abs(errors), DELTA)
        weights = np.where(over, weights * slack[:, output], weights)
        if self.bounded[output]:
            weights = np.where(over & (np.abs(target) >= SATURATED), 0.0, weights)
        return weights

    def of_output(self, data: Data, row: Floats, output: int, slack: Floats) -> float:
        """Return the mean loss of one output."""
        target = data.targets[:, output]
        values = data.inputs @ row
        errors = (np.clip(values, -1, 1) if self.bounded[output] else values) - target
        losses = huber(np.abs(errors))
        losses = np.where(errors * np.sign(target) > 0, losses * slack[:, output], losses)
        return float(np.average(losses, weights=data.weights))

    def fit_support(self, data: Data, output: int, support: np.ndarray, slack: Floats) -> Floats:
        """Return the weights of one output ``(width,)`` that are 0 outside a support, a mask with the constant."""
        row = np.zeros(data.inputs.shape[1])
        inputs, target = data.inputs[:, support], data.targets[:, output]
        penalty = 1e-5 * len(data) * np.eye(inputs.shape[1])
        for iteration in range(6):
            weights = data.weights * (self.reweighted(data, row, output, slack) if iteration else 1.0)
            scaled = inputs * weights[:, None]
            row[support] = np.linalg.solve(scaled.T @ inputs + penalty, scaled.T @ target)
        return row


class DiscreteLoss:
    """Cross-entropy of the softmax of the outputs, cut off; labels are 1 for every action that is right, else 0."""

    def matrix(self, data: Data, controllers: Floats) -> Floats:
        """See :meth:`Loss.matrix`."""
        n_controllers, n_outputs, width = controllers.shape
        outputs = (data.inputs @ controllers.reshape(-1, width).T).reshape(-1, n_controllers, n_outputs)
        outputs = outputs - outputs.max(axis=2, keepdims=True)
        powers = np.exp(outputs)
        right = (powers * data.targets[:, None]).sum(axis=2) / powers.sum(axis=2)
        return np.asarray(-np.log(np.maximum(right, np.exp(-_MAX_NATS))))

    def fit(self, data: Data, start: Floats | None = None, iterations: int = 8, ridge: float = 1e-4) -> Floats:
        """Return the controller by multinomial logistic regression. See :meth:`Loss.fit`."""
        shape = (data.targets.shape[1], data.inputs.shape[1])
        start = np.zeros(shape) if start is None else start
        return self._fit_support(data, start, np.ones(shape, dtype=bool), 6 * iterations, ridge)

    def fit_sparse(self, data: Data, start: Floats, tolerance: float, always_few: bool = False) -> Floats:
        """Leave out the smallest weights again and again. See :meth:`Loss.fit_sparse`."""
        best = self.fit(data, start, iterations=10)
        support = np.ones(best.shape, dtype=bool)
        limit = self._mean(data, best) + tolerance
        step = max(1, int(support[:, :-1].sum()) // 4)
        while step:
            sizes = np.where(support, np.abs(best), np.inf)
            sizes[:, -1] = np.inf
            smallest = [place for place in np.argsort(sizes, axis=None)[:step] if np.isfinite(sizes.flat[place])]
            fewer = support.copy()
            fewer.flat[smallest] = False
            attempt = self._fit_support(data, np.where(fewer, best, 0.0), fewer, 60, 1e-4)
            if smallest and self._mean(data, attempt) <= limit:
                best, support = attempt, fewer
            else:
                step //= 2
        return best

    def expected(self, outputs: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """See :meth:`Loss.expected`."""
        right = outputs.masked_fill(targets[:, None] == 0, -1e9).logsumexp(dim=2)
        nats = outputs.logsumexp(dim=2) - right
        return _MAX_NATS * (1 - (-nats / _MAX_NATS).exp())

    def _mean(self, data: Data, controller: Floats) -> float:
        return float(np.average(self.matrix(data, controller[None])[:, 0], weights=data.weights))

    def _fit_support(self, data: Data, start: Floats, support: np.ndarray, iterations: int, ridge: float) -> Floats:
        from scipy.optimize import minimize

        weights = data.weights / max(data.weights.sum(), 1e-12)
        penalty = np.where(np.arange(start.shape[1]) == start.shape[1] - 1, 1e-3, 1.0) * ridge

        def objective(numbers: Floats) -> tuple[float, Floats]:
            controller = np.zeros(start.shape)
            controller[support] = numbers
            outputs = data.inputs @ controller.T
            outputs -= outputs.max(axis=1, keepdims=True)
            powers = np.exp(outputs)
            shares = powers / powers.sum(axis=1, keepdims=True)
            right = shares * data.targets
            total = np.maximum(right.sum(axis=1, keepdims=True), 1e-12)
            gradient = ((shares - right / total) * weights[:, None]).T @ data.inputs + penalty * controller
            value = -(weights * np.log(total[:, 0])).sum() + 0.5 * (penalty * controller**2).sum()
            return float(value), gradient[support]

        found = minimize(objective, start[support], jac=True, method="L-BFGS-B", options={"maxiter": iterations})
        controller = np.zeros(start.shape)
        controller[support] = found.x
        return controller


def eliminate(hessian: Floats, weights: Floats) -> list[tuple[np.ndarray, Floats]]:
    """Return which inputs are left when they are taken out one by one, the least needed first; the constant stays.

    This is the optimal brain surgeon (Hassibi and Stork 1993): the one to go next costs the least of a quadratic loss
    once all others are adjusted.

    :param hessian: of the loss, ``(width, width)``, the constant last
    :param weights: at its least, ``(width,)``
    :return: masks ``(width,)`` from all to the constant alone, each with the adjusted weights
    """
    kept, inverse, weights = np.ones(len(weights), dtype=bool), np.linalg.inv(hessian), weights.copy()
    steps = [(kept.copy(), weights)]
    while kept[:-1].any():
        costs = np.where(kept, weights**2 / np.maximum(np.diag(inverse), 1e-300), np.inf)
        costs[-1] = np.inf
        least = int(costs.argmin())
        weights = weights - weights[least] / inverse[least, least] * inverse[:, least]
        inverse = inverse - np.outer(inverse[:, least], inverse[least]) / inverse[least, least]
        kept[least], weights[least] = False, 0.0
        steps.append((kept.copy(), weights.copy()))
    return steps
