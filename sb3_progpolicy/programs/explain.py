"""Why a program acts as it does: every number of one step, down to what each term adds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs
from sb3_progpolicy.programs.syntax import ProgramData


@dataclass(frozen=True)
class ExplainedOutput:
    """One output of the active controller as the sum that it is.

    :param name: of the output
    :param value: ``constant`` plus all ``contributions``, added from left to right
    :param constant: the controller's bias
    :param contributions: weight times input, one for each number of X, in the order of X
    """

    name: str
    value: float
    constant: float
    contributions: tuple[float, ...]


@dataclass(frozen=True)
class Explanation:
    """One step of a program.

    :param inputs: (name, value) of each number of X
    :param condition_values: the B of each condition, the outermost first
    :param memory: the hidden units of each condition after the step; none for one without memory
    :param branch: index of the active controller, the first whose B is not below 0
    :param mixture_weights: weight of each controller with soft semantics; ``None`` with crisp
    :param outputs: of every controller, the active one or not
    :param active: the outputs of the active controller with what each term adds
    :param action: what was chosen: a whole number for Discrete, an array otherwise
    """

    inputs: tuple[tuple[str, float], ...]
    condition_values: tuple[float, ...]
    memory: tuple[tuple[float, ...], ...]
    branch: int
    mixture_weights: tuple[float, ...] | None
    outputs: tuple[tuple[float, ...], ...]
    active: tuple[ExplainedOutput, ...]
    action: Any


def explain(
    program: ProgramData,
    observation: ArrayLike,
    previous_action: ArrayLike | None = None,
    previous_reward: float = 0.0,
    previous_done: bool = False,
    runner: ProgramRunner | None = None,
) -> Explanation:
    """Take one step and return all that led to its action.

    .. code-block:: python

        runner = ProgramRunner(program)
        step = explain(program, observation, runner=runner)
        step = explain(program, next_observation, step.action, reward, done, runner)  # remembers the first

    :param program: what to explain
    :param observation: ``(n_observations,)``
    :param previous_action: the action before, ``None`` before the first
    :param previous_reward: the reward that it brought
    :param previous_done: whether it ended an episode
    :param runner: of this program for one environment, whose memory the step reads and advances; by default a new one,
        whose memory is zero
    :raises ValueError: if a shape does not fit, or the runner runs another program or several environments
    """
    runner = runner or ProgramRunner(program)
    if runner.program != program or runner.n_envs != 1:
        raise ValueError(
            f"runner runs {runner.n_envs} environments and {'this' if runner.program == program else 'another'} "
            "program; a ProgramRunner of this program for one environment is accepted"
        )
    previous = None if previous_action is None else np.asarray(previous_action)[None]
    inputs = join_inputs(program, observation, previous, previous_reward, previous_done)
    action = runner.act(inputs)[0]
    branch, outputs = int(runner.branch[0]), runner.outputs[0].tolist()
    controller = program.controllers[branch]
    x: list[float] = inputs[0].tolist()
    return Explanation(
        inputs=tuple(zip(program.input_names, x, strict=True)),
        condition_values=tuple(runner.condition_values[0].tolist()),
        memory=tuple(tuple(units[0].tolist()) for units in runner.memory),
        branch=branch,
        mixture_weights=tuple(runner.mixture_weights[0].tolist()) if runner.semantics == "soft" else None,
        outputs=tuple(map(tuple, outputs)),
        active=tuple(
            ExplainedOutput(name, value, float(bias), tuple(w * number for w, number in zip(weights, x, strict=True)))
            for name, value, bias, weights in zip(
                program.output_names, outputs[branch], controller.bias, controller.weights, strict=True
            )
        ),
        action=int(action) if program.action.kind == "discrete" else action,
    )
