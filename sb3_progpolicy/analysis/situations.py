"""The situations that a program meets, and what may be done in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.vector import PlanningVectorEnv
from sb3_progpolicy.analysis.rollout import Step, batches, cap_of, make_batch, run_episodes, start_numbers
from sb3_progpolicy.programs.syntax import ProgramData

BATCH = 512


@dataclass(frozen=True)
class Situations:
    """Distinct inputs, and the actions that may be chosen on them.

    :param inputs: X, ``(n, n_inputs)``, no two rows equal
    :param allowed: ``(n, n_actions)``
    :param branches: index of the controller that is reached, ``(n,)``; -1 where it depends on memory
    :param starts: from how many starts they come
    :param exhaustive: whether these were all starts
    """

    inputs: NDArray[np.float64]
    allowed: NDArray[np.bool_]
    branches: NDArray[np.int64]
    starts: int
    exhaustive: bool


class _Collector:
    """Keeps each input once, with the actions that may be chosen on it.

    :param program: what is run
    :param planner: whether all actions that the planner calls as good may be chosen, or the program's own alone
    """

    def __init__(self, program: ProgramData, planner: bool) -> None:
        self.planner, self.n_actions = planner, program.action.n_outputs
        self.found: dict[bytes, NDArray[np.bool_]] = {}
        self.branches: dict[bytes, int] = {}
        self.inputs: list[NDArray[np.float64]] = []

    def __call__(self, step: Step) -> None:
        keys = [row.tobytes() for row in step.inputs]
        rows = [row for row in np.flatnonzero(step.active).tolist() if self.planner or keys[row] not in self.found]
        if not rows:
            return
        if self.planner:
            allowed = good_actions([step.venv.state_of(row) for row in rows], step.venv)
        else:
            allowed = np.zeros((len(rows), self.n_actions), dtype=bool)
            allowed[np.arange(len(rows)), step.actions[rows]] = True
        for row, mask in zip(rows, allowed, strict=True):
            key = keys[row]
            if key in self.found:
                self.found[key] = self.found[key] & mask  # two states that look alike
                if self.branches[key] != step.branches[row]:
                    self.branches[key] = -1
            else:
                self.found[key], self.branches[key] = mask, int(step.branches[row])
                self.inputs.append(step.inputs[row])


def good_actions(states: Sequence[Mapping[str, Any]], like: PlanningVectorEnv) -> NDArray[np.bool_]:
    """Return which actions begin a shortest solution.

    :param states: of the environment
    :param like: environments of the same kind
    :return: ``(n_states, n_actions)``
    """
    n_actions = int(like.single_action_space.n)  # type: ignore[attr-defined]
    venv = type(like)(len(states) * n_actions)  # type: ignore[call-arg]
    options = {name: [state[name] for state in states for _ in range(n_actions)] for name in states[0]}
    venv.reset(options=options)
    before = venv.optimal_steps()
    _, _, solved = venv.advance(np.tile(np.arange(n_actions), len(states)))
    after = np.where(solved, 0, venv.optimal_steps())
    return (after == before - 1).reshape(len(states), n_actions)


def meet(
    program: ProgramData,
    env_id: str,
    variations: Sequence[Mapping[str, Any]],
    n_starts: int,
    planner: bool = False,
    seed: int = 0,
    known: Situations | None = None,
) -> Situations:
    """Run a program on variations and return the situations that it meets.

    :param program: crisp
    :param env_id: id of a planning domain
    :param variations: of the domain
    :param n_starts: starts of each variation, drawn where it has more
    :param planner: whether all actions that the planner calls as good may be chosen, or the program's own alone
    :param seed: of the draw
    :param known: situations to which these are added
    """
    collector = _Collector(program, planner)
    if known is not None:
        for row, mask, branch in zip(known.inputs, known.allowed, known.branches.tolist(), strict=True):
            collector.found[row.tobytes()], collector.branches[row.tobytes()] = mask, branch
            collector.inputs.append(row)
    rng, cap = np.random.default_rng(seed), cap_of(env_id)
    starts, exhaustive = 0, True
    for variation in variations:
        count = make_batch(program, env_id, 1).count_starts(variation)
        numbers = start_numbers(count, n_starts, rng)
        exhaustive &= len(numbers) == count
        for part in batches(numbers, BATCH):
            venv = make_batch(program, env_id, len(part))
            observations = venv.reset_to(variation, part)
            run_episodes(program, venv, observations, venv.optimal_steps(), cap, collector)
        starts += len(numbers)
    inputs = np.array(collector.inputs).reshape(-1, program.n_inputs)
    keys = [row.tobytes() for row in inputs]
    allowed = np.array([collector.found[key] for key in keys]).reshape(-1, program.action.n_outputs)
    branches = np.array([collector.branches[key] for key in keys], dtype=np.int64)
    return Situations(inputs, allowed, branches, starts, exhaustive)
