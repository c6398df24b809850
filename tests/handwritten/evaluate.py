"""Run a program crisply on an environment: the few lines of NumPy that the grammar's semantics amounts to."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.programs.syntax import Controller, IfThenElse, Program


class CrispPolicy:
    """A discrete program whose conditions are all affine, run as a real if-then-else with interaction history.

    :param program: the program; it has no recurrent conditions
    """

    def __init__(self, program: Program) -> None:
        if any(condition.cell != "affine" for condition in program.conditions):
            raise ValueError("only affine conditions are run here")
        self.program = program
        self._conditions = [(np.array(c.readout), c.readout_bias) for c in program.conditions]
        self._controllers = [(np.array(c.weights), np.array(c.bias)) for c in program.controllers]
        self.reset()

    def reset(self) -> None:
        """Forget the history, as at a task switch."""
        self.reward, self.done = 0.0, False
        self._previous = np.zeros(self.program.action.history_size)

    def act(self, observation: NDArray[np.float32]) -> int:
        """Return the action of the branch whose condition holds first."""
        x = np.concatenate([observation, self._previous, [self.reward, float(self.done)]])
        branch = next((k for k, (weights, bias) in enumerate(self._conditions) if weights @ x + bias >= 0), -1)
        weights, bias = self._controllers[branch]
        action = int(np.argmax(weights @ x + bias))
        self._previous = np.eye(self.program.action.n_outputs)[action]
        return action


@dataclass(frozen=True)
class Episode:
    """How one episode went."""

    success: bool
    steps: int
    optimal: int


def play(program: Program | CrispPolicy, env: gym.Env[Any, Any], seed: int | None = None, **options: Any) -> Episode:
    """Run one episode: a program from a fresh history, a policy with the history it has.

    :param options: variation, as for ``reset(options=...)``
    """
    policy = program if isinstance(program, CrispPolicy) else CrispPolicy(program)
    observation, info = env.reset(seed=seed, options=options)
    optimal, ended, steps = info["optimal_steps"], False, 0
    while not ended:
        observation, reward, terminated, truncated, info = env.step(policy.act(observation))
        ended, steps = terminated or truncated, steps + 1
        policy.reward, policy.done = float(reward), ended
    return Episode(info["is_success"], steps, optimal)


def size_of(program: Program) -> tuple[int, int]:
    """Return the numbers of conditions and of controllers."""
    expression, conditions = program.body, 0
    while isinstance(expression, IfThenElse):
        expression, conditions = expression.orelse, conditions + 1
    assert isinstance(expression, Controller)
    return conditions, conditions + 1
