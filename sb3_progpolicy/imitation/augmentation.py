"""What is learned from beyond the training variations: states that were not visited, or other starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_progpolicy.imitation.teachers import Observations
from sb3_progpolicy.nearest import unknown

#: From observations ``(n, n_observations)`` to changed ones, ``(m, n_observations)``.
Augment = Callable[[Observations, np.random.Generator], Observations]
_BLOCK, _MOST_LEVELS, _ON_THE_TABLE = 0.04, 5, 0.03  # metres, blocks, metres
_PLACED = 0.012  # metres
_NEAR, _ABOVE = (0.12, 0.2), 0.05  # of the hand from the tower, along x and y, and over it, metres
_TIMES = 3  # so many states are made of one near the tower, where a mistake throws it over


def taller_towers(names: Sequence[str]) -> Augment:
    """Return what raises the target of a PandaStack observation by some blocks: the tower is taller than in training.

    The hand goes with it where it is over the tower, and in a third of the other states; else it is raised by less, as
    on its way up or down. What it holds goes with the hand, and a block that is in its place with the tower.

    :param names: of the numbers of an observation
    :raises ValueError: if it has not the numbers that are changed
    """
    needed = ("gripper_z", "object_dz", "target_dx", "target_dy", "target_dz", "distance", "object_z", "target_z")
    if missing := [name for name in needed if name not in names]:
        raise ValueError(f"augment='taller_towers' is not accepted: the observation has no {', '.join(missing)}")
    place = {name: list(names).index(name) for name in needed}

    def augment(observations: Observations, rng: np.random.Generator) -> Observations:
        def near(beyond: Sequence[float]) -> np.ndarray:
            ways = np.abs(observations[:, [place["target_dx"], place["target_dy"]]])
            return np.asarray((ways < np.array(beyond)).all(axis=1))

        observations = np.repeat(observations, np.where(near(_NEAR), _TIMES, 1), axis=0)
        raised, over = observations.copy(), near((_ABOVE, _ABOVE))
        block = observations[:, place["object_z"]]
        placed = np.abs(block - observations[:, place["target_z"]]) < _PLACED
        placed &= observations[:, place["distance"]] < _PLACED
        tower = _BLOCK * rng.integers(1, _MOST_LEVELS + 1, size=len(raised))
        hand = tower * np.where(rng.random(len(raised)) < 1 / 3, 1.0, rng.random(len(raised)))
        hand = np.where(placed | over, tower, hand)
        moved = np.where(placed | (block > _ON_THE_TABLE), hand, 0.0)
        for name, way in (
            ("target_z", tower),
            ("gripper_z", hand),
            ("object_z", moved),
            ("target_dz", tower - hand),
            ("object_dz", moved - hand),
        ):
            raised[:, place[name]] += way
        return raised

    return augment


#: Names of the ready ones.
AUGMENTATIONS: dict[str, Callable[[Sequence[str]], Augment]] = {"taller_towers": taller_towers}


#: Begins an episode of an environment, by a seed and a variation, in another way than ``reset``; the observation.
Begin = Callable[[Any, int, Mapping[str, Any]], Observations]
_MOST_BEGUN, _MOST_BELOW = 5, 4  # blocks of a tower; of those over which the gripper's neutral place is


def begun_towers(env: Any, seed: int, variation: Mapping[str, Any]) -> Observations:
    """Begin an episode of PandaStack, in half of the cases with a tower of one to five other blocks.

    Taller ones come more often (the height is the larger of two that are drawn): what a program gets wrong over them
    hardly shows over others.
    The hand is then at its neutral place or, in half of these cases and over towers of five, where it has just put the
    last block down. There are never more blocks than the environment can have.

    :param env: the environment
    :param seed: of the episode
    :param variation: with ``n_objects``, those that are still to be stacked
    :raises ValueError: if it is another environment
    """
    if not hasattr(env.unwrapped, "begin_tower"):
        raise ValueError("augment='begun_towers' is not accepted: only PandaStack has towers")
    rng = np.random.default_rng((seed, 1))
    n_objects = variation.get("n_objects", 1)
    most = max(min(_MOST_BEGUN, env.unwrapped.variations["n_objects"].high - n_objects), 0)
    n_done = 0 if rng.random() < 0.5 else int(rng.integers(min(most, 1), most + 1, size=2).max())
    above = n_done > 0 and (n_done > _MOST_BELOW or rng.random() < 0.5)
    options = {**variation, "n_objects": n_objects + n_done, "n_done": n_done if above else 0}
    observation = env.reset(seed=seed, options=options)[0]
    return np.asarray(observation if above else env.unwrapped.begin_tower(n_done))


#: Names of the ready ones.
STARTS: dict[str, Begin] = {"begun_towers": begun_towers}


def make_starts(given: str | Augment | None) -> Begin | None:
    """Return what begins episodes in another way, if the augmentation of that name is one.

    :param given: what :func:`~sb3_progpolicy.imitate` is given
    """
    return STARTS.get(given) if isinstance(given, str) else None


def make_augmentation(given: str | Augment | None, names: Sequence[str]) -> Augment | None:
    """Return an augmentation of visited states, ``None`` for none.

    :param given: a name, a function, or ``None`` for none
    :param names: of the numbers of an observation
    :raises ValueError: if the name is not known or does not fit the observation
    """
    if not isinstance(given, str):
        return given
    if given in STARTS:
        return None
    if given not in AUGMENTATIONS:
        raise unknown("augmentation", given, [*AUGMENTATIONS, *STARTS])
    return AUGMENTATIONS[given](names)
