"""The same decisions with the fewest and roundest numbers."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs import Domain, get_domain
from sb3_progpolicy.analysis.integer import MAX_WEIGHT
from sb3_progpolicy.analysis.prune import Point, Pruned, prune
from sb3_progpolicy.analysis.rules import Rules, count_numbers
from sb3_progpolicy.analysis.situations import Situations, meet, meet_in
from sb3_progpolicy.analysis.switches import disagreements, replace_switches
from sb3_progpolicy.env_ids import env_to_act_in
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.programs.interpreter import ProgramRunner
from sb3_progpolicy.programs.io import program_digest
from sb3_progpolicy.programs.program import Program
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.surroundings import refuse_wrappers

EquallyGood = Literal["program", "planner", "outcome"]
_CHOICES = ("program", "planner", "outcome")
#: What is said of a point of a curve.
CURVE = ("terms", "success_rate", "steps_mean")
#: How often situations that only the simplified program meets are added.
_ROUNDS = 8
#: Episodes on each variation by which conditions with a memory are looked at.
MAX_SWITCH_EPISODES = 20


@dataclass(frozen=True)
class Simplification:
    """A program and a smaller one that makes the same decisions on the training variations.

    :param program: the smaller one
    :param terms_before: numbers of the original that are not zero
    :param terms_after: numbers of the smaller one's rules; a number that a symmetry repeats counts once
    :param terms_lower_bound: no program of this form has fewer terms
    :param tied: whether one rule stands for all directions
    :param symmetry: name of the symmetry that ties it; ``None`` if it is not tied
    :param equally_good: what was kept to: the original's actions, any that the planner calls as good, or success and
        steps within a tolerance
    :param situations: distinct inputs that were looked at
    :param starts: from how many starts they come
    :param exhaustive: whether these are all starts of the training variations
    :param seconds: that it took
    :param notes: what was tried and did not succeed, in sentences
    :param curve: where success and steps were kept, what programs of other numbers of terms reach
    """

    program: Program
    terms_before: int
    terms_after: int
    terms_lower_bound: int
    tied: bool
    symmetry: str | None
    equally_good: str
    situations: int
    starts: int
    exhaustive: bool
    seconds: float
    notes: tuple[str, ...]
    curve: tuple[Point, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return all but the program as JSON values."""
        plain = {name: value for name, value in vars(self).items() if name not in ("program", "curve")}
        curve = [{name: getattr(point, name) for name in CURVE} for point in self.curve]
        return {**plain, "notes": list(self.notes), "curve": curve}


def simplify(
    program: ProgramData,
    env_id: str | None = None,
    variations: Sequence[Mapping[str, Any]] | None = None,
    *,
    equally_good: EquallyGood = "program",
    tie: bool = True,
    n_starts: int = 300,
    time_limit: float = 60.0,
    max_weight: int = MAX_WEIGHT,
    episodes: int = 30,
    success_tolerance: float = 0.01,
    steps_tolerance: float = 0.05,
    n_terms: int | None = None,
    finetune: int | None = None,
    seed: int = 0,
) -> Simplification:
    """Return the program with the fewest whole numbers that makes the same decisions on training variations.

    The distinct inputs that the program meets are constraints of a mixed-integer linear program, whose bound says
    how few terms any program of the same form needs. Its form: the conditions and branches of the original, weights
    that are whole numbers up to ``max_weight``, tied over the domain's symmetries if that is possible, and functions of
    row and column on grids. A recurrent condition of one unit becomes a switch, "on when ..., off when ...", if
    one has the same decisions at every step of whole episodes; others stay as they are.

    With Box actions no numbers do exactly the same: success and steps are kept instead. With Discrete ones, too, if it
    is asked for (``equally_good="outcome"``), since not all that a program does is of use. Terms are added one by one,
    those first that bring the actions nearest to the original's, fitted on the states that the original meets (least
    squares; for Discrete actions the likelihood of its choices) and rounded, until success and steps on the training
    variations are within a tolerance; then those are left out again without which they still are. Branches that never
    act are dropped, conditions stay as they are. If 40 terms do not do, the numbers that matter least are left out,
    those of affine conditions too, and the others stay as they are but for rounding. If asked, PPO then trains the
    numbers of continuous controllers that are left; what comes of it is taken if success and steps on the training
    variations are better.

    :param program: acts in a Discrete space or a Box
    :param env_id: id of a planning domain; by default the one in the program's metadata
    :param variations: to look at; by default those that the domain is trained on
    :param equally_good: ``"program"`` keeps to the program's own actions, ``"planner"`` to those that begin a shortest
        solution, each of which is made to beat all others, ``"outcome"`` to success and steps; with Box actions the
        first and the last are the same
    :param tie: whether to tie weights over the domain's symmetries
    :param n_starts: starts of each variation that are looked at; drawn where there are more
    :param time_limit: seconds for each rule
    :param max_weight: largest size of a weight
    :param episodes: where success and steps are kept, of each evaluation, on each variation
    :param success_tolerance: where these are kept, by how much the share of successes may fall
    :param steps_tolerance: where these are kept, by what share the steps may rise
    :param n_terms: where these are kept, take the program of so many terms, good enough or not
    :param finetune: with Box actions, environment steps of that training; ``None`` for none
    :param seed: of the drawn starts
    :raises ValueError: if an argument is not accepted
    """
    began = time.monotonic()
    env_id = env_to_act_in(env_id, program.metadata.get("env"), "the program")
    if equally_good not in _CHOICES:
        raise unknown("equally_good", equally_good, _CHOICES)
    if finetune is not None and finetune < 1:
        raise ValueError(f"finetune={finetune} is not accepted; it is at least 1")
    if program.action.kind not in ("discrete", "box"):
        raise ValueError(f"{program.action.kind} actions are not accepted here; Discrete and Box ones are")
    box = program.action.kind == "box"
    by_outcome = box or equally_good == "outcome"
    if box and equally_good == "planner":
        raise ValueError("equally_good='planner' is not accepted for Box actions; it is for Discrete ones")
    if not box and finetune is not None:
        raise ValueError(f"finetune={finetune} is not accepted for Discrete actions; it is for Box ones")
    if not by_outcome and n_terms is not None:
        raise ValueError(
            f"n_terms={n_terms} is not accepted for Discrete actions with equally_good={equally_good!r}, of which the "
            "fewest are found; it is with equally_good='outcome'"
        )
    refuse_wrappers("the program", program.metadata.get("wrappers", ()))
    domain = get_domain(env_id)
    variations = domain.trained if variations is None else variations
    symmetries = domain.symmetries if tie else ()
    switched = replace_switches(
        program,
        env_id,
        variations,
        symmetries,
        domain.grids,
        episodes=min(episodes, MAX_SWITCH_EPISODES),
        time_limit=time_limit,
        max_weight=max_weight,
        seed=seed,
    )
    original, program = program, switched.program
    if by_outcome:
        pruned = prune(
            program,
            env_id,
            variations,
            symmetries,
            episodes=episodes,
            success_tolerance=success_tolerance,
            steps_tolerance=steps_tolerance,
            n_terms=n_terms,
            finetune_for=finetune,
            seed=seed,
        )
        return _of_pruned(original, pruned, domain, began)
    planner = equally_good == "planner"
    situations = meet(program, env_id, variations, n_starts, planner, seed)
    if not len(situations.inputs):
        raise ValueError("the program meets no situation; its variations are solved at the start")
    if not planner:
        situations = meet_in(program, switched.traces, situations)
    notes: list[str] = []
    for number in range(_ROUNDS):
        rules = Rules(program, situations, domain, tie, time_limit, max_weight, switched)
        small = rules.program()
        met = meet(small, env_id, variations, n_starts, planner, seed + number, situations)
        met = _relabelled(met, len(situations.inputs), program, planner)
        wrong = _wrong(small, met)
        if not wrong.any():
            situations = met
            break
        situations = met
    else:
        notes.append(f"in {int(wrong.sum())} of {len(met.inputs)} situations it decides otherwise")
    if not planner and (n_other := disagreements(program, small, switched.traces)):
        notes.append(f"in {n_other} steps of whole episodes it decides otherwise")
    notes = [*rules.notes, *notes]
    metadata = dict(program.metadata)
    if small.body != original.body:
        metadata["simplified"] = {
            "from": program_digest(original),
            "terms": rules.n_terms,
            "terms_lower_bound": rules.lower_bound,
            "symmetry": rules.symmetry,
            "equally_good": equally_good,
        }
        if grids := [grid for grid in domain.grids if _is_whole(grid)]:
            metadata["grids"] = [
                {"name": grid.name, "start": grid.start, "rows": len(set(grid.rows)), "columns": len(set(grid.columns))}
                for grid in grids
            ]
    return Simplification(
        program=Program(**{**vars(small), "metadata": metadata}),
        terms_before=count_numbers(original),
        terms_after=rules.n_terms,
        terms_lower_bound=rules.lower_bound,
        tied=rules.symmetry is not None,
        symmetry=rules.symmetry,
        equally_good=equally_good,
        situations=len(situations.inputs),
        starts=situations.starts,
        exhaustive=situations.exhaustive,
        seconds=round(time.monotonic() - began, 1),
        notes=tuple(notes),
    )


def _of_pruned(program: ProgramData, pruned: Pruned, domain: Domain, began: float) -> Simplification:
    symmetry = domain.symmetries[0].name if pruned.tied else None
    small = pruned.point.program
    terms = pruned.point.terms or count_numbers(program)
    metadata = dict(program.metadata)
    if small.body != program.body:
        metadata["simplified"] = {
            "from": program_digest(program),
            "terms": terms,
            "symmetry": symmetry,
            "equally_good": "outcome",
        }
    if pruned.finetuned:
        metadata["simplified"]["finetuned"] = pruned.finetuned
        metadata["learned_by"] = pruned.learned_by
    return Simplification(
        program=Program(**{**vars(small), "metadata": metadata}),
        terms_before=count_numbers(program),
        terms_after=terms,
        terms_lower_bound=0,
        tied=pruned.tied,
        symmetry=symmetry,
        equally_good="outcome",
        situations=pruned.states,
        starts=pruned.episodes,
        exhaustive=False,
        seconds=round(time.monotonic() - began, 1),
        notes=pruned.notes,
        curve=pruned.curve,
    )


def _is_whole(grid: Any) -> bool:
    return len(set(grid.rows)) * len(set(grid.columns)) == len(grid.rows)


def _relabelled(met: Situations, n_known: int, program: ProgramData, planner: bool) -> Situations:
    """Let the original say which branch situations belong to, and what is to be done in those that it has not met.

    :param met: situations, some of which only the simplified program has met, whose branches have other numbers
    :param n_known: how many the original has met; these come first
    :param program: the original
    :param planner: whether the planner has said what may be done
    """
    if any(condition.remembers for condition in program.conditions):
        return met
    runner, allowed = ProgramRunner(program, len(met.inputs)), met.allowed.copy()
    actions = runner.act(met.inputs) - program.action.start
    if not planner:
        allowed[n_known:] = np.eye(allowed.shape[1], dtype=bool)[actions[n_known:]]
    return dataclasses.replace(met, allowed=allowed, branches=runner.branch)


def _wrong(program: ProgramData, situations: Situations) -> NDArray[np.bool_]:
    """Return in which situations a program chooses what it may not; those that depend on memory are left out."""
    if any(condition.remembers for condition in program.conditions):
        return np.zeros(len(situations.inputs), dtype=bool)
    actions = ProgramRunner(program, len(situations.inputs)).act(situations.inputs) - program.action.start
    wrong = ~situations.allowed[np.arange(len(actions)), actions]
    return np.asarray(wrong & situations.allowed.any(axis=1))
