"""Episodes of a program as plain data for its page."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from progpolicy_envs import Domain
from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.spaces import action_spec

#: The planning environments that a page can step by itself, see ``js/worlds.js``.
WORLDS = ("Hanoi-v0", "Stacking-v0", "Hiking-v1", "Hiking-v0", "HikingEgo-v0")
#: Bytes of recorded observations that a page holds at most; what comes after is left out.
MAX_BYTES = 600_000


def fits(program: ProgramData, env: gym.Env[Any, Any]) -> bool:
    """Return whether a program reads what an environment shows and acts in its action space.

    :param program: the program
    :param env: the environment
    """
    shape = env.observation_space.shape
    if shape is None or len(shape) != 1 or shape[0] != program.n_observations:
        return False
    try:
        return action_spec(env.action_space) == program.action
    except ValueError:
        return False


def record_episodes(
    program: ProgramData, env: gym.Env[Any, Any], domain: Domain, in_page: bool, seed: int = 0
) -> list[dict[str, Any]]:
    """Play one episode with crisp semantics on each variation of a domain, from zero memory.

    :param program: the program
    :param env: a single environment of the domain
    :param domain: whose training, validation and unseen variations are played, in this order
    :param in_page: whether the page can step the environment, so that a start and the actions are enough
    :param seed: of every episode
    :return: one mapping for each episode
    """
    episodes: list[dict[str, Any]] = []
    size = 0
    for kind, variation in _variations(domain):
        episode = _record(program, env, variation, in_page, seed)
        size += sum(len(value) for value in episode.values() if isinstance(value, str))
        if size > MAX_BYTES and episodes:
            break
        episodes.append({"kind": kind, "variation": dict(variation), "seed": seed, **episode})
    return episodes


def _variations(domain: Domain) -> Iterator[tuple[str, Mapping[str, Any]]]:
    sets = {"trained": domain.trained, "validation": domain.validation, "unseen": domain.unseen}
    for kind, variations in sets.items():
        for variation in variations:
            yield kind, variation


def _record(
    program: ProgramData, env: gym.Env[Any, Any], variation: Mapping[str, Any], in_page: bool, seed: int
) -> dict[str, Any]:
    observation, info = env.reset(seed=seed, options=dict(variation))
    start = _start(env) if in_page else None
    scene = _Scene(env) if hasattr(env.unwrapped, "task") else None
    runner, optimal = ProgramRunner(program), info.get("optimal_steps")
    action, reward, done = None, np.float32(0), False
    observations, actions, rewards = [], [], []
    while not done:
        if scene is not None:
            scene.add()
        observations.append(observation)
        # Rewards of 32 bits, as the vectorised environments of training give them.
        action = runner.act(join_inputs(program, observation, action, reward, done))
        observation, earned, terminated, truncated, info = env.step(action[0])
        reward, done = np.float32(earned), terminated or truncated
        actions.append(action[0])
        rewards.append(reward)
    episode: dict[str, Any] = {
        "success": bool(info.get("is_success", False)),
        "steps": len(actions),
        "optimal": None if optimal is None else int(optimal),
    }
    if in_page:
        return {**episode, "start": start, "actions": np.array(actions).tolist()}
    recorded = {"observations": observations, "actions": actions, "rewards": rewards}
    if scene is not None:
        scene.add()
        episode["scene"] = scene.content()
    return {**episode, **{name: pack_numbers(numbers) for name, numbers in recorded.items()}}


def _start(env: gym.Env[Any, Any]) -> dict[str, Any]:
    """The state of a planning environment; a map as its rows."""
    bare: Any = env.unwrapped
    state: dict[str, Any] = bare.state
    return {**state, "layout": "\n".join(bare.layout.rows)} if "layout" in state else state


class _Scene:
    """Where things are in a Panda episode, frame by frame.

    :param env: a Panda environment that has just been reset
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        bare: Any = env.unwrapped
        self._env = bare
        task = bare.task
        self._targets = [list(target) for target in task.targets]
        self._has_objects = task.kind is not None
        self._table = {"low": task.table.low_x, "high": task.table.high_x, "width": task.table.width}
        self._positions: list[Any] = []
        self._grippers: list[Any] = []
        self._finished: list[str] = []

    def add(self) -> None:
        """Add the present state."""
        task, robot = self._env.task, self._env.scene.robot
        self._positions.append(task.positions if self._has_objects else [])
        self._grippers.append([*robot.position, robot.width])
        self._finished.append("".join(str(int(done)) for done in task.finished))

    def content(self) -> dict[str, Any]:
        """Return all frames."""
        return {
            "targets": self._targets,
            "table": self._table,
            "objects": pack_numbers(self._positions) if self._has_objects else None,
            "grippers": pack_numbers(self._grippers),
            "finished": self._finished,
        }


def pack_numbers(numbers: ArrayLike) -> str:
    """Return numbers as base64 of little-endian floats of 32 bits, which a page reads exactly.

    :param numbers: of any shape
    """
    return base64.b64encode(np.asarray(numbers, dtype="<f4").tobytes()).decode("ascii")
