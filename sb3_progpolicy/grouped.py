"""Many simulations in few processes: each steps its share of the environments, one message per worker and step."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_progpolicy.worker import BROKEN, RAISED, SECONDS_AWAKE, SECONDS_TO_CLOSE, Call, Here, VenvFn, Worker

EnvFn = Callable[[], gym.Env[Any, Any]]


class RemoteTraceback(Exception):
    """The traceback in the worker, as the cause of an error that is raised again in this process."""

    def __str__(self) -> str:
        """Return the text."""
        return "\n" + str(self.args[0])


class GroupedVecEnv(VecEnv):
    """Joins several ``VecEnv`` that run side by side: one in the calling process, each other one in its own.

    With as many as there are cores none is idle. The calling process has a share, because it would else sleep during a
    step and have to be woken. All results are exactly those of the parts; those that carry no news, such as empty
    infos, are not sent.

    The workers do not run the calling script again, which therefore needs no ``if __name__ == "__main__":`` block.
    What the environments need from it must be reached from ``venv_fns``: an id that the script registers is unknown in
    the workers unless the function registers it.

    :param venv_fns: make one ``VecEnv`` each, all with the same spaces; they are called where it will run, and sent to
        the workers by cloudpickle. The calling process takes the first
    :raises ValueError: if there is none, or whatever making an environment raises
    """

    def __init__(self, venv_fns: Sequence[VenvFn]) -> None:
        if not venv_fns:
            raise ValueError("venv_fns=[] is not accepted; at least one is needed")
        self._closed = False
        self._shares: list[range] = []
        self._asked: list[int] = []
        self._parties: list[Here | Worker] = []
        try:
            # More processes than cores leave none free for looking whether a message has come.
            self._start(venv_fns, watchful=len(venv_fns) <= usable_cores())
            (first, *_), sizes, self._plain_infos = zip(*self._ask_all("start", [()] * len(venv_fns)), strict=True)
            observation_space, action_space, metadata = first
            bounds = [0, *accumulate(sizes)]
            self._shares = [range(*pair) for pair in pairwise(bounds)]
            super().__init__(bounds[-1], observation_space, action_space)
        except BaseException:
            self.close()
            raise
        self.metadata = metadata

    def _start(self, venv_fns: Sequence[VenvFn], watchful: bool) -> None:
        forks = "forkserver" in multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            # Torch and SB3 are imported once, by the server that all workers are forked from.
            context.set_forkserver_preload([__name__])
        seconds = SECONDS_AWAKE if watchful else 0.0
        self._parties.append(Here(venv_fns[0]))
        for number, venv_fn in enumerate(venv_fns[1:]):
            self._parties.append(Worker(context, number, venv_fn, seconds))

    @property
    def processes(self) -> list[Any]:
        """The processes of the workers."""
        return [party.process for party in self._parties if isinstance(party, Worker)]

    def reset(self) -> VecEnvObs:
        """Reset every environment, with the seeds and options given since the last reset."""
        arguments = [
            ([self._seeds[row] for row in share], [self._options[row] for row in share]) for share in self._shares
        ]
        answers = self._ask_all("reset", arguments)
        self.reset_infos = [info for _, infos in answers for info in infos]
        self._reset_seeds()
        self._reset_options()
        return _joined([observations for observations, _ in answers])

    def step_async(self, actions: NDArray[Any]) -> None:
        """Send every worker the actions of its environments."""
        self._ask(
            {party: ("step", (actions[share.start : share.stop],), {}) for party, share in enumerate(self._shares)}
        )

    def step_wait(self) -> VecEnvStepReturn:
        """Step the environments of this process and wait for the workers."""
        if len(self._asked) < len(self._parties):
            raise RuntimeError("there is no step to wait for: step_async was not called, or another call came after it")
        observations, rewards, dones, sent_infos, sent_reset_infos = zip(*self._answers(), strict=True)
        infos: list[dict[str, Any]] = []
        for share, plain, some, resets in zip(
            self._shares, self._plain_infos, sent_infos, sent_reset_infos, strict=True
        ):
            infos += [some.get(row, dict(plain)) for row in range(len(share))]
            for row, info in resets.items():
                self.reset_infos[share.start + row] = info
        return _joined(observations), np.concatenate(rewards), np.concatenate(dones), infos

    def close(self) -> None:
        """Close the environments and end the workers, also in the middle of a step or after a worker has died."""
        if self._closed:
            return
        self._closed = True
        try:
            for party in reversed(self._parties):  # the workers, before this process is busy with its own environments
                party.close()
        finally:
            for party in self._parties:
                party.join()

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """Return one picture per environment, ``None`` where the render mode is not ``"rgb_array"``."""
        return self._in_order("get_images", range(self.num_envs), per_row=False)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the environments asked for."""
        return self._in_order("get_attr", self._rows(indices), attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Return whether every environment has the attribute; its value stays in the workers."""
        return all(self._ask_all("has_attr", [(attr_name,)] * len(self._shares)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the environments asked for."""
        self._in_order("set_attr", self._rows(indices), attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the environments asked for; return its results."""
        return self._in_order("env_method", self._rows(indices), method_name, *args, **kwargs)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return whether the environments asked for are wrapped in this class."""
        return self._in_order("env_is_wrapped", self._rows(indices), wrapper_class)

    def _rows(self, indices: VecEnvIndices) -> list[int]:
        # Python's own indexing gives negative indices their meaning, and refuses those out of range.
        return [range(self.num_envs)[index] for index in self._get_indices(indices)]

    def _in_order(self, method: str, rows: Sequence[int], *args: Any, per_row: bool = True, **kwargs: Any) -> list[Any]:
        """Call a method of the parts, return its results in the order of ``rows``."""
        calls: dict[int, Call] = {}
        asked: list[list[int]] = []
        for party, share in enumerate(self._shares):
            mine = [row for row in rows if row in share]
            if mine:
                asked.append(mine)
                indices = {"indices": [row - share.start for row in mine]} if per_row else {}
                calls[party] = method, args, {**kwargs, **indices}
        self._ask(calls)
        answers = self._answers()
        # A row asked for twice has its results in the order in which they were asked for.
        results = [iter(answer or [None] * len(mine)) for answer, mine in zip(answers, asked, strict=True)]
        owner = {row: result for mine, result in zip(asked, results, strict=True) for row in mine}
        return [next(owner[row]) for row in rows]

    def _ask_all(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        self._ask({party: (method, args, {}) for party, args in enumerate(arguments)})
        return self._answers()

    def _ask(self, calls: Mapping[int, Call]) -> None:
        """Send each part its call; the answers to earlier calls that nobody waited for are dropped."""
        if self._closed:
            raise RuntimeError("the environments are closed; make new ones")
        self._asked = []
        for party, call in calls.items():
            try:
                self._parties[party].send(*call)
            except OSError:
                raise self._death(party) from None
        self._asked = list(calls)

    def _answers(self) -> list[Any]:
        """Receive the answers to the last calls; raise the first error among them when all are in."""
        asked, self._asked = self._asked, []
        answers = []
        for party in asked:
            try:
                answers.append(self._parties[party].receive())
            except (EOFError, OSError):
                raise self._death(party) from None
        for kind, value in answers:
            if kind == RAISED:
                error, text = value
                raise error from (RemoteTraceback(text) if text else error.__cause__)
            if kind == BROKEN:
                raise RuntimeError(f"an environment failed in its worker:\n{value}")
        return [value for _, value in answers]

    def _death(self, party: int) -> RuntimeError:
        """Close everything and return the error that says which worker has died."""
        worker = self._parties[party]
        assert isinstance(worker, Worker)
        worker.process.join(SECONDS_TO_CLOSE)
        self.close()
        share = self._shares[party] if self._shares else None
        what = f"which ran environments {share.start} to {share.stop - 1}, " if share else ""
        return RuntimeError(
            f"worker {worker.number}, {what}has died with exit code {worker.process.exitcode}; "
            "the environments are closed"
        )


class GroupedSubprocVecEnv(GroupedVecEnv):
    """Runs ``n_envs`` environments in ``n_workers`` processes and the calling one, a share of them in each.

    SB3's ``SubprocVecEnv`` starts a process for every environment and exchanges a message with each of them at every
    step; with more environments than cores they wait for one another. Here there are as many processes as cores. Each
    holds a ``DummyVecEnv``, so all results are exactly those of ``DummyVecEnv(env_fns)``. For the rest see
    :class:`GroupedVecEnv`.

    :param env_fns: make one environment each
    :param n_workers: number of processes that are started, at least 1; by default one for each core but that of the
        calling process. More than can have an environment are not started
    :raises ValueError: if there is no environment or no worker, or whatever making an environment raises
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
    """Return which environments each of several processes takes, none of them none.

    :param n_envs: number of environments, at least 1
    :param n_shares: number of processes
    """
    bounds = np.linspace(0, n_envs, min(n_shares, n_envs) + 1).astype(int).tolist()
    return [range(*pair) for pair in pairwise(bounds)]


def _joined(parts: Sequence[Any]) -> Any:
    """Return the workers' observations as one batch: arrays, or a dict or tuple of arrays."""
    first = parts[0]
    if isinstance(first, dict):
        return type(first)((key, np.concatenate([part[key] for part in parts])) for key in first)
    if isinstance(first, tuple):
        return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return np.concatenate(parts)
