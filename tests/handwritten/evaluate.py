"""Run programs crisply on environments, with the history of section 2.4, and count their steps."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.programs import Controller, IfThenElse, Program, ProgramRunner, join_inputs


@dataclass(frozen=True)
class Episode:
    """How one episode went; ``optimal`` is the planner's number of steps, where the environment tells it."""

    success: bool
    steps: int
    optimal: int | None


class Player:
    """A program with its memory and the history that it reads, for environments stepped together.

    :param program: the program
    :param n_envs: number of environments
    """

    def __init__(self, program: Program, n_envs: int = 1) -> None:
        self.runner = ProgramRunner(program, n_envs)
        self.previous: tuple[Any, Any, Any] = (None, 0.0, False)

    def act(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        """Return one action for each environment."""
        return self.runner.act(join_inputs(self.runner.program, observations, *self.previous))

    def remember(self, actions: NDArray[Any], rewards: Any, dones: Any) -> None:
        """Keep what was done and what came of it for the next input."""
        self.previous = (actions, rewards, dones)


def play(program: Program | Player, env: gym.Env[Any, Any], seed: int | None = None, **options: Any) -> Episode:
    """Run one episode: a program from a fresh history, a player with the history it has.

    :param options: variation, as for ``reset(options=...)``
    """
    player = program if isinstance(program, Player) else Player(program)
    observation, info = env.reset(seed=seed, options=options)
    optimal, ended, steps = info.get("optimal_steps"), False, 0
    while not ended:
        actions = player.act(observation)
        observation, reward, terminated, truncated, info = env.step(actions[0])
        ended, steps = terminated or truncated, steps + 1
        player.remember(actions, float(reward), ended)
    return Episode(info["is_success"], steps, optimal)


def play_plan(env: gym.Env[Any, Any], seed: int, **options: Any) -> Episode:
    """Run one episode with the actions of the environment's planner."""
    _, info = env.reset(seed=seed, options=options)
    optimal, steps = info.get("optimal_steps"), 0
    for action in env.unwrapped.plan():  # type: ignore[attr-defined]
        *_, truncated, info = env.step(action)
        steps += 1
        if truncated:
            break
    return Episode(info["is_success"], steps, optimal)


def play_batch(
    program: Program, env_id: str, n_episodes: int, max_episode_steps: int = 500, **arguments: Any
) -> list[Episode]:
    """Run one episode with each of the seeds 0, 1, 2 ... in the batched form, each from a fresh history."""
    env = gym.make_vec(
        env_id,
        num_envs=n_episodes,
        vectorization_mode="vector_entry_point",
        max_episode_steps=max_episode_steps,
        **arguments,
    )
    observations, infos = env.reset(seed=0)
    player, steps, success = Player(program, n_episodes), np.zeros(n_episodes, int), np.zeros(n_episodes, bool)
    for step in range(1, max_episode_steps + 1):
        actions = player.act(observations)
        observations, rewards, terminated, truncated, _ = env.step(actions)
        player.remember(actions, rewards, terminated | truncated)
        first_end = (terminated | truncated) & (steps == 0)
        steps[first_end], success[first_end] = step, terminated[first_end]
        if steps.all():
            break
    return [
        Episode(bool(s), int(n), int(optimal))
        for s, n, optimal in zip(success, steps, infos["optimal_steps"], strict=True)
    ]


def size_of(program: Program) -> tuple[int, int]:
    """Return the numbers of conditions and of controllers."""
    expression, conditions = program.body, 0
    while isinstance(expression, IfThenElse):
        expression, conditions = expression.orelse, conditions + 1
    assert isinstance(expression, Controller)
    return conditions, conditions + 1
