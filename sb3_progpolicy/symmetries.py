"""What a domain's symmetries mean for a program: how they move its inputs, and which of its weights are one number.

Source: MDP homomorphic networks (van der Pol et al., 2020): a policy that is equivariant under a group gives to states
that are one another's images actions that are, too. An affine map is equivariant if ``W P_g = Q_g W`` for every g of
the group, which acts by ``P_g`` on the inputs and by ``Q_g`` on the outputs. For signed permutations that makes each
weight equal, up to its sign, to all others of its orbit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.symmetry import Permutation, Symmetry, group_of
from sb3_progpolicy.spaces import ActionSpec


def as_data(symmetry: Symmetry) -> dict[str, Any]:
    """Return a symmetry as plain data, for files."""
    permutations = {"observation": symmetry.observation, "action": symmetry.action}
    return {
        "name": symmetry.name,
        **{key: {"source": list(one.source), "signs": list(one.signs)} for key, one in permutations.items()},
    }


def as_symmetry(given: Symmetry | Mapping[str, Any]) -> Symmetry:
    """Return a symmetry that is given as one or as plain data.

    :raises ValueError: if it is neither
    """
    if isinstance(given, Symmetry):
        return given
    try:
        observation, action = (
            Permutation.of(given[key]["source"], given[key]["signs"]) for key in ("observation", "action")
        )
        return Symmetry(str(given["name"]), observation, action)
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"symmetry {given!r} is not accepted; it has a name, an observation and an action, each of the two with "
            "source and signs"
        ) from error


def on_inputs(symmetry: Symmetry, n_inputs: int, action: ActionSpec) -> Permutation:
    """Return how a symmetry moves X: the observation, then, if X goes on, the previous action, reward and done flag.

    :param symmetry: of a domain
    :param n_inputs: length of X
    :param action: the action space
    :raises ValueError: if X is neither the observation nor that with the interaction history
    """
    n = len(symmetry.observation.source)
    if n_inputs == n:
        return symmetry.observation
    if n_inputs != n + action.interaction_size:
        raise ValueError(
            f"the symmetry {symmetry.name!r} of {n} numbers is not accepted for {n_inputs} inputs; {n} are, or "
            f"{n + action.interaction_size} with the interaction history"
        )
    source = [*symmetry.observation.source, *(n + index for index in symmetry.action.source)]
    signs = [*symmetry.observation.signs, *symmetry.action.signs]
    rest = range(len(source), n_inputs)
    return Permutation.of([*source, *rest], [*signs, *(1 for _ in rest)])


@dataclass(frozen=True)
class Ties:
    """Which weights of an affine map from X are one number, so that a group leaves the map as it is.

    :param index: ``(n_outputs, n_inputs + 1)``: which free number each weight is; the last column is the bias
    :param sign: the same shape: 1, -1, or 0 for a weight that has to be 0
    """

    index: NDArray[np.int64]
    sign: NDArray[np.float32]

    @property
    def n_free(self) -> int:
        """How many free numbers there are."""
        return int(self.index.max()) + 1 if self.sign.any() else 0


class Group:
    """A group of symmetries, as it acts on a program.

    :param symmetries: its generators, as :class:`Symmetry` or as plain data
    :param n_inputs: length of X
    :param action: the action space, Discrete or Box
    :raises ValueError: if they do not fit the spaces
    """

    def __init__(self, symmetries: Sequence[Symmetry | Mapping[str, Any]], n_inputs: int, action: ActionSpec) -> None:
        self.members = group_of([as_symmetry(one) for one in symmetries])
        if not self.members:
            raise ValueError("no symmetry is given; at least one is needed")
        self.n_inputs, self.n_outputs = n_inputs, action.n_outputs
        if action.kind not in ("discrete", "box") or len(self.members[0].action.source) != self.n_outputs:
            raise ValueError(
                f"symmetries of {len(self.members[0].action.source)} actions are not accepted for {self.n_outputs} "
                f"outputs of a {action.kind} space; Discrete and Box spaces of as many are"
            )
        if action.kind == "box" and any(one.action.source != tuple(range(self.n_outputs)) for one in self.members):
            raise ValueError("symmetries that exchange numbers of a Box action are not accepted; changes of sign are")
        self.inputs = [on_inputs(one, n_inputs, action) for one in self.members]
        self.outputs = [one.action for one in self.members]

    def ties(self) -> Ties:
        """Return which weights of an affine map from X to the outputs are one number."""
        width = self.n_inputs + 1
        images = np.empty((len(self.members), self.n_outputs * width), dtype=np.int64)
        signs = np.empty(images.shape)
        for row, (inputs, outputs) in enumerate(zip(self.inputs, self.outputs, strict=True)):
            to_output, output_signs = _targets(outputs, self.n_outputs)
            to_input, input_signs = _targets(inputs, width)
            images[row] = (to_output[:, None] * width + to_input).ravel()
            signs[row] = (output_signs[:, None] * input_signs).ravel()
        first = images.min(axis=0)
        there = images == first
        positive, negative = (there & (signs > 0)).any(axis=0), (there & (signs < 0)).any(axis=0)
        sign = np.where(positive & negative, 0.0, np.where(positive, 1.0, -1.0))
        free, index = np.unique(np.where(sign == 0, -1, first), return_inverse=True)
        index = index - int(free[0] == -1)  # those that have to be 0 are none of the free ones
        shape = (self.n_outputs, width)
        return Ties(index.clip(0).reshape(shape).astype(np.int64), sign.reshape(shape).astype(np.float32))

    def mean_of_inputs(self) -> NDArray[np.float32]:
        """Return the projection onto what the group leaves as it is, ``(n_inputs, n_inputs)``: the mean over it.

        A condition that reads ``mean_of_inputs() @ X`` decides alike in states that are one another's images.
        """
        return np.mean([matrix_of(inputs) for inputs in self.inputs], axis=0).astype(np.float32)


def matrix_of(permutation: Permutation) -> NDArray[np.float64]:
    """Return the matrix of a signed permutation."""
    matrix = np.zeros((len(permutation.source),) * 2)
    matrix[np.arange(len(permutation.source)), list(permutation.source)] = permutation.signs
    return matrix


def _targets(permutation: Permutation, width: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return where each number goes and with which sign; numbers beyond the permutation, as a constant, stay."""
    targets, signs = np.arange(width), np.ones(width)
    source = np.array(permutation.source, dtype=np.int64)
    targets[source] = np.arange(len(source))
    signs[source] = permutation.signs
    return targets, signs
