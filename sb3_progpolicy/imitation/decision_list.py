"""The program while it is fitted: conditions and controllers as arrays, on standardised inputs."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_CONSTANT = 1e-4  # an input that varies less than this is left out


@dataclass(frozen=True)
class Data:
    """Labelled states.

    :param inputs: standardised, ``(n, n_inputs + 1)``; the last column is 1
    :param targets: labels, ``(n, n_outputs)``
    :param weights: ``(n,)``
    """

    inputs: Floats
    targets: Floats
    weights: Floats

    def __len__(self) -> int:
        return len(self.inputs)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Data:
        """Return some of the states.

        :param rows: a mask or indices
        """
        return Data(self.inputs[rows], self.targets[rows], self.weights[rows])


@dataclass(frozen=True)
class Scaler:
    """Shifts and scales inputs to mean 0 and variance 1, and leaves out those that do not vary or may not be read.

    :param mean: ``(n_inputs,)``
    :param scale: standard deviations, ``(n_inputs,)``
    :param kept: which inputs are read, ``(n_inputs,)``
    """

    mean: Floats
    scale: Floats
    kept: NDArray[np.bool_]

    @classmethod
    def of(cls, observations: NDArray[np.floating], allowed: NDArray[np.bool_]) -> Scaler:
        """Return the scaler of some observations.

        :param observations: ``(n, n_inputs)``
        :param allowed: which inputs may be read, ``(n_inputs,)``
        """
        deviation = observations.std(axis=0, dtype=np.float64)
        varies = deviation >= _CONSTANT
        return cls(observations.mean(axis=0, dtype=np.float64), np.where(varies, deviation, 1.0), allowed & varies)

    def __call__(self, observations: NDArray[np.floating]) -> Floats:
        """Return standardised inputs ``(n, n_kept + 1)``, the last column 1."""
        scaled = ((observations - self.mean) / self.scale)[:, self.kept]
        return np.column_stack([scaled, np.ones(len(observations))])

    def to_raw(self, weights: Floats) -> Floats:
        """Return weights ``(..., n_inputs + 1)`` on raw inputs for ``(..., n_kept + 1)`` on standardised ones."""
        raw = np.zeros((*weights.shape[:-1], len(self.mean)))
        raw[..., self.kept] = weights[..., :-1] / self.scale[self.kept]
        return np.concatenate([raw, weights[..., -1:] - (raw * self.mean).sum(axis=-1, keepdims=True)], axis=-1)

    def from_raw(self, raw: Floats) -> Floats:
        """Return weights on standardised inputs for weights on raw ones; those of inputs left out are lost."""
        constant = raw[..., -1:] + (raw[..., :-1] * self.mean).sum(axis=-1, keepdims=True)
        return np.concatenate([raw[..., :-1][..., self.kept] * self.scale[self.kept], constant], axis=-1)


@dataclass(frozen=True)
class DecisionList:
    """The first condition that holds decides which controller acts; the last controller acts where none holds.

    A condition has one or more sums over the inputs. It holds where none of them is below 0.

    :param conditions: the weights of all sums, ``(n_sums, n_inputs + 1)``
    :param controllers: ``(n_branches, n_outputs, n_inputs + 1)``
    :param owners: of which condition each sum is, ascending, ``(n_sums,)``; by default each is a condition
    """

    conditions: Floats
    controllers: Floats
    owners: NDArray[np.intp] = field(default=None)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        if self.owners is None:
            object.__setattr__(self, "owners", np.arange(len(self.conditions)))
        assert np.array_equal(np.unique(self.owners), np.arange(self.n_branches - 1)), "each condition has a sum"
        assert len(self.owners) == len(self.conditions), "each sum has an owner"

    @property
    def n_branches(self) -> int:
        """Number of controllers."""
        return len(self.controllers)

    def branches(self, inputs: Floats) -> NDArray[np.intp]:
        """Return which controller acts, ``(n,)``.

        :param inputs: ``(n, n_inputs + 1)``
        """
        holds = inputs @ self.conditions.T >= 0
        if len(self.owners) >= self.n_branches:
            first_sums = np.searchsorted(self.owners, np.arange(self.n_branches - 1))
            holds = np.logical_and.reduceat(holds, first_sums, axis=1)
        return np.column_stack([holds, np.ones(len(inputs), dtype=bool)]).argmax(axis=1)

    def sums_of(self, condition: int) -> Floats:
        """Return the sums of a condition, ``(n_sums, n_inputs + 1)``.

        :param condition: its index
        """
        return self.conditions[self.owners == condition]

    def outputs(self, inputs: Floats) -> Floats:
        """Return what the acting controllers give, ``(n, n_outputs)``.

        :param inputs: ``(n, n_inputs + 1)``
        """
        return np.asarray(np.einsum("nd,nod->no", inputs, self.controllers[self.branches(inputs)]))

    def insert(self, position: int, condition: Floats, controller: Floats) -> DecisionList:
        """Return the list with one more branch, whose condition is one sum.

        :param position: of the new branch; at most that of the last controller, which stays the last
        :param condition: ``(n_inputs + 1,)``
        :param controller: ``(n_outputs, n_inputs + 1)``
        """
        place = int(np.searchsorted(self.owners, position))
        return DecisionList(
            np.insert(self.conditions, place, condition, axis=0),
            np.insert(self.controllers, position, controller, axis=0),
            np.insert(self.owners + (self.owners >= position), place, position),
        )

    def without(self, index: int) -> DecisionList:
        """Return the list without a branch; without the last one, the last condition's controller is the else.

        :param index: of the controller
        """
        condition = min(index, self.n_branches - 2)
        left = self.owners != condition
        return DecisionList(
            self.conditions[left],
            np.delete(self.controllers, index, axis=0),
            self.owners[left] - (self.owners[left] > condition),
        )


def rest_losses(losses: Floats, holds: NDArray[np.bool_]) -> list[Floats]:
    """Return, for every branch, the loss of the list from there on, ``(n,)`` each.

    :param losses: of each branch's controller in each state, ``(n, n_branches)``
    :param holds: whether each condition holds, ``(n, n_branches - 1)``
    """
    rest = [losses[:, -1]]
    for index in reversed(range(holds.shape[1])):
        rest.insert(0, np.where(holds[:, index], losses[:, index], rest[0]))
    return rest
