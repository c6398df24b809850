"""Recurrent conditions that are switches: whole numbers that say when they turn on and when they turn off."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.symmetry import Grid, Symmetry
from sb3_progpolicy.analysis.integer import MAX_WEIGHT, Solution, fewest_terms
from sb3_progpolicy.analysis.terms import Floats, terms_of
from sb3_progpolicy.evaluation import evaluate_program
from sb3_progpolicy.programs.interpreter import ProgramRunner
from sb3_progpolicy.programs.syntax import Condition, Expression, IfThenElse, ProgramData

#: Of the readout of a switch: B is above 0 while it is on, and below 0 while it is off.
_READOUT, _READOUT_BIAS = (1.0,), -0.5


@dataclass(frozen=True)
class Switched:
    """A program whose conditions with a memory are switches where they can be.

    :param program: with the same decisions in the episodes that were looked at
    :param terms: numbers of the rules of each switch that was found, by the index of its condition
    :param bounds: no switch that does the same has fewer, by the index of its condition
    :param traces: X of these episodes, ``(n_steps, n_envs, n_inputs)`` for each variation; its memory is kept
        throughout
    """

    program: ProgramData
    terms: Mapping[int, int] = field(default_factory=dict)
    bounds: Mapping[int, int] = field(default_factory=dict)
    traces: Sequence[Floats] = ()


def replace_switches(
    program: ProgramData,
    env_id: str,
    variations: Sequence[Mapping[str, Any]],
    symmetries: Sequence[Symmetry] = (),
    grids: Sequence[Grid] = (),
    *,
    episodes: int = 20,
    time_limit: float = 60.0,
    max_weight: int = MAX_WEIGHT,
    seed: int = 0,
) -> Switched:
    """Replace each recurrent condition of one unit by a switch, if whole episodes agree in every step.

    The condition's own decisions are the constraints. Where it turns on, the rule *on* has to hold, and it must not
    where it is off; where it turns off, the rule *off* has to hold, and it must not where the condition stays on
    without *on*. Each has the fewest whole numbers (a mixed-integer linear program), first *on* and then *off*.

    :param program: crisp
    :param env_id: environment id
    :param variations: of it
    :param symmetries: under which the rules are to stay the same, if there are such rules
    :param grids: blocks of inputs that count as functions of row and column
    :param episodes: on each variation
    :param time_limit: seconds for each rule
    :param max_weight: largest size of a number
    :param seed: of the environments
    """
    if not any(condition.remembers for condition in program.conditions):
        return Switched(program)
    traces = [_trace(program, env_id, variation, episodes, seed + k) for k, variation in enumerate(variations)]
    values = [_condition_values(program, trace) for trace in traces]
    terms: dict[int, int] = {}
    bounds: dict[int, int] = {}
    conditions = list(program.conditions)
    for index, condition in enumerate(conditions):
        if not condition.remembers:
            continue
        decisions = [value[..., index] >= 0 for value in values]
        found = None
        if condition.hidden_size == 1:
            for tied in [symmetries, ()] if symmetries else [()]:
                rules = _Rules(program, tied, grids, time_limit, max_weight)
                found = rules.find(traces, decisions)
                if found is not None:
                    break
        if found is not None:
            conditions[index], terms[index], bounds[index] = found
    switched = _with_conditions(program, conditions)
    return Switched(switched, terms, bounds, traces)


def disagreements(one: ProgramData, other: ProgramData, traces: Sequence[Floats]) -> int:
    """Return in how many steps of episodes two programs act differently, each with its own memory.

    :param one: crisp
    :param other: with the same inputs and actions
    :param traces: X of these episodes, ``(n_steps, n_envs, n_inputs)`` each
    """
    different = 0
    for trace in traces:
        runners = [ProgramRunner(program, trace.shape[1]) for program in (one, other)]
        for inputs in trace:
            actions = [runner.act(inputs).reshape(len(inputs), -1) for runner in runners]
            different += int((actions[0] != actions[1]).any(axis=1).sum())
    return different


def _trace(program: ProgramData, env_id: str, variation: Mapping[str, Any], episodes: int, seed: int) -> Floats:
    seen: list[Floats] = []
    evaluate_program(
        program, env_id, [variation], episodes, seed=seed, watch=lambda inputs, branch: seen.append(np.array(inputs))
    )
    return np.stack(seen)


def _condition_values(program: ProgramData, trace: Floats) -> Floats:
    """Return B of all conditions at every step, ``(n_steps, n_envs, n_conditions)``."""
    runner, values = ProgramRunner(program, trace.shape[1]), []
    for inputs in trace:
        runner.act(inputs)
        values.append(runner.condition_values.copy())
    return np.array(values)


class _Rules:
    """Finds the two rules of a switch.

    :param program: whose inputs they read
    :param symmetries: under which they stay the same
    :param grids: blocks of inputs that count as functions of row and column
    :param time_limit: seconds for each
    :param max_weight: largest size of a number
    """

    def __init__(
        self,
        program: ProgramData,
        symmetries: Sequence[Symmetry],
        grids: Sequence[Grid],
        time_limit: float,
        max_weight: int,
    ) -> None:
        self.program, self.time_limit, self.max_weight = program, time_limit, max_weight
        self.patterns = [
            np.stack([term.weights[0] for term in terms_of(program, 1, symmetries, kept)])
            for kept in ([grids, ()] if grids else [()])
        ]

    def find(
        self, traces: Sequence[Floats], decisions: Sequence[NDArray[np.bool_]]
    ) -> tuple[Condition, int, int] | None:
        """Return the switch with these decisions, how many terms it has, and how few one must have.

        :param traces: X, ``(n_steps, n_envs, n_inputs)`` each
        :param decisions: whether the condition holds, ``(n_steps, n_envs)`` each
        """
        before = [np.vstack([np.zeros((1, now.shape[1]), dtype=bool), now[:-1]]) for now in decisions]
        x = np.concatenate([trace.reshape(-1, trace.shape[-1]) for trace in traces])
        x = np.column_stack([x, np.ones(len(x))])
        is_on, was_on = (np.concatenate([values.ravel() for values in arrays]) for arrays in (decisions, before))
        if not is_on.any():
            return None
        on = self._rule(x[is_on & ~was_on], x[~is_on])
        if on is None:
            return None
        stays = is_on & was_on & (x @ on[0] < 0)
        off = self._rule(x[~is_on & was_on], x[stays])
        if off is None:
            return None
        switch = _switch(on[0], off[0])
        single = dataclasses.replace(
            self.program, body=_with_conditions(self.program, [switch] * len(self.program.conditions)).body
        )
        same = all(
            np.array_equal(_condition_values(single, trace)[..., 0] >= 0, now)
            for trace, now in zip(traces, decisions, strict=True)
        )
        # Any switch that does the same has an `on` that holds and fails in these places, and some `off`.
        return (switch, on[1].n_terms + off[1].n_terms, on[1].lower_bound + 1) if same else None

    def _rule(self, holds: Floats, fails: Floats) -> tuple[Floats, Solution] | None:
        """Return the weights of a sum that is above 0 in some places and below 0 in others."""
        if not len(holds):
            never = np.zeros(self.patterns[0].shape[1])
            never[-1] = -1.0
            return never, Solution(np.array([-1.0]), 1)
        holds, fails = np.unique(holds, axis=0), np.unique(fails, axis=0)
        if set(map(bytes, holds)) & set(map(bytes, fails)):
            return None  # the same input, and another decision
        for patterns in self.patterns:
            rows = np.vstack([holds @ patterns.T, -fails @ patterns.T])
            solution = fewest_terms(rows, self.time_limit, max_weight=self.max_weight)
            if solution is not None:
                return solution.weights @ patterns + 0.0, solution
        return None


def _switch(on: Floats, off: Floats) -> Condition:
    return Condition(
        cell="switch",
        weight_ih=(tuple(on[:-1].tolist()), tuple(off[:-1].tolist())),
        weight_hh=((0.0,), (0.0,)),
        bias_ih=(float(on[-1]), float(off[-1])),
        bias_hh=(0.0, 0.0),
        readout=_READOUT,
        readout_bias=_READOUT_BIAS,
    )


def _with_conditions(program: ProgramData, conditions: Sequence[Condition]) -> ProgramData:
    body: Expression = program.controllers[-1]
    for condition, controller in reversed(list(zip(conditions, program.controllers[:-1], strict=True))):
        body = IfThenElse(condition, controller, body)
    return dataclasses.replace(program, body=body)
