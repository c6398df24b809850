"""States that were not visited: changed copies of visited ones, which the teacher labels too."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sb3_progpolicy.imitation.teachers import Observations
from sb3_progpolicy.nearest import unknown

#: From observations ``(n, n_observations)`` to changed ones, of the same shape.
Augment = Callable[[Observations, np.random.Generator], Observations]
_BLOCK, _MOST_LEVELS, _ON_THE_TABLE = 0.04, 5, 0.03  # metres, blocks, metres


def taller_towers(names: Sequence[str]) -> Augment:
    """Return what raises the target of a PandaStack observation by some blocks, and for half of them the hand with it.

    A block that is off the table goes with the hand. These are states of towers taller than those of training.

    :param names: of the numbers of an observation
    :raises ValueError: if it has not the numbers that are changed
    """
    needed = ("gripper_z", "object_dz", "target_dz", "object_z", "target_z")
    if missing := [name for name in needed if name not in names]:
        raise ValueError(f"augment='taller_towers' is not accepted: the observation has no {', '.join(missing)}")
    gripper, object_way, target_way, block, target = (list(names).index(name) for name in needed)

    def augment(observations: Observations, rng: np.random.Generator) -> Observations:
        raised = observations.copy()
        height = _BLOCK * rng.integers(1, _MOST_LEVELS + 1, size=len(raised))
        with_hand = rng.random(len(raised)) < 0.5
        with_block = with_hand & (observations[:, block] > _ON_THE_TABLE)
        raised[:, target] += height
        raised[:, gripper] += height * with_hand
        raised[:, block] += height * with_block
        raised[:, target_way] += height * ~with_hand
        raised[:, object_way] -= height * (with_hand & ~with_block)
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
