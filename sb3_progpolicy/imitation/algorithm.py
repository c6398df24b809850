"""From a teacher to a program, by DAgger: the student acts more and more, the teacher labels what it meets."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from threadpoolctl import threadpool_limits

from sb3_progpolicy.imitation.arguments import check_arguments, check_tasks
from sb3_progpolicy.imitation.augmentation import Augment, make_starts
from sb3_progpolicy.imitation.learner import Settings
from sb3_progpolicy.imitation.memory import SHARES
from sb3_progpolicy.imitation.recurrent import RECURRENT_CELLS
from sb3_progpolicy.imitation.rollouts import Pool, Variations
from sb3_progpolicy.imitation.rounds import IGNORED, Imitation, Run, n_shares
from sb3_progpolicy.imitation.teachers import TeacherLike
from sb3_progpolicy.programs.program import Program

#: Sums of a condition at most, if ``cell="min"``.
MAX_SUMS = 3


def imitate(
    teacher: TeacherLike,
    env_id: str,
    tasks: Variations | None = None,
    n_timesteps: int = 30_000,
    max_conditions: int = 11,
    cell: str = "affine",
    seed: int = 0,
    *,
    n_envs: int = 24,
    interaction: bool = False,
    ignore: Sequence[str] = IGNORED,
    score_tolerance: float = 0.015,
    plain_tolerance: float | None = None,
    n_episodes: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    augment: str | Augment | None = None,
    callback: Callable[[Imitation], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Program:
    """Return a program that does what a teacher does, learned from the teacher's actions, not from rewards.

    .. code-block:: python

        program = imitate("planner", "PandaPush-v0")
        program = imitate(PPO("MlpPolicy", "CartPole-v1").learn(60_000), "CartPole-v1", n_timesteps=20_000)

    States are visited by a mixture of teacher and student whose share of the teacher falls to 0, and labelled by the
    teacher (DAgger, Ross et al. 2011). The program with the best episodes on training variations is made plain, or
    sparse, and round, as far as its episodes stay as good. A plain program, whose controllers are pieces of what the
    teacher does, is taken if the mean of its scores on these and on the domain's validation variations is as good;
    unseen variations are not looked at.

    :param teacher: ``"planner"``, a model of Stable-Baselines3 or sb3-contrib, a program, or a function from
        observations ``(n_envs, n_observations)`` to actions ``(n_envs, *action_shape)``. A model that was loaded
        without its ``VecNormalize`` sees observations that are not normalised: give it to ``load`` as ``env``
    :param env_id: environment id
    :param tasks: variations to learn on, the easiest first; by default those that the domain is trained on
    :param n_timesteps: states to label, at most; those that ``augment`` makes come on top
    :param max_conditions: of the program at most
    :param cell: of the conditions: ``"affine"``; ``"min"``, which lets conditions of a plain program ask for up to
        three things at once, Box actions only; or ``"gru"``, a memory of one unit each, where the teacher's action is
        not a function of the present input
    :param seed: of all draws
    :param n_envs: environments that are stepped together
    :param interaction: whether the program reads its previous action, reward and done flag, too
    :param ignore: names of inputs that the program must not read
    :param score_tolerance: share of the score that fewer and rounder numbers may cost
    :param plain_tolerance: share of the score that a plain program may cost, which a person can read, by default 0.05;
        0 takes it only if it is at least as good as the list that all inputs are open to. With ``cell="min"`` it is
        always taken; there is none for Discrete actions and with ``cell="gru"``
    :param n_episodes: of each validation, on training variations; the last ones have twice as many. By default 96, or
        24 in the Panda tasks, whose steps are simulations
    :param env_kwargs: constructor arguments of the environment
    :param augment: makes states that were not visited, which the teacher labels too: a function from observations and
        a generator to observations, or ``"taller_towers"`` for PandaStack; ``"begun_towers"`` begins half of its
        episodes with a tower of one to five blocks instead. What was learned so was shown more than the training
        variations; the metadata say so
    :param callback: is called after each round; what it returns is not looked at
    :param checkpoint: file in which the state is kept after each round; one that exists is gone on from. It stays when
        all is done
    :return: the program; its metadata say that it was learned by imitation, and of whom
    :raises ValueError: if an argument is not accepted
    """
    check_tasks(env_id, tasks)
    remembers = cell in RECURRENT_CELLS
    checkpoint = check_arguments(
        n_timesteps=n_timesteps,
        least_timesteps=n_shares(),
        max_conditions=max_conditions,
        cell=cell,
        seed=seed,
        n_envs=n_envs,
        interaction=interaction,
        ignore=ignore,
        score_tolerance=score_tolerance,
        plain_tolerance=plain_tolerance,
        n_episodes=n_episodes,
        augment=augment,
        checkpoint=checkpoint,
    )
    begin = make_starts(augment)
    # The matrices are small: several threads of BLAS are slower than one, most of all where another process runs.
    one_thread = threadpool_limits(1, user_api="blas")
    with one_thread, Pool(env_id, n_envs, env_kwargs, interaction, begin) as pool:
        tolerances = score_tolerance, plain_tolerance
        settings = Settings(max_conditions + 1, seed, max_sums=MAX_SUMS if cell == "min" else 1)
        run = Run(pool, teacher, env_id, tasks, settings, ignore, n_episodes, tolerances, augment)
        n_states = n_timesteps // (len(SHARES) + 1 if remembers else run.n_rounds + 1)
        with Pool(env_id, run.n_rows(n_states), env_kwargs, interaction, begin) as visited:
            if remembers:
                return run.run_with_memory(visited, n_states, callback)
            return run.run(visited, n_states, callback, checkpoint)
