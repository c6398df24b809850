"""Inner loops of several tasks at once: the same outcome wherever they are made."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.env_util import make_vec_env

from sb3_progpolicy import ReptileCheckpoint, ReptilePPO, make_fast_vec_env
from sb3_progpolicy.reptile_ppo import Theta
from sb3_progpolicy.reptile_ppo.inner_loops import ProcessLoops, mean_of
from sb3_progpolicy.vec_env.worker import WorkerDiedError

ROLLOUT = 4 * 16


def make(policy="ProgPolicy", env="Hanoi-v0", **kwargs):
    arguments = {"n_envs": 4} if isinstance(env, str) else {}
    arguments |= {"n_steps": 16, "batch_size": 32, "n_epochs": 2, "seed": 0, "device": "cpu", "inner_updates": 3}
    arguments |= {"meta_batch_size": 3, "engine": "serial"} | kwargs
    return ReptilePPO(policy, env, **arguments)


def assert_same(a, b):
    assert a.num_timesteps == b.num_timesteps
    assert a._n_updates == b._n_updates
    for (name, mine), other in zip(a.policy.named_parameters(), b.policy.parameters(), strict=True):
        assert th.equal(mine, other), name
    moments = [model.policy.optimizer.state_dict()["state"] for model in (a, b)]
    assert moments[0].keys() == moments[1].keys()
    for index, state in moments[0].items():
        assert all(th.equal(value, moments[1][index][name]) for name, value in state.items())
    np.testing.assert_array_equal(a.tasks.success_rates, b.tasks.success_rates)
    assert [episode["l"] for episode in a.ep_info_buffer] == [episode["l"] for episode in b.ep_info_buffer]


@pytest.mark.parametrize(("engine", "policy", "arguments"), [
    pytest.param("ray", "ProgPolicy", {}, marks=pytest.mark.slow),
    ("local", "ProgPolicy", {"normalize_observations": True, "scale_rewards": True, "meta_optimizer": "adam"}),
    ("local", "MlpPolicy", {"search_fraction": 0.0}),
])  # fmt: skip
def test_engines_give_what_one_process_gives(engine, policy, arguments):
    if engine == "ray":
        pytest.importorskip("ray")
    serial, parallel = make(policy, **arguments), make(policy, engine=engine, **arguments)
    for model in (serial, parallel):
        model.learn(ROLLOUT * 3 * 3 * 3)
    assert serial.num_timesteps == ROLLOUT * 27
    assert serial.meta_iteration == 3
    assert_same(serial, parallel)


def test_theta_moves_towards_the_mean_of_the_results():
    model = make(normalize_observations=True, scale_rewards=True, meta_learning_rate=0.25)
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    results = []

    class Listen(BaseCallback):
        def _on_rollout_start(self):
            run = self.model_loops.run
            self.model_loops.run = lambda *given: results.extend(run(*given)) or results

        def _on_training_start(self):
            self.model_loops = self.locals["inner_loops"]

        def _on_step(self):
            return True

    model.learn(ROLLOUT * 3 * 3, callback=Listen())
    assert len(results) == 3
    assert len({result.policy["features_extractor.count"].item() for result in results}) == 1
    names = [name for name, _ in model.policy.named_parameters()]
    for name, was, now in zip(names, before, model.policy.parameters(), strict=True):
        mean = th.stack([result.policy[name] for result in results]).mean(0)
        th.testing.assert_close(now.detach(), was + 0.25 * (mean - was))
    assert any(not th.equal(results[0].policy[name], results[1].policy[name]) for name in names)
    scale = np.mean([result.reward_scaler.statistics.var for result in results])
    assert model.reward_scaler.statistics.var == pytest.approx(scale)


def test_mean_of_one_is_itself():
    model = make(scale_rewards=True)
    model.learn(ROLLOUT * 9)
    theta = Theta.of(model)
    mean = mean_of([theta], theta)
    assert all(th.equal(mean.policy[name], tensor) for name, tensor in theta.policy.items())
    assert mean.optimizer["state"].keys() == theta.optimizer["state"].keys()
    assert mean.num_timesteps == theta.num_timesteps


def test_callbacks_hear_of_every_step_once_and_can_stop():
    class Count(BaseCallback):
        rollouts, stop_at = 0, None

        def _on_rollout_start(self):
            self.rollouts += 1

        def _on_step(self):
            return self.n_calls != self.stop_at

    count = Count()
    model = make().learn(ROLLOUT * 3 * 3 * 2, callback=count)
    assert count.rollouts == 2
    assert count.n_calls == 16 * 3 * 3 * 2 == model.num_timesteps // 4
    count = Count()
    count.stop_at = 5
    assert make().learn(ROLLOUT * 3 * 3 * 9, callback=count).num_timesteps == ROLLOUT * 9


def test_checkpoint_goes_on_to_the_same_end(tmp_path):
    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < ROLLOUT * 9 * 2

    whole = make().learn(ROLLOUT * 9 * 4)
    stopped = make()
    stopped.learn(ROLLOUT * 9 * 4, callback=CallbackList([ReptileCheckpoint(tmp_path / "model.zip"), Stop()]))
    model = ReptilePPO.load(tmp_path / "model.zip", env="Hanoi-v0", engine="local", device="cpu")
    assert model.num_timesteps == ROLLOUT * 9
    assert model.meta_batch_size == 3
    model.learn(ROLLOUT * 9 * 4 - model.num_timesteps, reset_num_timesteps=False)
    for mine, other in zip(model.policy.parameters(), whole.policy.parameters(), strict=True):
        assert th.equal(mine, other)


def test_without_a_seed_the_loops_differ_and_so_do_two_trainings():
    models = [make(seed=None).learn(ROLLOUT * 9) for _ in range(2)]
    assert not all(map(th.equal, *(model.policy.parameters() for model in models)))


def test_more_tasks_are_learnt_from_at_once():
    model = make(n_envs=8, n_steps=64, batch_size=128, inner_updates=4, n_epochs=10, tasks={"n_discs": [1]})
    model.learn(20_000)
    assert model.tasks.success_rates[0] > 0.9


@pytest.mark.parametrize(("arguments", "message"), [
    ({"meta_batch_size": 0}, "meta_batch_size=0 is not accepted; it is a whole number of at least 1"),
    ({"engine": "thread"}, "engine.*thread.*serial, local, ray"),
    ({"engine": "ray", "meta_batch_size": 1}, "has no effect with meta_batch_size=1"),
])  # fmt: skip
def test_arguments_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_other_processes_cannot_have_environments_that_are_made_already():
    env = make_fast_vec_env("Hanoi-v0", 4)
    with pytest.raises(ValueError, match=r"made already.*engine='serial'"):
        make(env=env, engine="local").learn(ROLLOUT)
    make(env=make_vec_env("Hanoi-v0", 2)).learn(ROLLOUT)
    model = make(engine="local")
    model.set_env(env)
    with pytest.raises(ValueError, match="made already"):
        model.learn(ROLLOUT)


def test_a_process_that_dies_is_named():
    class Kill(BaseCallback):
        def _on_rollout_start(self):
            for pid in self.locals["inner_loops"]._pool._processes or ():
                os.kill(pid, signal.SIGKILL)

        def _on_step(self):
            return True

    with pytest.raises(WorkerDiedError, match="has died"):
        make(engine="local").learn(ROLLOUT * 90, callback=Kill())


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="stops a process")
def test_a_process_that_dies_before_it_has_read_its_job_is_named_and_waited_for_no_longer():
    loops = ProcessLoops(make(engine="local"), 1)
    pid = loops._pool.submit(os.getpid).result()
    os.kill(pid, signal.SIGSTOP)
    threading.Timer(1.0, os.kill, (pid, signal.SIGKILL)).start()
    with pytest.raises(WorkerDiedError, match="has died"):
        loops._map([bytes(5_000_000)] * 2)  # far more than a pipe holds
    closing = threading.Thread(target=loops.close, daemon=True)
    closing.start()
    closing.join(timeout=60)
    assert not closing.is_alive()


@pytest.mark.skipif(not os.path.isdir("/proc"), reason="looks for processes in /proc")
def test_processes_end_with_the_training_that_is_killed(tmp_path):
    code = (
        "from sb3_progpolicy import ReptilePPO\n"
        "from stable_baselines3.common.callbacks import BaseCallback\n"
        "class Say(BaseCallback):\n"
        "    def _on_rollout_end(self): print(*self.locals['inner_loops']._pool._processes, flush=True)\n"
        "    def _on_step(self): return True\n"
        "if __name__ == '__main__':\n"
        "    model = ReptilePPO('ProgPolicy', 'Hanoi-v0', n_envs=4, n_steps=16, meta_batch_size=2)\n"
        "    model.learn(10**7, callback=Say())\n"
    )
    script = tmp_path / "train.py"
    script.write_text(code)
    process = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    pids = [int(pid) for pid in process.stdout.readline().split()]
    assert pids
    process.kill()
    process.wait()
    end = time.monotonic() + 20
    while any(os.path.exists(f"/proc/{pid}") for pid in pids) and time.monotonic() < end:
        time.sleep(0.1)
    assert not [pid for pid in pids if os.path.exists(f"/proc/{pid}")]
