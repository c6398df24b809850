"""The rounds of an imitation: DAgger, then programs that are plain, or sparse."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sb3_progpolicy.imitation.actions import ActionCodec
from sb3_progpolicy.imitation.augmentation import Augment, make_augmentation
from sb3_progpolicy.imitation.conversion import DIGITS, make_program, rounded, to_program
from sb3_progpolicy.imitation.decision_list import DecisionList
from sb3_progpolicy.imitation.judge import Judge
from sb3_progpolicy.imitation.learner import Learner, Settings
from sb3_progpolicy.imitation.memory import MemoryRun, imitate_with_memory
from sb3_progpolicy.imitation.rollouts import Pool, ProgramAct, Variations
from sb3_progpolicy.imitation.saving import State, load_state, save_state
from sb3_progpolicy.imitation.selection import Selection
from sb3_progpolicy.imitation.tasks import names_of, training_variations, validation_variations
from sb3_progpolicy.imitation.teachers import Teacher, TeacherLike, make_teacher
from sb3_progpolicy.imitation.visits import Collector
from sb3_progpolicy.names import check_ignored
from sb3_progpolicy.programs.program import Program
from sb3_progpolicy.programs.syntax import Expression
from sb3_progpolicy.spaces import action_spec

#: Share of the teacher in each round; 0 in all later ones.
TEACHER_SHARES = (1.0, 0.6, 0.4, 0.3, 0.2, 0.1)
N_ROUNDS, N_PLAIN_ROUNDS, N_SPARSE_ROUNDS = 9, 10, 3
_N_BRIEF_ROUNDS = 6  # in place of N_ROUNDS, where plain lists are what is asked for
_PLAIN_TOLERANCE = 0.05
_CHANGED = 0.02  # share of the actions, or mean distance, that rounding may change
#: Inputs that are not read by default: beyond the training sizes they take values that were never seen.
IGNORED = ("left",)


def n_shares() -> int:
    """Return into how many parts the states to label are divided at most: one for each round, two for the first."""
    return N_ROUNDS + N_PLAIN_ROUNDS + N_SPARSE_ROUNDS + 1


@dataclass(frozen=True)
class Imitation:
    """How far an imitation has come.

    :param round: rounds that are done
    :param n_rounds: rounds in all
    :param n_states: labelled states so far
    :param result: of the best program in its validation: success, if there is a goal, steps and return; empty in the
        first rounds, in which no program is validated
    :param teacher: the teacher's
    :param program: the best so far; in the first rounds the present one
    """

    round: int
    n_rounds: int
    n_states: int
    result: Mapping[str, float]
    teacher: Mapping[str, float]
    program: Program


class Run:
    """One imitation; see :func:`~sb3_progpolicy.imitate`."""

    def __init__(
        self,
        pool: Pool,
        teacher: TeacherLike,
        env_id: str,
        tasks: Variations | None,
        settings: Settings,
        ignore: Sequence[str],
        n_episodes: int | None,
        tolerances: tuple[float, float | None],
        augment: str | Augment | None,
    ) -> None:
        env: Any = pool.envs[0]
        self.pool, self.seed = pool, settings.seed
        self.spec = action_spec(env.action_space)
        if settings.max_sums > 1 and self.spec.kind != "box":
            raise ValueError(f"cell='min' is not accepted for {self.spec.kind} actions; for Box actions it is")
        self.inputs, self.outputs = names_of(env, self.spec.n_outputs, pool.interaction)
        self.codec = ActionCodec(self.spec, self.outputs)
        self.teacher: Teacher = make_teacher(teacher, env)
        self.variations, ranks = training_variations(env_id, tasks)
        largest = max(ranks)
        # The smaller sizes are the ends of the larger ones, which therefore say more.
        ranked = list(zip(self.variations, ranks, strict=True))
        validation = [one for least in (largest - 1, largest) for one, rank in ranked if rank >= least]
        check_ignored(ignore, self.inputs, IGNORED)
        score_tolerance, plain_tolerance = tolerances
        if self.spec.kind != "box" and plain_tolerance is not None:
            raise ValueError(
                f"plain_tolerance={plain_tolerance} is not accepted for {self.spec.kind} actions; plain programs are "
                "those of Box actions"
            )
        plain_tolerance = _PLAIN_TOLERANCE if plain_tolerance is None else plain_tolerance
        self.judge = Judge(pool, validation, n_episodes, score_tolerance, self.teacher)
        self.ranks, self.augmentation = ranks, make_augmentation(augment, self.inputs)
        self.origin: dict[str, Any] = {"env": env_id, "seed": self.seed, "teacher": self.teacher.name}
        if augment is not None:
            self.origin["augment"] = augment if isinstance(augment, str) else getattr(augment, "__name__", "function")
        readable = np.array([name not in ignore for name in self.inputs])
        self.learner = Learner(self.codec, readable, settings)
        beyond = validation_variations(env_id) if tasks is None else ()
        self.selection = Selection(self.learner, self.judge, beyond, self.codec, self.augmentation, plain_tolerance)
        self.n_labelled = 0
        #: Teachers with continuous actions may be made of pieces.
        self.n_plain_rounds = N_PLAIN_ROUNDS if self.spec.kind == "box" else 0
        #: Whether a plain list is asked for, whatever another one reaches.
        self.wants_plain = settings.max_sums > 1
        self.n_dense_rounds = min(N_ROUNDS, _N_BRIEF_ROUNDS) if self.wants_plain else N_ROUNDS

    @property
    def n_rounds(self) -> int:
        """Number of rounds at most."""
        return self.n_dense_rounds + self.n_plain_rounds + N_SPARSE_ROUNDS

    def n_rows(self, n_states: int) -> int:
        """Return in how many environments so many states are visited, so that each sees whole episodes."""
        return min(len(self.pool), max(1, n_states // self.judge.limit))

    def run(
        self,
        visited: Pool,
        n_states: int,
        callback: Callable[[Imitation], None] | None,
        checkpoint: Path | None,
    ) -> Program:
        """Run all rounds, or those that a checkpoint leaves.

        :param visited: environments in which states are visited
        :param n_states: in each round; twice as many in the first
        :param callback: see :func:`~sb3_progpolicy.imitate`
        :param checkpoint: see :func:`~sb3_progpolicy.imitate`
        """
        self.collector = Collector(
            visited, self.teacher, self.variations, self.ranks, self.seed, self.augmentation, self.judge.limit
        )
        n_steps = n_states // len(visited)
        origin = {
            **self.origin,
            "n_steps": n_steps,
            "max_branches": self.learner.settings.max_branches,
            **({"cell": "min"} if self.learner.settings.max_sums > 1 else {}),
            "n_episodes": self.judge.n_episodes,
            "score_tolerance": self.judge.tolerance,
            "plain_tolerance": self.selection.plain_tolerance,
            "inputs": [name for name, read in zip(self.inputs, self.learner.readable, strict=True) if read],
            "tasks": [dict(variation) for variation in self.variations],
            "env_kwargs": self.pool.env_kwargs,
            "behaviour of the teacher": self.judge.teacher_digest,
        }
        first = 0
        if checkpoint is not None and checkpoint.exists():
            first = self._restore(load_state(checkpoint, origin))
        self.judge.final = first >= self.n_dense_rounds and self.selection.best is not None
        total = self.n_rounds
        for number in range(first, total):
            self._round(number, n_steps)
            done = total if self.selection.is_plain else number + 1
            if checkpoint is not None:
                save_state(checkpoint, origin, self._state(done))
            if callback is not None:
                callback(self._progress(done, total))
            if done == total:
                break
        self._know_deviations()
        return self._program(self._rounded())

    def run_with_memory(self, visited: Pool, n_states: int, callback: Callable[[Imitation], None] | None) -> Program:
        """Run all rounds with conditions that remember. See :meth:`run`."""

        def program_of(body: Expression) -> Program:
            return make_program(body, self.spec, self.inputs, self.outputs, self.pool.interaction, **self._metadata)

        def after_round(done: int, total: int, n_labelled: int, best: Program, result: Mapping[str, float]) -> None:
            self.n_labelled = n_labelled
            if callback is not None:
                callback(Imitation(done, total, n_labelled, result, self.judge.teacher_episodes.summary(), best))

        self.judge.patience = None  # with a memory, the same observation again and again may be on the way

        def score(program: Program) -> float:
            return self.judge.score(ProgramAct(program, len(self.pool)))

        run = MemoryRun(
            collector=Collector(visited, self.teacher, self.variations, self.ranks, self.seed, None, self.judge.limit),
            codec=self.codec,
            readable=self.learner.readable,
            seed=self.seed,
            max_conditions=self.learner.settings.max_branches - 1,
            horizon=int(self.judge.teacher_episodes.steps.mean()),
            to_program=program_of,
            score=score,
            as_good=self.judge.as_good,
            last_result=lambda: dict(self.judge.last_result),
            after_round=after_round,
        )
        return imitate_with_memory(run, n_states // len(visited))

    def _state(self, number: int) -> State:
        learner, collector, selection = self.learner, self.collector, self.selection
        return State(
            number=number,
            next_seed=collector.next_seed,
            generators={"learner": learner.rng.bit_generator.state, "collector": collector.rng.bit_generator.state},
            observations=learner.observations,
            targets=learner.targets,
            weights=learner.weights,
            present=learner.raw,
            plain=tuple(selection.plain),
            best=selection.best,
            runners_up=tuple(selection.runners_up),
            result=selection.result,
            reference=selection.reference,
            has_goal=collector.has_goal,
        )

    def _restore(self, state: State) -> int:
        """Go back to a state; return the number of rounds that are done."""
        learner, collector, selection = self.learner, self.collector, self.selection
        learner.rng.bit_generator.state = state.generators["learner"]
        collector.rng.bit_generator.state = state.generators["collector"]
        collector.next_seed = state.next_seed
        learner.observations, learner.targets, learner.weights = state.observations, state.targets, state.weights
        learner.raw = state.present
        selection.best, selection.runners_up = state.best, list(state.runners_up)
        selection.result, selection.reference = state.result, state.reference
        selection.plain, collector.has_goal = list(state.plain), state.has_goal
        return state.number

    def _round(self, number: int, n_steps: int) -> None:
        self._know_deviations()
        if number < self.n_dense_rounds - 1:
            self._dense_round(number, n_steps)
        elif number < self.n_dense_rounds + self.n_plain_rounds:
            self._plain_round(number, n_steps)
        else:
            self._visit(number, n_steps)
            self.selection.offer(self.learner.refit_sparse(), sparse=True)
        if self.selection.is_plain or number == self.n_rounds - 1:
            self.selection.drop_rare_branches()

    def _dense_round(self, number: int, n_steps: int) -> None:
        """Fit lists that all inputs are open to."""
        self._visit(number, n_steps)
        for candidate in self.learner.fit(number):
            if number >= self.n_dense_rounds // 2 - 1 and not self.wants_plain:
                self.selection.offer(candidate)

    def _plain_round(self, number: int, n_steps: int) -> None:
        """Make plain lists; in the first of these rounds choose a dense one, in the last begin with a sparse one.

        Plain lists learn from the episodes that they were judged by, as soon as there are any.
        """
        selection = self.selection
        series = number - self.n_dense_rounds + 2
        is_last = number == self.n_dense_rounds + self.n_plain_rounds - 1
        if not selection.plain:
            self._visit(number, n_steps)
        if series == 1 and not self.wants_plain:
            self._choose_dense()
        selection.make_plain(series)
        if is_last or selection.is_sure:
            selection.choose_plain()
        if selection.is_plain:
            return
        if not is_last:
            selection.label_seen(n_steps * len(self.collector.pool))
            return
        if self.wants_plain:
            self._choose_dense()
        selection.make_short()
        selection.make_sparse()

    def _know_deviations(self) -> None:
        """Tell what looks for stalls how much the inputs vary."""
        if self.learner.n_states:
            self.collector.stalls.deviations = deviations = self.learner.observations.std(axis=0)
            if self.judge.patience is not None:
                self.judge.patience.stalls.deviations = deviations[: self.pool.observations.shape[1]]

    def _choose_dense(self) -> None:
        """Fit the present list for longer, and let it and the best ones so far play their last episodes."""
        for candidate in self.learner.finish():
            self.selection.offer(candidate)
        self.selection.choose_finally()

    def _visit(self, number: int, n_steps: int) -> None:
        """Label states that teacher and student visit in turns.

        :param number: of the round
        :param n_steps: of each environment
        """
        self.collector.begin()
        share = TEACHER_SHARES[number] if number < len(TEACHER_SHARES) else 0.0
        student = None if self.learner.raw is None else self.codec.act_of(self.learner.raw)
        visits = self.collector.collect(n_steps * (1 if number else 2), student, share)
        targets = self.codec.encode(visits.actions) if visits.good is None else visits.good.astype(np.float64)
        self.learner.add(visits.inputs, targets, visits.weights)

    def _rounded(self) -> DecisionList:
        """Return the best list with as few digits as its episodes allow, its outputs in the unit of actions."""
        assert self.selection.best is not None
        score, best = self.selection.best
        raw = replace(best, controllers=self.codec.to_action_units(best.controllers))
        states = self.learner.observations[:: max(1, self.learner.n_states // 2000)]
        exact = self.codec.act_of(best)(states)
        for digits in DIGITS:
            candidate = rounded(raw, digits, self.codec.unit)
            program = self._program(candidate)
            changed = self.codec.distance(ProgramAct(program, len(states))(states), exact).mean()
            if changed > _CHANGED:
                continue
            if self.judge.as_good(self.judge.score(ProgramAct(program, len(self.pool)), score), score, share=0.5):
                return candidate
        return raw

    def _progress(self, number: int, total: int) -> Imitation:
        assert self.learner.raw is not None
        best = self.selection.best
        raw = self.learner.raw if best is None else best[1]
        in_units = replace(raw, controllers=self.codec.to_action_units(raw.controllers))
        return Imitation(
            number,
            total,
            self.learner.n_states,
            self.selection.result,
            self.judge.teacher_episodes.summary(),
            self._program(in_units),
        )

    def _program(self, raw: DecisionList) -> Program:
        return to_program(raw, self.spec, self.inputs, self.outputs, self.pool.interaction, **self._metadata)

    @property
    def _metadata(self) -> dict[str, Any]:
        trained_on = [dict(variation) for variation in self.variations]
        about = {"learned_by": "imitation", "labelled_states": self.n_labelled or self.learner.n_states}
        return {**self.origin, **about, **({"trained_on": trained_on} if any(trained_on) else {})}
