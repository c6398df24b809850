"""Whether variations differ: training on tasks that are all the same must not go on in silence."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from sb3_progpolicy.reptile.tasks import TaskDistribution

#: Random actions after which variations that looked alike so far are called equal.
MAX_STEPS = 64
_SEED = 0


def check_variations(tasks: TaskDistribution, env: VecEnv | None) -> None:
    """Raise an error if two variations have the same starts and the same dynamics, as far as random actions show.

    Each is put in force in all environments, which are reset with the same seeds and, where their first observations
    and infos do not tell them apart, make the same random actions. A parameter that is ignored is found so. Training
    resets the environments after it. ``TaskDistribution(..., check=False)`` leaves it out, for a parameter that acts
    later than this can see.

    :param tasks: the distribution
    :param env: the training environments; wrappers are passed by, so that no statistics are touched
    :raises ValueError: naming two variations that do not differ
    """
    if env is None or not tasks.check or len(tasks) < 2:
        return
    bare, rng = env.unwrapped, np.random.default_rng(_SEED)
    try:
        _compare(tasks, bare, rng)
    finally:
        state = np.random.get_state()  # noqa: NPY002 - SB3 draws from it
        bare.seed(None)  # not the same starts in every training
        np.random.set_state(state)  # noqa: NPY002


def _compare(tasks: TaskDistribution, bare: VecEnv, rng: np.random.Generator) -> None:
    drawn = [
        {name: value(rng) if callable(value) else value for name, value in variation.items()}
        for variation in tasks.variations
    ]
    groups = _grouped([_play(tasks, bare, variation, 0) for variation in drawn], list(range(len(drawn))))
    n_steps = 4
    while groups and n_steps <= MAX_STEPS:
        still = [
            group
            for alike in groups
            for group in _grouped([_play(tasks, bare, drawn[index], n_steps) for index in alike], alike)
        ]
        groups, n_steps = still, 4 * n_steps
    if groups:
        one, other = groups[0][:2]
        raise ValueError(
            f"the variations {tasks.label(one)} and {tasks.label(other)} do not differ: with the same seeds they start "
            f"alike and go on alike under {MAX_STEPS} random actions. The environment may ignore a parameter; if it "
            "acts later, give TaskDistribution check=False"
        )


def _grouped(trajectories: list[list[NDArray[Any]]], indices: list[int]) -> list[list[int]]:
    """Return those of the indices whose trajectories are equal, in groups of two or more."""
    groups: list[tuple[list[NDArray[Any]], list[int]]] = []
    for trajectory, index in zip(trajectories, indices, strict=True):
        for known, members in groups:
            if len(known) == len(trajectory) and all(map(_equal, known, trajectory)):
                members.append(index)
                break
        else:
            groups.append((trajectory, [index]))
    return [members for _, members in groups if len(members) > 1]


def _equal(one: NDArray[Any], other: NDArray[Any]) -> bool:
    return one.shape == other.shape and bool(np.array_equal(one, other, equal_nan=one.dtype.kind == "f"))


def _play(tasks: TaskDistribution, env: VecEnv, variation: dict[str, Any], n_steps: int) -> list[NDArray[Any]]:
    """Return first observations and infos, and observations, rewards and dones of some random steps."""
    env.seed(_SEED)
    space = copy.deepcopy(env.action_space)
    space.seed(_SEED)
    seen = _arrays(tasks.reset(env, [variation] * env.num_envs))
    seen.append(np.array([repr(info) for info in env.reset_infos]))
    for _ in range(n_steps):
        actions = np.stack([np.asarray(space.sample()) for _ in range(env.num_envs)])
        observations, rewards, dones, _ = env.step(actions)
        seen += [*_arrays(observations), np.array(rewards), np.array(dones)]
    return seen


def _arrays(observations: Any) -> list[NDArray[Any]]:
    """Return copies of what an environment observes: an array, or a mapping or tuple of arrays."""
    if isinstance(observations, dict):
        return [array for name in sorted(observations) for array in _arrays(observations[name])]
    if isinstance(observations, tuple):
        return [array for part in observations for array in _arrays(part)]
    return [np.array(observations)]
