"""A teacher and its program side by side."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sb3_progpolicy.bounds import check_whole
from sb3_progpolicy.imitation.actions import ActionCodec
from sb3_progpolicy.imitation.arguments import check_tasks
from sb3_progpolicy.imitation.rollouts import Pool, ProgramAct, Variations, play
from sb3_progpolicy.imitation.tasks import training_variations
from sb3_progpolicy.imitation.teachers import TeacherLike, make_teacher
from sb3_progpolicy.programs.program import Program


@dataclass(frozen=True)
class Comparison:
    """A teacher and its program on the same episodes.

    :param teacher: the teacher's means: return, steps and, where there is a goal, success
    :param program: the program's
    :param distance: of the program's actions from the teacher's in the states that the program visits: the share of
        other actions if Discrete, else the mean over numbers, in half ranges of the action space
    """

    teacher: Mapping[str, float]
    program: Mapping[str, float]
    distance: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        return dataclasses.asdict(self)


def compare_with_teacher(
    teacher: TeacherLike,
    program: Program,
    env_id: str,
    tasks: Variations | None = None,
    n_episodes: int = 30,
    seed: int = 10_000,
    env_kwargs: Mapping[str, Any] | None = None,
) -> Comparison:
    """Play the same episodes with a teacher and with a program.

    :param teacher: see :func:`imitate`
    :param program: to compare
    :param env_id: environment id
    :param tasks: variations to play on, in turn; by default those that the domain is trained on
    :param n_episodes: on all of them together
    :param seed: of the first episode
    :param env_kwargs: constructor arguments of the environment
    :raises ValueError: if an argument is not accepted
    """
    check_tasks(env_id, tasks)
    check_whole("n_episodes", n_episodes, 1)
    pool = Pool(env_id, min(n_episodes, 24), env_kwargs, program.interaction)
    try:
        env: Any = pool.envs[0]
        judge = make_teacher(teacher, env)
        codec = ActionCodec(program.action, program.output_names)
        variations, _ = training_variations(env_id, tasks)
        own = play(pool, variations, n_episodes, seed, None, judge)
        act = ProgramAct(program, len(pool))
        imitated = play(pool, variations, n_episodes, seed, act, judge, codec.distance)
        return Comparison(own.summary(), imitated.summary(), imitated.distance)
    finally:
        pool.close()
