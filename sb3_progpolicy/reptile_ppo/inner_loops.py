"""The inner loops of several tasks: one after another, in processes of this machine, or on a Ray cluster."""

from __future__ import annotations

import contextlib
import copy
import io
import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any, Literal, get_args

import cloudpickle
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from sb3_progpolicy.bounds import check_whole
from sb3_progpolicy.cluster import join_cluster
from sb3_progpolicy.nearest import unknown
from sb3_progpolicy.reptile.steps import Task
from sb3_progpolicy.reptile_ppo.theta import Theta
from sb3_progpolicy.vec_env.factory import simulations_in_this_process
from sb3_progpolicy.vec_env.grouped import usable_cores
from sb3_progpolicy.vec_env.worker import WorkerDiedError

if TYPE_CHECKING:
    from sb3_progpolicy.reptile_ppo.algorithm import ReptilePPO

EngineName = Literal["serial", "local", "ray"]
Begun = tuple[Task, np.random.Generator]  # what ``begin_task`` gives


@dataclass
class Learning:
    """What one call of ``learn`` keeps besides the model."""

    callback: BaseCallback
    log_interval: int | None = None
    inner_loops: InnerLoops | None = None
    n_rollouts: int = 0
    stopped: bool = False


def check_batch_arguments(meta_batch_size: int, engine: str) -> None:
    """Raise ``ValueError`` for a value that is not accepted or has no effect."""
    check_whole("meta_batch_size", meta_batch_size, 1)
    if engine not in get_args(EngineName):
        raise unknown("engine", engine, get_args(EngineName))
    if engine != "local" and meta_batch_size == 1:
        raise ValueError(f"engine={engine!r} has no effect with meta_batch_size=1; it runs the loops of several tasks")


class InnerLoops(ABC):
    """Makes the inner loops of the tasks of a meta-iteration. Each starts from the same theta.

    :param model: whose inner loops these are
    """

    def __init__(self, model: ReptilePPO) -> None:
        self.model = model

    @abstractmethod
    def run(self, theta: Theta, begun: Sequence[Begun]) -> list[Theta]:
        """Return the theta_hat of each task.

        :param theta: where each inner loop starts
        :param begun: the tasks, each with its source of randomness
        """


class SerialLoops(InnerLoops):
    """One after another, in the environments of the model, with one thread of torch, as in the other engines."""

    def run(self, theta: Theta, begun: Sequence[Begun]) -> list[Theta]:
        """Return the theta_hat of each task."""
        threads = th.get_num_threads()
        th.set_num_threads(1)
        try:
            return [self.model.inner_loop(theta, *task) for task in begun]
        finally:
            th.set_num_threads(threads)


@dataclass(frozen=True)
class _Result:
    """What an inner loop that was made elsewhere leaves behind: theta_hat, and what the log tells of it."""

    theta: Theta
    n_updates: int
    recorded: Sequence[tuple[int, float | None, float | None]]
    episodes: Sequence[dict[str, Any]]
    episode_successes: Sequence[Any]
    logged: dict[str, Any]

    def take_over(self, model: ReptilePPO) -> None:
        """Let a model's logs be as if it had made the inner loop."""
        model._n_updates += self.n_updates
        for index, success, episode_return in self.recorded:
            model.tasks.record(index, success, episode_return)
        assert model.ep_info_buffer is not None
        assert model.ep_success_buffer is not None
        model.ep_info_buffer.extend(self.episodes)
        model.ep_success_buffer.extend(self.episode_successes)
        for name, value in self.logged.items():
            model.logger.record(name, value)


class _Replica:
    """A copy of a model in another process.

    :param saved: the model, from :func:`_saved`
    """

    def __init__(self, saved: bytes) -> None:
        th.set_num_threads(1)
        algorithm, env, device, model = cloudpickle.loads(saved)
        with simulations_in_this_process():
            self.model: ReptilePPO = algorithm.load(
                io.BytesIO(model), env=env, device=device, allow_pickle=True, verbose=0
            )

    def run(self, job: bytes) -> bytes:
        """Make an inner loop.

        :param job: theta, task and source of randomness
        """
        theta, task, rng = cloudpickle.loads(job)
        model = self.model
        before = model._n_updates
        model.ep_info_buffer, model.ep_success_buffer = deque[Any](), deque[Any]()
        model.set_logger(Logger(folder=None, output_formats=[]))
        theta_hat = model.inner_loop(theta, task, rng)
        logged = {name: value for name, value in model.logger.name_to_value.items() if name != "train/n_updates"}
        result = _Result(
            theta_hat,
            model._n_updates - before,
            [] if model._statistics is None else model._statistics.recorded,
            list(model.ep_info_buffer),
            list(model.ep_success_buffer),
            logged,
        )
        return cloudpickle.dumps(result)


def _saved(model: ReptilePPO) -> bytes:
    """Return what a :class:`_Replica` is made of."""
    stream = io.BytesIO()
    model.save(stream, allow_pickle=True)
    return cloudpickle.dumps((type(model), model.env_id, str(model.device), stream.getvalue()))


class _RemoteLoops(InnerLoops):
    """In copies of the model, which are made once."""

    def run(self, theta: Theta, begun: Sequence[Begun]) -> list[Theta]:
        """Return the theta_hat of each task."""
        results = []
        for answer in self._map([cloudpickle.dumps((theta, *task)) for task in begun]):
            result: _Result = cloudpickle.loads(answer)
            result.take_over(self.model)
            results.append(result.theta)
        return results

    @abstractmethod
    def _map(self, jobs: Sequence[bytes]) -> list[bytes]:
        """Return a replica's answer to each job, in their order."""


class ProcessLoops(_RemoteLoops):
    """In processes of this machine, one core each.

    :param model: whose inner loops these are
    :param n_processes: how many
    """

    def __init__(self, model: ReptilePPO, n_processes: int) -> None:
        super().__init__(model)
        forks = "forkserver" in multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            context.set_forkserver_preload(["sb3_progpolicy.reptile_ppo"])
        self._pool = ProcessPoolExecutor(n_processes, context, initializer=_begin, initargs=(_saved(model),))

    def _map(self, jobs: Sequence[bytes]) -> list[bytes]:
        try:
            return list(self._pool.map(_run, jobs))
        except BrokenProcessPool as error:
            # Python before 3.11.5 waits forever if a process died before it had read its job (CPython issue 94777).
            queue: Any = getattr(self._pool, "_call_queue", None)
            if queue is not None:
                queue._reader.close()
            raise WorkerDiedError(
                "a process that makes inner loops has died, perhaps for lack of memory, or because its model could "
                "not be made; its error is above"
            ) from error

    def close(self) -> None:
        """End the processes, after what they are at."""
        self._pool.shutdown(cancel_futures=True)


_replica: _Replica  # of a process of ProcessLoops


def _begin(saved: bytes) -> None:
    """Make the model of a process of :class:`ProcessLoops`."""
    global _replica
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the training's
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _replica = _Replica(saved)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _run(job: bytes) -> bytes:
    return _replica.run(job)


class RayLoops(_RemoteLoops):
    """In actors of a Ray cluster, one core each: of the cluster that ``RAY_ADDRESS`` names, or one started here.

    A machine that is lost costs the inner loops that it was at; they are made again.

    :param model: whose inner loops these are
    :param n_actors: how many, at most; no more than the cluster has cores
    :raises ValueError: if Ray is not installed
    """

    def __init__(self, model: ReptilePPO, n_actors: int) -> None:
        super().__init__(model)
        self._ray, self._started = join_cluster()
        ray = self._ray
        from ray.util import ActorPool

        n_actors = max(1, min(n_actors, int(ray.cluster_resources().get("CPU", 1))))
        saved = ray.put(_saved(model))
        actor = ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=-1)(_Replica)
        self._pool: Any = ActorPool([actor.remote(saved) for _ in range(n_actors)])

    def _map(self, jobs: Sequence[bytes]) -> list[bytes]:
        try:
            return list(self._pool.map(lambda actor, job: actor.run.remote(job), list(jobs)))
        except self._ray.exceptions.RayError as error:
            raise WorkerDiedError(f"an actor of Ray cannot make inner loops: {error}") from error

    def close(self) -> None:
        """End the actors, and the cluster if it was started here."""
        while self._pool.has_free():
            self._ray.kill(self._pool.pop_idle())
        if self._started:
            self._ray.shutdown()


@contextlib.contextmanager
def open_inner_loops(model: ReptilePPO) -> Iterator[InnerLoops]:
    """Open what makes the inner loops of a model's meta-batches.

    :param model: whose ``engine`` and ``meta_batch_size`` say how
    :raises ValueError: if other processes cannot make the environments
    """
    if model.meta_batch_size == 1 or model.engine == "serial":
        yield SerialLoops(model)
        return
    if not model.env_by_id:
        raise ValueError(
            f"engine={model.engine!r} is not accepted for environments that are made already; its processes make them "
            "from an id. Give an environment id, or engine='serial'"
        )
    if model.engine == "local":
        loops: Any = ProcessLoops(model, min(model.meta_batch_size, usable_cores()))
    else:
        loops = RayLoops(model, model.meta_batch_size)
    with contextlib.closing(loops):
        yield loops


def mean_of(thetas: Sequence[Theta], theta: Theta) -> Theta:
    """Return the mean of the results of inner loops: of parameters, moments and statistics.

    :param thetas: each a theta_hat
    :param theta: from which they started; all their steps count
    """
    last = thetas[-1]
    optimizer = copy.deepcopy(last.optimizer)
    for index, moments in optimizer["state"].items():
        optimizer["state"][index] = _mean([result.optimizer["state"][index] for result in thetas], moments)
    scaler = copy.deepcopy(last.reward_scaler)
    if scaler is not None:
        scalers = [result.reward_scaler.statistics for result in thetas if result.reward_scaler is not None]
        for name in ("mean", "var", "count"):
            setattr(scaler.statistics, name, np.mean([getattr(statistics, name) for statistics in scalers], axis=0))
    return Theta(
        policy=_mean([result.policy for result in thetas], last.policy),
        optimizer=optimizer,
        reward_scaler=scaler,
        num_timesteps=theta.num_timesteps + sum(result.num_timesteps - theta.num_timesteps for result in thetas),
        total_timesteps=theta.total_timesteps,
    )


def _mean(states: Sequence[dict[str, Any]], last: dict[str, Any]) -> dict[str, Any]:
    """Return the mean of mappings from name to tensor; what is not of real numbers is the last one's."""
    mean = {}
    for name, value in last.items():
        real = isinstance(value, th.Tensor) and value.is_floating_point()
        mean[name] = th.stack([state[name] for state in states]).mean(0) if real else value
    return mean


def inner_updates_of_batch(model: Any, begun: Sequence[Begun], learning: Learning) -> None:
    """Let several inner loops start from theta and take over the mean of their results.

    :param model: a ReptilePPO
    :param begun: their tasks, each with its source of randomness
    :param learning: what its ``learn`` keeps
    """
    learning.callback.on_rollout_start()
    assert learning.inner_loops is not None
    theta = Theta.of(model)
    results = learning.inner_loops.run(theta, begun)
    mean_of(results, theta).put_into(model)
    for _ in range((model.num_timesteps - theta.num_timesteps) // model.n_envs):
        if not learning.callback.on_step():
            learning.stopped = True
            break
    learning.callback.on_rollout_end()
    before, learning.n_rollouts = learning.n_rollouts, learning.n_rollouts + len(begun) * model.inner_updates
    interval = learning.log_interval
    if interval is not None and learning.n_rollouts // interval > before // interval:
        model.dump_logs(learning.n_rollouts)
