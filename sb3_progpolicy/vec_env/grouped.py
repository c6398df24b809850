"""Vectorised environments whose parts run side by side, one in the calling process and the others in workers."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_progpolicy.vec_env.worker import Call, LocalPart, VenvFn, WorkerPart, interrupts_deferred

Part = LocalPart | WorkerPart
EnvFn = Callable[[], gym.Env[Any, Any]]


class GroupedVecEnv(VecEnv):
    """Joins several ``VecEnv``, the parts: the first runs in the calling process, each other one in a worker process.

    Make as many parts as there are cores. The calling process has a part of its own, because it would otherwise sleep
    during a step. All results are exactly those of the parts.

    The workers do not run the calling script again, so it needs no ``if __name__ == "__main__":``. Functions and
    classes that it defines reach the workers with ``venv_fns``. An id that it registers does not: let the function
    that makes the environment register it.

    If a worker process has died, the next call closes all environments and raises
    :class:`~sb3_progpolicy.vec_env.WorkerDiedError`.

    :param venv_fns: each makes one ``VecEnv``, all with the same spaces, in the process in which it will run. They are
        sent to the workers by cloudpickle
    :raises ValueError: if ``venv_fns`` is empty
    :raises Exception: whatever making an environment raises
    """

    def __init__(self, venv_fns: Sequence[VenvFn]) -> None:
        if not venv_fns:
            raise ValueError("venv_fns=[] is not accepted; at least one is needed")
        self._closed = False
        self._parts: list[Part] = []
        #: Which environments each part runs.
        self._shares: list[range] = []
        try:
            self._start(venv_fns)
            sizes, observation_spaces, action_spaces, metadata = zip(
                *self._call_all("describe", [()] * len(venv_fns)), strict=True
            )
            self._shares = [range(*pair) for pair in pairwise([0, *accumulate(sizes)])]
            for part, share in zip(self._parts, self._shares, strict=True):
                if isinstance(part, WorkerPart):
                    part.rows = share
            super().__init__(sum(sizes), observation_spaces[0], action_spaces[0])
        except BaseException:
            self.close()
            raise
        self.metadata = metadata[0]

    def _start(self, venv_fns: Sequence[VenvFn]) -> None:
        forks = "forkserver" in multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            # The server that all workers are forked from imports torch and SB3 once.
            context.set_forkserver_preload([__name__])
        self._parts.append(LocalPart(venv_fns[0]))
        for number, venv_fn in enumerate(venv_fns[1:]):
            self._parts.append(WorkerPart(context, number, venv_fn))

    @property
    def processes(self) -> list[Any]:
        """The worker processes."""
        return [part.process for part in self._parts if isinstance(part, WorkerPart)]

    def reset(self) -> VecEnvObs:
        """Reset every environment, with the seeds and options given since the last reset."""
        arguments = [(self._seeds[share.start], self._options[share.start : share.stop]) for share in self._shares]
        observations, infos = zip(*self._call_all("reset", arguments), strict=True)
        self.reset_infos = [info for part_infos in infos for info in part_infos]
        self._reset_seeds()
        self._reset_options()
        return _joined(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Send every worker the actions of its environments."""
        parts = zip(self._parts, self._shares, strict=True)
        self._send({part: ("step", (actions[share.start : share.stop],), {}) for part, share in parts})

    def step_wait(self) -> VecEnvStepReturn:
        """Step the environments of this process and wait for the workers."""
        if not all(part.pending for part in self._parts):
            raise RuntimeError("there is no step to wait for: step_async was not called, or another call came after it")
        observations, rewards, dones, infos, reset_infos = zip(*self._receive(self._parts), strict=True)
        for share, part_infos in zip(self._shares, reset_infos, strict=True):
            for row, info in part_infos.items():
                self.reset_infos[share.start + row] = info
        return (
            _joined(observations),
            np.concatenate(rewards),
            np.concatenate(dones),
            [info for part_infos in infos for info in part_infos],
        )

    def close(self) -> None:
        """Close the environments and end the workers, also during a step or after a worker has died."""
        if self._closed:
            return
        self._closed = True
        try:
            # The workers first: they close their environments while this process closes its own.
            for part in reversed(self._parts):
                part.close()
        finally:
            for part in self._parts:
                part.join()

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """Return one picture per environment, ``None`` where the render mode is not ``"rgb_array"``."""
        return [picture for pictures in self._call_all("get_images", [()] * len(self._parts)) for picture in pictures]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the environments asked for."""
        return self._call_rows("get_attr", indices, attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Return whether every environment has the attribute. Its value, which may be large, is not sent."""
        return all(self._call_all("has_attr", [(attr_name,)] * len(self._parts)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the environments asked for."""
        self._call_rows("set_attr", indices, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the environments asked for and return its results."""
        return self._call_rows("env_method", indices, method_name, *args, **kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return whether the environments asked for are wrapped in this class."""
        return self._call_rows("env_is_wrapped", indices, wrapper_class)

    def _call_rows(self, method: str, indices: VecEnvIndices, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of the parts for some environments; return one result for each, in the order of ``indices``."""
        # Python's own indexing gives negative indices their meaning and refuses those out of range.
        rows = [range(self.num_envs)[index] for index in self._get_indices(indices)]
        # The positions in ``rows`` that each part gives the results of.
        positions = {
            part: [position for position, row in enumerate(rows) if row in share]
            for part, share in zip(self._parts, self._shares, strict=True)
        }
        calls: dict[Part, Call] = {}
        for part, share in zip(self._parts, self._shares, strict=True):
            if positions[part]:
                indices = [rows[position] - share.start for position in positions[part]]
                calls[part] = method, args, {**kwargs, "indices": indices}
        self._send(calls)
        results: list[Any] = [None] * len(rows)
        for part, part_results in zip(calls, self._receive(calls), strict=True):
            for position, result in zip(positions[part], part_results or (), strict=part_results is not None):
                results[position] = result
        return results

    def _call_all(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Call a method of every part, each with arguments of its own."""
        self._send({part: (method, args, {}) for part, args in zip(self._parts, arguments, strict=True)})
        return self._receive(self._parts)

    def _send(self, calls: Mapping[Part, Call]) -> None:
        """Send parts a call each."""
        if self._closed:
            raise RuntimeError("the environments are closed; make new ones")
        for part in self._parts:
            if part.pending:  # nobody waited for the result, because of an interrupt or an error: drop it
                with contextlib.suppress(Exception):
                    self._receive([part])
        with self._whole_messages():
            for part, call in calls.items():
                part.send(call)

    def _receive(self, parts: Iterable[Part]) -> list[Any]:
        """Wait for the results of parts and return them, or raise the first error among them."""
        for part in parts:
            part.wait()
        with self._whole_messages():
            return [part.receive() for part in parts]

    @contextlib.contextmanager
    def _whole_messages(self) -> Iterator[None]:
        """Defer Ctrl-C to the end of the block; close everything if a connection cannot be used any more."""
        try:
            with interrupts_deferred():
                yield
        finally:
            if not all(part.usable for part in self._parts):
                self.close()


class GroupedSubprocVecEnv(GroupedVecEnv):
    """Runs ``n_envs`` environments in ``n_workers`` worker processes and the calling one, a share of them in each.

    SB3's ``SubprocVecEnv`` starts a process for every environment and exchanges a message with each of them at every
    step. With more environments than cores they wait for one another. Here there are as many processes as cores, with
    a ``DummyVecEnv`` in each, so all results are exactly those of ``DummyVecEnv(env_fns)``. For the rest see
    :class:`GroupedVecEnv`.

    :param env_fns: make one environment each
    :param n_workers: number of worker processes, at least 1; by default one for each core but that of the calling
        process. Fewer are started if there are not enough environments
    :raises ValueError: if there is no environment or no worker
    :raises Exception: whatever making an environment raises
    """

    def __init__(self, env_fns: Sequence[EnvFn], n_workers: int | None = None) -> None:
        if not env_fns:
            raise ValueError("env_fns=[] is not accepted; at least one environment is needed")
        if n_workers is not None and n_workers < 1:
            raise ValueError(f"n_workers={n_workers} is not accepted; it is at least 1")
        n_shares = 1 + (n_workers or max(1, usable_cores() - 1))
        shares = even_shares(len(env_fns), n_shares)
        super().__init__([partial(DummyVecEnv, list(env_fns[share.start : share.stop])) for share in shares])


def usable_cores() -> int:
    """Return how many cores this process may use, which may be fewer than there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def even_shares(n_envs: int, n_shares: int) -> list[range]:
    """Return which environments each of several processes runs, at least one each.

    :param n_envs: number of environments, at least 1
    :param n_shares: number of processes; fewer shares are returned if there are not enough environments
    """
    bounds = np.linspace(0, n_envs, min(n_shares, n_envs) + 1).astype(int).tolist()
    return [range(*pair) for pair in pairwise(bounds)]


def _joined(parts: Sequence[Any]) -> Any:
    """Return the parts' observations as one batch: an array, or a dict or tuple of arrays."""
    first = parts[0]
    if isinstance(first, dict):
        return type(first)((key, np.concatenate([part[key] for part in parts])) for key in first)
    if isinstance(first, tuple):
        return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return np.concatenate(parts)
