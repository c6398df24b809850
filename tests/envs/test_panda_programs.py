"""The hand-written Panda programs solve training and unseen numbers of objects."""

from __future__ import annotations

import gymnasium as gym
import pytest

from progpolicy_envs import get_domain
from tests.handwritten.evaluate import play, play_plan, size_of

pytest.importorskip("pybullet")

from tests.handwritten.panda import PROGRAMS


@pytest.mark.parametrize("n_objects", [1, 3, 8])
@pytest.mark.parametrize("env_id", PROGRAMS)
def test_handwritten_program_solves_about_as_fast_as_the_scripted_controller(env_id: str, n_objects: int) -> None:
    program, variation = PROGRAMS[env_id](), {get_domain(env_id).size: n_objects}
    env = gym.make(env_id, disable_env_checker=True)
    ours = [play(program, env, seed, **variation) for seed in range(3)]
    assert [episode.success for episode in ours] == [True] * 3
    scripted = [play_plan(env, seed, **variation) for seed in range(3)]
    assert sum(episode.steps for episode in ours) < 1.4 * sum(episode.steps for episode in scripted)
    env.close()


@pytest.mark.parametrize("env_id", PROGRAMS)
def test_handwritten_program_is_short_affine_and_reads_no_history(env_id: str) -> None:
    program = PROGRAMS[env_id]()
    assert size_of(program)[1] <= 7
    assert all(condition.cell == "affine" for condition in program.conditions)
    history = slice(program.n_observations, None)
    assert not any(any(condition.readout[history]) for condition in program.conditions)
    assert not any(any(row[history]) for controller in program.controllers for row in controller.weights)
