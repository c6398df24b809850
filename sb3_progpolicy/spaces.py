"""Action and observation spaces as numbers: how an action is described, and how the input X of section 2.4 is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

ActionKind = Literal["discrete", "box", "multi_discrete", "multi_binary"]


@dataclass(frozen=True)
class ActionSpec:
    """The action space that a program acts in.

    :param kind: which Gymnasium space
    :param sizes: ``(n,)`` for Discrete, the ``nvec`` of a MultiDiscrete, ``(n,)`` for MultiBinary, the flat size of a
        Box; a controller has ``sum(sizes)`` outputs
    :param low: lower bounds of a Box, one per number; empty otherwise
    :param high: upper bounds of a Box; empty otherwise
    :param start: first action of a Discrete space
    """

    kind: ActionKind
    sizes: tuple[int, ...]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    start: int = 0

    @property
    def n_outputs(self) -> int:
        """Number of outputs of every controller."""
        return sum(self.sizes)

    @property
    def history_size(self) -> int:
        """Width of the previous action in X: one-hot for discrete spaces, the numbers themselves otherwise."""
        return sum(self.sizes)

    @property
    def interaction_size(self) -> int:
        """Width of what X holds after the observation: previous action, previous reward, previous done flag."""
        return self.history_size + 2


def action_spec(space: spaces.Space[Any]) -> ActionSpec:
    """Describe an action space as plain data.

    :param space: Discrete, Box, MultiDiscrete or MultiBinary
    :raises ValueError: for any other space
    """
    if isinstance(space, spaces.Discrete):
        return ActionSpec("discrete", (int(space.n),), start=int(space.start))
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1 and not space.start.any():
        return ActionSpec("multi_discrete", tuple(int(n) for n in space.nvec))
    if isinstance(space, spaces.MultiBinary) and isinstance(space.n, (int, np.integer)):
        return ActionSpec("multi_binary", (int(space.n),))
    if isinstance(space, spaces.Box):
        low, high = (tuple(bound.astype(float).ravel().tolist()) for bound in (space.low, space.high))
        return ActionSpec("box", (len(low),), low=low, high=high)
    raise ValueError(
        f"action space {space} is not accepted; programs act in Discrete, Box and one-dimensional MultiDiscrete "
        "(starting at 0) and MultiBinary spaces"
    )


def check_observation_space(space: spaces.Space[Any]) -> spaces.Box:
    """Return an observation space that a program can read.

    :param space: a one-dimensional Box
    :raises ValueError: for any other space; ``gymnasium.wrappers.FlattenObservation`` makes it fit
    """
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"observation space {space} is not accepted; programs read one-dimensional Box observations. "
            "Wrap the environment in gymnasium.wrappers.FlattenObservation"
        )
    return space


def interaction_space(observation_space: spaces.Space[Any], spec: ActionSpec) -> spaces.Box:
    """Return the space of X = [observation, previous action, previous reward, previous done].

    :param observation_space: a one-dimensional Box
    :param spec: the action space
    :raises ValueError: for any other observation space
    """
    observation_space = check_observation_space(observation_space)
    low, high = _history_bounds(spec)
    return spaces.Box(
        np.concatenate((observation_space.low, low)).astype(np.float32),
        np.concatenate((observation_space.high, high)).astype(np.float32),
        dtype=np.float32,
    )


def ends_with_history(space: spaces.Space[Any], spec: ActionSpec) -> bool:
    """Return whether the last numbers of an observation space have the bounds of the interaction history.

    :param space: any
    :param spec: the action space
    """
    size = spec.interaction_size
    if not isinstance(space, spaces.Box) or len(space.shape) != 1 or space.shape[0] < size:
        return False
    low, high = _history_bounds(spec)
    return np.array_equal(space.low[-size:], low) and np.array_equal(space.high[-size:], high)


def _history_bounds(spec: ActionSpec) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    if spec.kind == "box":
        low, high = (np.asarray(bound, dtype=np.float32) for bound in (spec.low, spec.high))
    else:
        low, high = np.zeros(spec.history_size, np.float32), np.ones(spec.history_size, np.float32)
    unbounded = np.finfo(np.float32).max
    # Before the first action all its numbers are zero, whatever the bounds.
    return (
        np.concatenate((np.minimum(low, 0), [-unbounded, 0])).astype(np.float32),
        np.concatenate((np.maximum(high, 0), [unbounded, 1])).astype(np.float32),
    )


def shaped(actions: NDArray[Any], space: spaces.Space[Any] | None) -> NDArray[Any]:
    """Return flat actions in the shape that a space has, ``(n_envs, *space.shape)``.

    :param actions: ``(n_envs, n_numbers)`` if Box, else as the space has them
    :param space: the action space
    """
    return actions.reshape(len(actions), *space.shape) if isinstance(space, spaces.Box) else actions


def encode_actions(actions: NDArray[Any], spec: ActionSpec) -> NDArray[np.float32]:
    """Encode actions for X: one-hot for Discrete and MultiDiscrete, the numbers themselves otherwise.

    :param actions: ``(n_envs, *action_shape)``, each in the action space
    :param spec: the action space
    :return: ``(n_envs, spec.history_size)``
    :raises ValueError: if an action of a space that does not start at 0 is not in it
    """
    n_envs = len(actions)
    if spec.kind in ("box", "multi_binary"):
        return actions.reshape(n_envs, -1).astype(np.float32)
    encoded = np.zeros((n_envs, spec.history_size), dtype=np.float32)
    columns = actions.reshape(n_envs, -1) - spec.start
    if spec.start and not ((columns >= 0) & (columns < spec.sizes[0])).all():
        raise ValueError(
            f"actions {actions.ravel().tolist()} are not accepted; they are from {spec.start} to "
            f"{spec.start + spec.sizes[0] - 1}, and Stable-Baselines3's algorithms choose from 0 on"
        )
    if len(spec.sizes) > 1:
        columns = columns + np.concatenate(([0], np.cumsum(spec.sizes)[:-1]))
    encoded[np.arange(n_envs)[:, None], columns] = 1
    return encoded
