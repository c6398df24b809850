"""Short names for the parts of a program, so that a hand-written one reads like the program it is."""

from collections.abc import Mapping, Sequence
from typing import Any

from gymnasium import spaces

from sb3_progpolicy.programs.syntax import ActionSpec, Condition, Controller, Expression, IfThenElse, Program

Weights = Mapping[str, float]


def input_names(env: Any) -> tuple[str, ...]:
    """Return the names of X: observation, previous action (one-hot, or its numbers), previous reward and done flag."""
    previous = tuple(f"previous {name}" for name in env.unwrapped.action_names)
    return (*env.unwrapped.observation_names, *previous, "previous reward", "previous done")


class Builder:
    """Parts of a program for one environment, with weights given by the names of inputs and outputs.

    :param env: an environment with ``observation_names`` and ``action_names``
    """

    def __init__(self, env: Any) -> None:
        self.inputs = input_names(env)
        self.outputs: tuple[str, ...] = tuple(env.unwrapped.action_names)
        self.n_observations = len(env.unwrapped.observation_names)
        self.space = env.action_space

    def controller(self, scores: Mapping[str, Weights] | None = None, bias: Weights | None = None) -> Controller:
        """Return the controller ``c + T·X``.

        :param scores: for an output, its weights by input name; what is not named is 0
        :param bias: for an output, its constant
        """
        rows = [self._row((scores or {}).get(output, {}), self.inputs) for output in self.outputs]
        return Controller(tuple(rows), self._row(bias or {}, self.outputs))

    def always(self, output: str) -> Controller:
        """Return the constant controller that prefers one discrete action."""
        return self.controller(bias={output: 1.0})

    def affine(self, weights: Weights, bias: float = 0.0) -> Condition:
        """Return the condition ``bias + weights·X >= 0``."""
        return Condition("affine", (), (), (), (), self._row(weights, self.inputs), bias)

    def chain(self, branches: Sequence[tuple[Condition, Controller]], last: Controller) -> Expression:
        """Return ``if B1 then C1 else if B2 then C2 ... else last``."""
        body: Expression = last
        for condition, then in reversed(branches):
            body = IfThenElse(condition, then, body)
        return body

    def program(self, body: Expression, **metadata: Any) -> Program:
        """Return the program that runs ``body`` on X with the interaction history."""
        if isinstance(self.space, spaces.Discrete):
            action = ActionSpec("discrete", (int(self.space.n),))
        else:
            low, high = (tuple(map(float, bound.ravel())) for bound in (self.space.low, self.space.high))
            action = ActionSpec("box", (len(low),), low, high)
        return Program(body, self.n_observations, action, True, self.inputs, self.outputs, metadata=metadata)

    @staticmethod
    def _row(weights: Weights, names: Sequence[str]) -> tuple[float, ...]:
        unknown = sorted(set(weights) - set(names))
        if unknown:
            raise ValueError(f"no such names: {unknown}; known: {list(names)}")
        return tuple(float(weights.get(name, 0.0)) for name in names)
