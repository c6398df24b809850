"""The situations that a program meets, and what may be done in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.vector import PlanningVectorEnv
from sb3_progpolicy.analysis.rollout import Step, batches, make_batch, run_episodes, start_numbers
from sb3_progpolicy.programs.interpreter import ProgramRunner
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.surroundings import surroundings

BATCH = 512


@dataclass(frozen=True)
class Situations:
    """Distinct inputs, and the actions that may be chosen on them.

    :param inputs: X, ``(n, n_inputs)``; rows are equal only where the branch depends on memory
    :param allowed: ``(n, n_actions)``
    :param branches: index of the controller that is reached, ``(n,)``
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
        self.remembers = any(condition.remembers for condition in program.conditions)
        self.found: dict[tuple[bytes, int], NDArray[np.bool_]] = {}
        self.branches: list[int] = []
        self.inputs: list[NDArray[np.float64]] = []

    def __call__(self, step: Step) -> None:
        keys = [self.key(*pair) for pair in zip(step.inputs, step.branches.tolist(), strict=True)]
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
            else:
                self.add(step.inputs[row], int(step.branches[row]), mask)

    def key(self, inputs: NDArray[np.float64], branch: int) -> tuple[bytes, int]:
        """Return what tells situations apart: X and, where it does not follow from X, the branch."""
        return inputs.tobytes(), branch if self.remembers else 0

    def add(self, inputs: NDArray[np.float64], branch: int, allowed: NDArray[np.bool_]) -> None:
        """Add a situation that is not known yet."""
        self.found[self.key(inputs, branch)] = allowed
        self.inputs.append(inputs)
        self.branches.append(branch)

    def add_known(self, known: Situations) -> None:
        """Add situations, to which others are then added."""
        for row, mask, branch in zip(known.inputs, known.allowed, known.branches.tolist(), strict=True):
            self.add(row, branch, mask)

    def situations(self, program: ProgramData, starts: int, exhaustive: bool) -> Situations:
        """Return what was collected, in the order in which it was met."""
        inputs = np.array(self.inputs).reshape(-1, program.n_inputs)
        allowed = np.array(list(self.found.values())).reshape(-1, program.action.n_outputs)
        return Situations(inputs, allowed, np.array(self.branches, dtype=np.int64), starts, exhaustive)


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
        collector.add_known(known)
    rng, around = np.random.default_rng(seed), surroundings(program, env_id)
    assert around.cap is not None, "all planning domains have one"
    starts, exhaustive = 0, True
    for variation in ({**around.variation, **given} for given in variations):
        count = make_batch(program, env_id, 1).count_starts(variation)
        numbers = start_numbers(count, n_starts, rng)
        exhaustive &= len(numbers) == count
        for part in batches(numbers, BATCH):
            venv = make_batch(program, env_id, len(part))
            observations = venv.reset_to(variation, part)
            run_episodes(program, venv, observations, venv.optimal_steps(), around.cap, collector)
        starts += len(numbers)
    return collector.situations(program, starts, exhaustive)


def meet_in(program: ProgramData, traces: Sequence[NDArray[np.float64]], known: Situations) -> Situations:
    """Return situations and those of whole episodes, in which the memory is kept from one to the next.

    :param program: crisp
    :param traces: X of the episodes, ``(n_steps, n_envs, n_inputs)`` each
    :param known: situations
    """
    collector = _Collector(program, planner=False)
    collector.add_known(known)
    for trace in traces:
        runner = ProgramRunner(program, trace.shape[1])
        for inputs in trace:
            actions = runner.act(inputs) - program.action.start
            for row, branch, action in zip(inputs, runner.branch.tolist(), actions.tolist(), strict=True):
                if collector.key(row, branch) not in collector.found:
                    collector.add(row, branch, np.arange(collector.n_actions) == action)
    return collector.situations(program, known.starts, known.exhaustive)
