"""A program run from chosen starts of a planning domain, each episode once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.vector import PlanningVectorEnv
from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.surroundings import check_fit, surroundings


@dataclass(frozen=True)
class Step:
    """What a program is about to do in a batch of environments.

    :param inputs: X, ``(num_envs, n_inputs)``
    :param actions: ``(num_envs,)``
    :param branches: index of the controller that has chosen, ``(num_envs,)``
    :param active: which episodes have not ended, ``(num_envs,)``
    :param venv: the environments
    """

    inputs: NDArray[np.float64]
    actions: NDArray[np.int64]
    branches: NDArray[np.int64]
    active: NDArray[np.bool_]
    venv: PlanningVectorEnv


Visit = Callable[[Step], None]


def make_batch(program: ProgramData, env_id: str, n_envs: int) -> PlanningVectorEnv:
    """Make environments of a planning domain that a program fits.

    :param program: what will act in them
    :param env_id: id of a planning domain
    :param n_envs: how many
    :raises ValueError: if the domain has no batch whose starts can be chosen, or the program does not fit
    """
    name = env_id.rpartition(":")[2]
    spec = gym.spec(name)
    venv: Any = None
    if spec.vector_entry_point is not None:
        kwargs = surroundings(program, env_id).kwargs
        venv = gym.make_vec(name, num_envs=n_envs, vectorization_mode="vector_entry_point", **kwargs).unwrapped
    if not isinstance(venv, PlanningVectorEnv):
        raise ValueError(f"{env_id} is not accepted; the planning domains have starts that can be chosen")
    check_fit(program, env_id, venv.single_observation_space, venv.single_action_space)
    return venv


def run_episodes(
    program: ProgramData,
    venv: PlanningVectorEnv,
    observations: NDArray[Any],
    optimal: NDArray[np.int64],
    cap: int,
    visit: Visit | None = None,
) -> NDArray[np.int64]:
    """Run one episode in each environment from the state that it is in, the program's memory being empty.

    :param program: crisp
    :param venv: environments that have just been put into a start
    :param observations: of these starts
    :param optimal: steps of the planner from there, ``(num_envs,)``
    :param cap: steps after which an episode has failed
    :param visit: is called before each step
    :return: steps to the goal, ``(num_envs,)``; -1 where it was not reached
    """
    runner = ProgramRunner(program, venv.num_envs)
    steps = np.where(optimal == 0, 0, -1)
    active = steps < 0
    previous: NDArray[Any] | None = None
    rewards = np.zeros(venv.num_envs)
    none_ended = np.zeros(venv.num_envs, dtype=bool)
    for step in range(1, cap + 1):
        if not active.any():
            break
        # The done flag is 0 within an episode; environments that have reached the goal go on unseen.
        inputs = join_inputs(program, observations, previous, rewards, none_ended)
        previous = runner.act(inputs)
        if visit is not None:
            visit(Step(inputs, previous, runner.branch, active, venv))
        observations, rewards, solved = venv.advance(previous)
        steps[active & solved] = step
        active &= ~solved
    return steps


def start_numbers(count: int, limit: int | None, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the numbers of all starts, or of some drawn without repetition.

    :param count: how many there are
    :param limit: how many to take at most; ``None`` for all
    :param rng: source of the draw
    """
    if limit is None or count <= limit:
        return np.arange(count)
    return np.sort(rng.choice(count, limit, replace=False)) if count < 10**7 else rng.integers(count, size=limit)


def batches(numbers: NDArray[np.int64], size: int) -> Sequence[NDArray[np.int64]]:
    """Split numbers into batches of at most a size."""
    return np.split(numbers, range(size, len(numbers), size))
