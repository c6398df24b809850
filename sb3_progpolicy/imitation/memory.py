"""DAgger with programs that remember."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.imitation.actions import ActionCodec
from sb3_progpolicy.imitation.conversion import DIGITS
from sb3_progpolicy.imitation.recurrent import Sequences, fit_sequences, map_numbers, rounded_body
from sb3_progpolicy.imitation.rollouts import Act, ProgramAct
from sb3_progpolicy.imitation.visits import Collector
from sb3_progpolicy.programs.program import Program
from sb3_progpolicy.programs.syntax import Expression

#: Share of the teacher in each round.
SHARES = (1.0, 0.5, 0.3, 0.1, 0.0, 0.0)
_FEW = 3  # conditions before the last round
_SIZES = (1, 2, 3, 4, 6, 8, 11)  # numbers of conditions tried in the last one
_N_STEPS = 300  # of Adam


@dataclass(frozen=True)
class MemoryRun:
    """What an imitation with memory needs.

    :param collector: visits states
    :param codec: of the action space
    :param readable: which inputs may be read, ``(n_inputs,)``
    :param seed: of all draws
    :param max_conditions: of the program at most, at least 1
    :param horizon: steps over which the program may have to remember
    :param to_program: makes a program of its body
    :param score: of a program's episodes; more is better
    :param as_good: whether one score is as good as another
    :param last_result: returns the means of the episodes that were scored last
    :param after_round: is called with the number of rounds done, of rounds in all and of states, the best program and
        the means of its episodes
    """

    collector: Collector
    codec: ActionCodec
    readable: NDArray[np.bool_]
    seed: int
    max_conditions: int
    horizon: int
    to_program: Callable[[Expression], Program]
    score: Callable[[Program], float]
    as_good: Callable[[float, float], bool]
    last_result: Callable[[], Mapping[str, float]]
    after_round: Callable[[int, int, int, Program, Mapping[str, float]], None]


def imitate_with_memory(run: MemoryRun, n_steps: int) -> Program:
    """Return the best program of some rounds, its numbers rounded as far as its episodes stay as good.

    :param run: what is needed
    :param n_steps: of every environment in each round; twice as many in the first
    """
    parts: list[Any] = []
    present: Program | None = None
    best: tuple[float, Program] | None = None
    result: Mapping[str, float] = {}
    for number, share in enumerate(SHARES):
        run.collector.begin()
        act: Act | None = None if present is None else ProgramAct(present, len(run.collector.pool))
        parts.append(_labelled(run, n_steps * (1 if number else 2), act, share))
        data = Sequences.of(parts)
        last = number == len(SHARES) - 1
        for size in _sizes(run.max_conditions, last):
            seed = 1000 * run.seed + 10 * number + size
            body, _ = fit_sequences(run.codec.loss(), data, run.readable, size, run.horizon, seed, _N_STEPS)
            present = run.to_program(_in_units(body, run.codec))
            reached = run.score(present)
            shorter = best is not None and size < len(best[1].conditions) and run.as_good(reached, best[0])
            if best is None or reached > best[0] or shorter:
                best, result = (reached, present), run.last_result()
        assert best is not None
        run.after_round(number + 1, len(SHARES), int((data.weights > 0).sum()), best[1], result)
    assert best is not None
    return _rounded(run, best)


def _labelled(run: MemoryRun, n_steps: int, act: Act | None, share: float) -> tuple[Any, Any, Any]:
    visits = run.collector.collect(n_steps, act, share)
    targets = run.codec.encode(visits.actions) if visits.good is None else visits.good.astype(np.float64)
    shape = (n_steps, len(run.collector.pool))
    return visits.inputs.reshape(*shape, -1), targets.reshape(*shape, -1), visits.weights.reshape(shape)


def _sizes(max_conditions: int, last: bool) -> Sequence[int]:
    return [size for size in _SIZES if size <= max_conditions] if last else [min(_FEW, max_conditions)]


def _in_units(body: Expression, codec: ActionCodec) -> Expression:
    return map_numbers(body, lambda numbers: numbers, lambda output: codec.to_action_units(output[None])[0])


def _rounded(run: MemoryRun, best: tuple[float, Program]) -> Program:
    score, program = best
    for digits in DIGITS:
        candidate = run.to_program(rounded_body(program.body, digits))
        if run.as_good(run.score(candidate), score):
            return candidate
    return program
