"""States that were not visited: changed copies of visited ones, which the teacher labels too."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sb3_progpolicy.imitation.teachers import Observations
from sb3_progpolicy.nearest import unknown

#: From observations ``(n, n_observations)`` to changed ones, of the same shape.
Augment = Callable[[Observations, np.random.Generator], Observations]
_BLOCK, _MOST_LEVELS, _ON_THE_TABLE = 0.04, 5, 0.03  # metres, blocks, metres
_PLACED = 0.012  # metres


def taller_towers(names: Sequence[str]) -> Augment:
    """Return what raises the target of a PandaStack observation by some blocks: the tower is taller than in training.

    The hand goes with it in a third of the states; in the others it is raised by less, as on its way up or down. What
    it holds goes with the hand, and a block that is in its place with the tower.

    :param names: of the numbers of an observation
    :raises ValueError: if it has not the numbers that are changed
    """
    needed = ("gripper_z", "object_dz", "target_dz", "object_z", "target_z", "distance")
    if missing := [name for name in needed if name not in names]:
        raise ValueError(f"augment='taller_towers' is not accepted: the observation has no {', '.join(missing)}")
    gripper, object_way, target_way, block, target, distance = (list(names).index(name) for name in needed)

    def augment(observations: Observations, rng: np.random.Generator) -> Observations:
        raised = observations.copy()
        tower = _BLOCK * rng.integers(1, _MOST_LEVELS + 1, size=len(raised))
        hand = tower * np.where(rng.random(len(raised)) < 1 / 3, 1.0, rng.random(len(raised)))
        placed = (np.abs(observations[:, block] - observations[:, target]) < _PLACED) & (
            observations[:, distance] < _PLACED
        )
        hand = np.where(placed, tower, hand)
        moved = np.where(placed | (observations[:, block] > _ON_THE_TABLE), hand, 0.0)
        raised[:, target] += tower
        raised[:, gripper] += hand
        raised[:, block] += moved
        raised[:, target_way] += tower - hand
        raised[:, object_way] += moved - hand
        return raised

    return augment


#: Names of the ready ones.
AUGMENTATIONS: dict[str, Callable[[Sequence[str]], Augment]] = {"taller_towers": taller_towers}


def make_augmentation(given: str | Augment | None, names: Sequence[str]) -> Augment | None:
    """Return an augmentation.

    :param given: a name, a function, or ``None`` for none
    :param names: of the numbers of an observation
    :raises ValueError: if the name is not known or does not fit the observation
    """
    if not isinstance(given, str):
        return given
    if given not in AUGMENTATIONS:
        raise unknown("augmentation", given, AUGMENTATIONS)
    return AUGMENTATIONS[given](names)
