"""What make_fast_vec_env makes of an id, against single environments in SB3's own vectorisation."""

import multiprocessing
import os

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, is_vecenv_wrapped

from sb3_progpolicy.vec_env import BatchedVecEnv, GroupedSubprocVecEnv, GroupedVecEnv, make_fast_vec_env
from sb3_progpolicy.vec_env.factory import simulations_in_this_process

N_ENVS = 4


def test_batched_hanoi_equals_single_ones_step_for_step():
    options = [{"n_discs": n, "source": "random", "target": "random"} for n in (1, 1, 2, 8)]
    batched = make_fast_vec_env("Hanoi-v0", N_ENVS, seed=3)
    single = make_vec_env("Hanoi-v0", N_ENVS, seed=3)
    rng = np.random.default_rng(0)
    ends = {True: 0, False: 0}
    for task in range(2):
        for env in (batched, single):
            env.seed(7 + task)
            env.set_options(options[:: 1 - 2 * task])
        np.testing.assert_array_equal(batched.reset(), single.reset())
        assert batched.unwrapped.reset_infos == single.unwrapped.reset_infos
        for _ in range(1100):
            actions = rng.integers(6, size=N_ENVS)
            (obs_a, rewards_a, dones_a, infos_a), (obs_b, rewards_b, dones_b, infos_b) = (
                env.step(actions) for env in (batched, single)
            )
            np.testing.assert_array_equal(obs_a, obs_b)
            np.testing.assert_allclose(rewards_a, rewards_b)
            np.testing.assert_array_equal(dones_a, dones_b)
            for row in np.flatnonzero(dones_a):
                a, b = infos_a[row], infos_b[row]
                np.testing.assert_array_equal(a["terminal_observation"], b["terminal_observation"])
                for name in ("is_success", "TimeLimit.truncated"):
                    assert a[name] == b[name]
                    assert type(a[name]) is bool
                assert a["episode"]["l"] == b["episode"]["l"]
                assert a["episode"]["r"] == pytest.approx(b["episode"]["r"], abs=1e-4)
                ends[a["TimeLimit.truncated"]] += 1
    assert min(ends.values()) > 0, "episodes of both ends are compared"


def test_batched_form_is_taken_where_there_is_one():
    hanoi, cartpole = make_fast_vec_env("Hanoi-v0", 3), make_fast_vec_env("CartPole-v1", 2)
    assert isinstance(hanoi.unwrapped, BatchedVecEnv)
    assert is_vecenv_wrapped(hanoi, VecMonitor)
    # CartPole has a batched form, but it does not reset within the step.
    assert isinstance(cartpole.unwrapped, DummyVecEnv)
    assert (hanoi.num_envs, cartpole.num_envs) == (3, 2)


def test_environment_arguments_reach_both_forms():
    assert make_fast_vec_env("Hanoi-v0", 2, n_discs=5).get_attr("row_variations")[0][0]["n_discs"] == 5
    assert make_fast_vec_env("Pendulum-v1", 2, g=3.0).get_attr("g") == [3.0, 3.0]


def test_equal_seeds_give_equal_starts():
    def starts(seed):
        env = make_fast_vec_env("Hanoi-v0", 16, seed, source="random", target="random")
        return env.reset()

    np.testing.assert_array_equal(starts(1), starts(1))
    assert (starts(1) != starts(2)).any()


def test_other_autoreset_modes_are_refused():
    with pytest.raises(ValueError, match="SAME_STEP"):
        BatchedVecEnv(SyncVectorEnv([lambda: gym.make("CartPole-v1")]))


def test_other_batches_that_reset_within_the_step_are_taken_as_they_are():
    batch = gym.make_vec(
        "CartPole-v1",
        num_envs=2,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        wrappers=[RecordEpisodeStatistics],
    )
    batched, single = BatchedVecEnv(batch), make_vec_env("CartPole-v1", 2, seed=1)
    batched.seed(1)
    np.testing.assert_array_equal(batched.reset(), single.reset())
    ends = 0
    for _ in range(60):
        a, b = (env.step(np.ones(2, dtype=int)) for env in (batched, single))
        for one, other in zip(a[:3], b[:3], strict=True):
            np.testing.assert_array_equal(one, other)
        for row in np.flatnonzero(a[2]):
            ends += 1
            np.testing.assert_array_equal(a[3][row]["terminal_observation"], b[3][row]["terminal_observation"])
            assert a[3][row]["episode"]["l"] == b[3][row]["episode"]["l"]
    assert ends > 4


def test_limits_on_steps_mean_what_they_do_in_the_single_form():
    def length(limit):
        env = make_fast_vec_env("Hanoi-v0", 1, n_discs=8, max_episode_steps=limit)
        env.reset()
        return next((step for step in range(1, 700) if env.step(np.zeros(1, dtype=int))[2][0]), None)

    assert (length(7), length(-1), length(None)) == (7, None, 500)
    with pytest.raises(ValueError, match="max_episode_steps=0"):
        length(0)


def test_pictures_come_from_the_single_form_where_the_batch_draws_none():
    env = make_fast_vec_env("Hanoi-v0", 2, render_mode="rgb_array")
    env.reset()
    assert env.render().ndim == 3
    env.close()


def test_no_environment_is_refused():
    with pytest.raises(ValueError, match="n_envs=0"):
        make_fast_vec_env("Hanoi-v0", 0)


def test_options_that_only_some_environments_are_given_leave_the_others_as_they_are():
    env = make_fast_vec_env("Hanoi-v0", 2)
    env.set_options([{"n_discs": 1}, {"source": 1}])
    env.reset()
    variations = [info["variation"] for info in env.unwrapped.reset_infos]
    assert [(variation["n_discs"], variation["source"]) for variation in variations] == [(1, 0), (3, 1)]


def set_cores(monkeypatch, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)


@pytest.mark.parametrize(
    ("arguments", "kind"), [({}, GroupedVecEnv), ({"observation": "goal"}, GroupedSubprocVecEnv)], ids=["flat", "goal"]
)
def test_simulations_are_grouped_and_equal_single_ones(monkeypatch, arguments, kind):
    set_cores(monkeypatch, 2)
    options = [{"n_targets": n} for n in (1, 2, 3)]
    arguments = {**arguments, "max_episode_steps": 15}
    grouped = make_fast_vec_env("PandaReach-v0", 3, seed=5, **arguments)
    single = make_vec_env("PandaReach-v0", 3, seed=5, env_kwargs=arguments)
    try:
        assert type(grouped.unwrapped) is kind
        assert len(grouped.unwrapped.processes) == 1
        for env in (grouped, single):
            env.set_options(options)
        np.testing.assert_equal(grouped.reset(), single.reset())
        rng = np.random.default_rng(0)
        for _ in range(40):
            actions = rng.uniform(-1, 1, (3, 4)).astype(np.float32)
            a, b = grouped.step(actions), single.step(actions)
            np.testing.assert_equal(a[:3], b[:3])
            for row in np.flatnonzero(b[2]):
                info_a, info_b = a[3][row], b[3][row]
                for key in ("is_success", "TimeLimit.truncated", "terminal_observation"):
                    np.testing.assert_equal(info_a[key], info_b[key])
                assert info_a["episode"]["l"] == info_b["episode"]["l"]
                assert info_a["episode"]["r"] == pytest.approx(info_b["episode"]["r"], abs=1e-4)
            if kind is GroupedSubprocVecEnv:
                np.testing.assert_equal(*([{**info, "episode": None} for info in infos] for infos in (a[3], b[3])))
    finally:
        grouped.close()
        single.close()


@pytest.mark.parametrize(("env_id", "n_envs", "cores"), [("PandaReach-v0", 1, 8), ("PandaReach-v0", 2, 1)])
def test_one_simulation_or_one_core_needs_no_process(monkeypatch, env_id, n_envs, cores):
    set_cores(monkeypatch, cores)
    env = make_fast_vec_env(env_id, n_envs)
    assert isinstance(env.unwrapped, BatchedVecEnv)
    env.close()


@pytest.mark.parametrize("cores", [1, 2])
def test_simulations_take_some_options_for_some_and_draw_pictures(monkeypatch, cores):
    set_cores(monkeypatch, cores)
    env = make_fast_vec_env("PandaReach-v0", 2, render_mode="rgb_array")
    env.set_options([{"n_targets": 2}, {}])
    env.reset()
    assert [info["variation"] for info in env.unwrapped.reset_infos] == [{"n_targets": 2}, {"n_targets": 1}]
    assert [picture.shape for picture in env.get_images()] == [(360, 480, 3)] * 2
    assert env.render().shape[2] == 3
    env.close()


def test_no_process_is_started_where_none_may_be(monkeypatch):
    set_cores(monkeypatch, 2)
    monkeypatch.setattr(multiprocessing.current_process(), "daemon", True)
    env = make_fast_vec_env("PandaReach-v0", 2)
    assert isinstance(env.unwrapped, BatchedVecEnv)
    env.close()


def test_no_process_is_started_within_simulations_in_this_process(monkeypatch):
    set_cores(monkeypatch, 2)
    with simulations_in_this_process():
        env = make_fast_vec_env("PandaReach-v0", 2)
        assert isinstance(env.unwrapped, BatchedVecEnv)
        env.close()
    env = make_fast_vec_env("PandaReach-v0", 2)
    assert isinstance(env.unwrapped, GroupedVecEnv)
    env.close()
