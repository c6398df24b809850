"""Environments grouped in a few processes against the same environments in one process."""

import os
import signal
import subprocess
import sys
from collections import Counter
from copy import deepcopy
from multiprocessing.connection import Connection
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecMonitor

from sb3_progpolicy.vec_env import GroupedSubprocVecEnv, GroupedVecEnv, WorkerDiedError, worker

N_ENVS = 5
PLACES = {
    "array": spaces.Box(0, 1, (2,), np.float64),
    "dict": spaces.Dict({"near": spaces.Box(0, 1, (2,), np.float32), "far": spaces.Discrete(9)}),
    "tuple": spaces.Tuple((spaces.Box(0, 1, (1, 2), np.float32), spaces.Discrete(3))),
}


class Locked(Exception):
    """Can be pickled, but not unpickled: it is pickled with one argument and needs two."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


class Countdown(gym.Env):
    """Ends after as many steps as its option says. Its infos and observations are not all of one kind."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 3}

    def __init__(self, place="array", render_mode=None):
        self.observation_space, self.action_space = deepcopy(PLACES[place]), spaces.Discrete(4)
        self.render_mode, self.start, self.closed_file, self.pid = render_mode, 5, None, os.getpid()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.start = (options or {}).get("start", self.start)
        if self.start < 0:
            raise ValueError(f"start={self.start} is not accepted")
        self.left = self.start
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample(), {"start": self.start}

    def step(self, action):
        if action == 3:
            os._exit(7)
        self.left -= 1
        info = {"action": np.array([action])} if action == 2 else {}
        reward = self.np_random.normal()
        return self.observation_space.sample(), reward, self.left == 0 and action == 1, self.left <= 0, info

    def render(self):
        return np.full((4, 6, 3), self.start, dtype=np.uint8)

    def fail(self):
        raise Locked("a", "b")

    def return_locked(self):
        return Locked("a", "b")

    def touch_on_closing(self, path):
        self.closed_file = path

    def close(self):
        if self.closed_file is not None:
            Path(self.closed_file).touch()


class Marked(gym.Wrapper):
    """Changes nothing."""


def functions(n_envs=N_ENVS, **kwargs):
    return [
        lambda row=row: Monitor(Marked(Countdown(**kwargs)) if row % 2 else Countdown(**kwargs))
        for row in range(n_envs)
    ]


@pytest.fixture(scope="module")
def pair():
    """Five environments in this process and two workers, and the same five in this process alone."""
    envs = GroupedSubprocVecEnv(functions(render_mode="rgb_array"), 2), DummyVecEnv(functions(render_mode="rgb_array"))
    yield envs
    for env in envs:
        env.close()


def without_time(infos):
    return [{**info, "episode": {**info["episode"], "t": 0}} if "episode" in info else info for info in infos]


def assert_equal_runs(grouped, single, n_steps):
    ends = {True: 0, False: 0}
    rng = np.random.default_rng(0)
    for round_ in range(2):
        for env in (grouped, single):
            env.seed(7 + round_)
            env.set_options([{"start": 1 + (row + round_) % 4} if row else {} for row in range(N_ENVS)])
        np.testing.assert_equal(grouped.reset(), single.reset())
        assert grouped.reset_infos == single.reset_infos
        for _ in range(n_steps):
            actions = rng.integers(3, size=N_ENVS)
            (obs_a, rewards_a, dones_a, infos_a), (obs_b, rewards_b, dones_b, infos_b) = (
                env.step(actions) for env in (grouped, single)
            )
            assert type(obs_a) is type(obs_b)
            np.testing.assert_equal(obs_a, obs_b)
            for a, b in ((rewards_a, rewards_b), (dones_a, dones_b)):
                assert a.dtype == b.dtype
                np.testing.assert_array_equal(a, b)
            np.testing.assert_equal(without_time(infos_a), without_time(infos_b))
            assert grouped.reset_infos == single.reset_infos
            for row in np.flatnonzero(dones_a):
                ends[infos_a[row]["TimeLimit.truncated"]] += 1
    assert min(ends.values()) > 0, "episodes of both ends are compared"


def test_equals_dummy_vec_env_step_for_step(pair):
    assert_equal_runs(*pair, n_steps=50)


@pytest.mark.parametrize("place", ["dict", "tuple"])
def test_equals_dummy_vec_env_with_other_observation_spaces(place):
    grouped, single = GroupedSubprocVecEnv(functions(place=place), 1), DummyVecEnv(functions(place=place))
    try:
        assert_equal_runs(grouped, single, n_steps=10)
    finally:
        grouped.close()


@pytest.mark.parametrize("indices", [None, 3, [4, 0, 2], [-1, 1, 1]])
def test_attributes_and_methods_reach_the_environments_asked_for(pair, indices):
    for env in pair:
        env.set_options([{"start": row + 10} for row in range(N_ENVS)])
        env.reset()
    grouped, single = pair
    for env in pair:
        env.env_method("set_wrapper_attr", "mark", 5, force=True, indices=indices)
        env.set_attr("note", "seen", indices)
    assert grouped.get_attr("start", indices) == single.get_attr("start", indices)
    assert grouped.env_method("get_wrapper_attr", "start", indices=indices) == single.get_attr("start", indices)
    chosen = single._get_indices(indices)
    assert grouped.get_attr("note", indices) == ["seen"] * len(list(chosen))
    assert grouped.env_is_wrapped(Marked, indices) == single.env_is_wrapped(Marked, indices)
    assert grouped.env_is_wrapped(Monitor, indices) == single.env_is_wrapped(Monitor, indices)


def test_attribute_is_there_only_if_every_environment_has_it(pair):
    grouped, _ = pair
    grouped.set_attr("only_here", 1, indices=[0])
    assert (grouped.has_attr("start"), grouped.has_attr("only_here")) == (True, False)


def test_pictures_are_tiled_as_by_dummy_vec_env(pair):
    grouped, single = pair
    for env in pair:
        env.set_options([{"start": row + 10} for row in range(N_ENVS)])
        env.reset()
    np.testing.assert_array_equal(grouped.get_images(), single.get_images())
    np.testing.assert_array_equal(grouped.render(), single.render())
    assert (grouped.render_mode, grouped.metadata) == (single.render_mode, single.metadata)


@pytest.mark.parametrize(("row", "traceback_in_cause"), [(0, False), (4, True)], ids=["here", "in a worker"])
def test_error_in_an_environment_is_raised_here_and_leaves_the_workers_in_use(pair, row, traceback_in_cause):
    grouped, _ = pair
    grouped.set_options([{"start": 1 if other != row else -3} for other in range(N_ENVS)])
    with pytest.raises(ValueError, match="start=-3 is not accepted") as caught:
        grouped.reset()
    assert ("in reset" in str(caught.value.__cause__)) is traceback_in_cause
    grouped.set_options({"start": 3})
    assert len(grouped.reset()) == N_ENVS
    assert [info["start"] for info in grouped.reset_infos] == [3] * N_ENVS


def test_error_that_cannot_be_sent_is_raised_as_text(pair):
    with pytest.raises(RuntimeError, match=r"failed in worker 1:\n(.*\n)*.*Locked: a and b"):
        pair[0].env_method("fail", indices=[4])


def test_result_that_cannot_be_unpickled_is_an_error_and_the_next_one_is_right(pair):
    grouped, _ = pair
    with pytest.raises(RuntimeError, match="cannot be unpickled"):
        grouped.env_method("return_locked", indices=[4])
    assert len(grouped.reset()) == N_ENVS


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("name", ["send_bytes", "recv_bytes"])
def test_ctrl_c_during_a_message_leaves_the_environments_in_use(pair, monkeypatch, name, moment):
    grouped, _ = pair
    grouped.set_options({"start": 4})
    grouped.reset()
    original = getattr(Connection, name)

    def interrupted(connection, *args):
        if moment == "before":
            signal.raise_signal(signal.SIGINT)
        result = original(connection, *args)
        if moment == "after":
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(Connection, name, interrupted)
    with pytest.raises(KeyboardInterrupt):
        grouped.step(np.zeros(N_ENVS, dtype=int))
    monkeypatch.setattr(Connection, name, original)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert grouped.get_attr("start") == [4] * N_ENVS
    assert len(grouped.reset()) == N_ENVS
    assert grouped.get_attr("left") == [4] * N_ENVS


def raise_alarm(*_):
    raise TimeoutError("alarm")


@pytest.mark.parametrize("name", ["send_bytes", "recv_bytes"])
def test_any_other_exception_during_a_message_closes_the_environments(monkeypatch, name):
    env = GroupedSubprocVecEnv(functions(2), 1)
    env.reset()
    with monkeypatch.context() as patch:
        patch.setattr(worker, "SECONDS_TO_CLOSE", 0.1)
        patch.setattr(Connection, name, raise_alarm)
        with pytest.raises(TimeoutError, match="alarm"):
            env.step(np.zeros(2, dtype=int))
    with pytest.raises(RuntimeError, match="closed; make new ones"):
        env.step(np.zeros(2, dtype=int))
    assert [process.is_alive() for process in env.processes] == [False]


def test_waiting_without_a_step_is_refused(pair):
    grouped, _ = pair
    grouped.reset()
    with pytest.raises(RuntimeError, match="step_async was not called"):
        grouped.step_wait()


class OneKey(VecEnvWrapper):
    """Replaces the infos."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, _ = self.venv.step_wait()
        return observations, rewards, dones, [{"row": row} if row else {} for row in range(self.num_envs)]


def test_parts_of_any_kind_keep_their_infos_seeds_and_options():
    def part():
        return OneKey(VecMonitor(DummyVecEnv([Countdown, Countdown])))

    grouped, single = GroupedVecEnv([part, part]), part()
    try:
        for env in (grouped, single):
            env.seed(5)
            env.set_options([{"start": 3 + row} for row in range(env.num_envs)])
        alone, together = single.reset(), grouped.reset()
        np.testing.assert_array_equal(together[:2], alone)
        assert [info["start"] for info in grouped.reset_infos] == [3, 4, 5, 6]
        infos = grouped.step(np.zeros(4, dtype=int))[3]
        assert [{key: info[key] for key in info if key == "row"} for info in infos] == [{}, {"row": 1}] * 2
    finally:
        grouped.close()


def test_result_of_a_step_that_nobody_waited_for_is_dropped(pair):
    grouped, single = pair
    for env in pair:
        env.seed(0)
        env.set_options({"start": 4})
        env.reset()
    grouped.step_async(np.zeros(N_ENVS, dtype=int))
    assert grouped.get_attr("left") == [3] * N_ENVS
    single.step(np.zeros(N_ENVS, dtype=int))
    np.testing.assert_equal(grouped.step([0] * N_ENVS)[0], single.step([0] * N_ENVS)[0])


def test_step_that_is_interrupted_in_this_process_is_not_run_again(pair, monkeypatch):
    grouped, _ = pair
    grouped.set_options({"start": 4})
    grouped.reset()
    step = Countdown.step

    def interrupted(env, action):
        step(env, action)
        raise KeyboardInterrupt

    monkeypatch.setattr(Countdown, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        grouped.step(np.zeros(N_ENVS, dtype=int))
    monkeypatch.setattr(Countdown, "step", step)
    assert grouped.get_attr("left") == [3] * N_ENVS
    assert len(grouped.reset()) == N_ENVS


def test_worker_that_ends_by_itself_is_named_and_everything_is_closed():
    env = GroupedSubprocVecEnv(functions(), 2)
    env.reset()
    with pytest.raises(WorkerDiedError, match=r"worker 1 with environments 3 to 4 died \(exit code 7\)"):
        env.step(np.array([0, 0, 0, 0, 3]))
    assert [process.is_alive() for process in env.processes] == [False, False]
    with pytest.raises(RuntimeError, match="closed; make new ones"):
        env.reset()
    env.close()


def test_worker_that_is_killed_between_two_calls_is_named():
    env = GroupedSubprocVecEnv(functions(), 1)
    env.processes[0].kill()
    env.processes[0].join()
    with pytest.raises(WorkerDiedError, match=r"worker 0 with environments 2 to 4 died \(Killed\)"):
        env.reset()


def test_workers_are_ended_even_if_closing_fails_here(monkeypatch):
    env = GroupedSubprocVecEnv(functions(), 2)
    monkeypatch.setattr(Countdown, "close", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        env.close()
    assert [process.is_alive() for process in env.processes] == [False, False]


def test_close_during_a_step_closes_the_environments_and_ends_the_workers(tmp_path):
    env = GroupedSubprocVecEnv(functions(), 2)
    env.reset()
    for row in range(N_ENVS):
        env.env_method("touch_on_closing", tmp_path / str(row), indices=row)
    env.step_async(np.zeros(N_ENVS, dtype=int))
    env.close()
    assert [process.exitcode for process in env.processes] == [0, 0]
    assert len(list(tmp_path.iterdir())) == N_ENVS


SCRIPT = """
import gymnasium as gym, numpy as np
from sb3_progpolicy.vec_env import GroupedSubprocVecEnv

class Mine(gym.Wrapper):
    pass

# No __main__ guard: the workers must not run this script.
env = GroupedSubprocVecEnv([lambda: Mine(gym.make("CartPole-v1")) for _ in range(4)], 2)
env.reset()
try:
    print(*env.env_is_wrapped(Mine), flush=True)
    while True:
        env.step(np.zeros(4, dtype=int))
except KeyboardInterrupt:
    env.close()
    print("closed", *(process.exitcode for process in env.processes), flush=True)
"""


def test_script_without_main_guard_gets_ctrl_c_and_its_workers_do_not(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )
    assert process.stdout.readline().split() == ["True"] * 4
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert (process.returncode, out, err) == (0, "closed 0 0\n", "")


@pytest.mark.parametrize(("n_envs", "n_workers", "said"), [(0, 1, "at least one environment"), (2, 0, "n_workers=0")])
def test_no_environment_and_no_worker_are_refused(n_envs, n_workers, said):
    with pytest.raises(ValueError, match=said):
        GroupedSubprocVecEnv(functions(n_envs), n_workers)


def test_environment_that_cannot_be_made_is_an_error_here():
    with pytest.raises(gym.error.NameNotFound):
        GroupedSubprocVecEnv([lambda: gym.make("Nowhere-v0")] * 2, 2)


def test_environments_are_shared_evenly_and_no_worker_is_without_one(pair):
    pids = [os.getpid(), *(process.pid for process in pair[0].processes)]
    assert Counter(pair[0].get_attr("pid")) == dict(zip(pids, [1, 2, 2], strict=True))
    env = GroupedSubprocVecEnv(functions(3), 8)
    assert len(set(env.get_attr("pid"))) == 3
    assert len(env.processes) == 2
    env.close()
