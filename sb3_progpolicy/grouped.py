"""Many simulations in few processes: each steps its share of the environments, one message per worker and step."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import struct
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

#: Stands before every message: the number of the call.
_NUMBER = struct.Struct("Q")
_OK, _RAISED, _BROKEN = "ok", "raised", "broken"
_SECONDS_TO_CLOSE = 5.0
#: Who waits looks for the message for so long before it goes to sleep; to be woken takes 0.1 to 0.3 ms.
_SECONDS_AWAKE = 2e-3

EnvFn = Callable[[], gym.Env[Any, Any]]
VenvFn = Callable[[], VecEnv]
#: Name, arguments and keyword arguments of a method of :class:`_Group`.
Call = tuple[str, tuple[Any, ...], dict[str, Any]]


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
        self._parties: list[_Here | _Worker] = []
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
        seconds = _SECONDS_AWAKE if watchful else 0.0
        self._parties.append(_Here(venv_fns[0]))
        for number, venv_fn in enumerate(venv_fns[1:]):
            self._parties.append(_Worker(context, number, venv_fn, seconds))

    @property
    def processes(self) -> list[Any]:
        """The processes of the workers."""
        return [party.process for party in self._parties if isinstance(party, _Worker)]

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
            if kind == _RAISED:
                error, text = value
                raise error from (RemoteTraceback(text) if text else error.__cause__)
            if kind == _BROKEN:
                raise RuntimeError(f"an environment failed in its worker:\n{value}")
        return [value for _, value in answers]

    def _death(self, party: int) -> RuntimeError:
        """Close everything and return the error that says which worker has died."""
        worker = self._parties[party]
        assert isinstance(worker, _Worker)
        worker.process.join(_SECONDS_TO_CLOSE)
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


class _Here:
    """The part that runs in the calling process; it works while that waits for the answer.

    :param venv_fn: makes it
    """

    def __init__(self, venv_fn: VenvFn) -> None:
        self._venv_fn = venv_fn
        self._group: _Group | None = None
        self._asked: Call | None = None

    def send(self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Take note of a call; one that nobody waited for is made now, as a worker has made it too."""
        if self._asked is not None:
            self.receive()
        self._asked = method, args, kwargs

    def receive(self) -> tuple[str, Any]:
        """Make the call and return its result or error; an interrupted call is not made again."""
        assert self._asked is not None
        (method, args, kwargs), self._asked = self._asked, None
        try:
            if self._group is None:
                self._group = _Group(self._venv_fn())
            return _OK, getattr(self._group, method)(*args, **kwargs)
        except Exception as error:
            return _RAISED, (error, None)

    def close(self) -> None:
        """Close the environments."""
        if self._group is not None:
            self._group.venv.close()

    def join(self) -> None:
        """Do nothing; there is no process to wait for."""


class _Worker:
    """A process with one part, and the connection to it.

    Calls and answers are numbered, so that an answer nobody waited for is known as such. An interrupt finds messages
    sent and taken whole or not at all.

    :param context: of multiprocessing
    :param number: of the worker
    :param venv_fn: makes the part
    :param seconds_awake: how long it and this process look for a message before they sleep until one comes
    """

    def __init__(self, context: Any, number: int, venv_fn: VenvFn, seconds_awake: float) -> None:
        self.number, self._seconds_awake = number, seconds_awake
        self._n_calls = self._n_answered = 0
        self._remote, remote_of_worker = context.Pipe()
        self.process = context.Process(
            target=_work,
            args=(remote_of_worker, cloudpickle.dumps(venv_fn), seconds_awake),
            name=f"worker-{number}",
            daemon=True,
        )
        with _main_script_hidden():
            self.process.start()
        remote_of_worker.close()

    def send(self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Send a call."""
        while self._n_answered < self._n_calls:  # to a call that was interrupted
            self._take()
        # Actions are an array, for which pickle is several times faster; other arguments may come from the main script.
        dumps = pickle.dumps if method == "step" else cloudpickle.dumps
        message = dumps((method, args, kwargs))
        with _uninterrupted():
            self._remote.send_bytes(_NUMBER.pack(self._n_calls + 1) + message)
            self._n_calls += 1

    def receive(self) -> tuple[str, Any]:
        """Wait for the answer to the last call."""
        _watch(self._remote, self._seconds_awake)
        message = self._take()
        while self._n_answered < self._n_calls:
            message = self._take()
        try:
            kind, value = pickle.loads(message[_NUMBER.size :])
        except Exception:
            return _BROKEN, f"its answer cannot be unpickled\n{traceback.format_exc()}"
        return kind, value

    def _take(self) -> bytes:
        self._remote.poll(None)
        with _uninterrupted():
            message = self._remote.recv_bytes()
            self._n_answered = _NUMBER.unpack_from(message)[0]
        return message

    def close(self) -> None:
        """Ask the process to end."""
        with contextlib.suppress(OSError):
            self._remote.send_bytes(_NUMBER.pack(self._n_calls + 1) + pickle.dumps(("close", (), {})))
        # A worker that is still sending an answer is freed by this; nobody will read it.
        self._remote.close()

    def join(self) -> None:
        """Wait for the end of the process, or put an end to it."""
        self.process.join(_SECONDS_TO_CLOSE)
        if self.process.is_alive():
            self.process.terminate()
            self.process.join()


class _Uncopied(list[dict[str, Any]]):
    """The infos of a ``DummyVecEnv`` that pickles them next: the copies it would make of them are saved."""

    def __deepcopy__(self, memo: dict[int, Any]) -> _Uncopied:
        return self


class _Group:
    """The part of one process.

    :param venv: the part
    """

    def __init__(self, venv: VecEnv) -> None:
        self.venv = venv
        # DummyVecEnv puts this into every info; alone it says nothing.
        self.plain_info = {"TimeLimit.truncated": False} if isinstance(venv.unwrapped, DummyVecEnv) else {}

    def start(self) -> tuple[tuple[Any, Any, Any], int, dict[str, Any]]:
        """Return what the main process has to know."""
        spaces_and_metadata = self.venv.observation_space, self.venv.action_space, getattr(self.venv, "metadata", {})
        return spaces_and_metadata, self.venv.num_envs, self.plain_info

    def reset(self, seeds: list[int | None], options: list[dict[str, Any]]) -> tuple[VecEnvObs, list[dict[str, Any]]]:
        """Reset with seeds and options, one for each environment."""
        # Wrappers have these attributes too, and do not look at them.
        inner = self.venv.unwrapped
        inner._seeds, inner._options = seeds, options
        return self.venv.reset(), inner.reset_infos

    def step(self, actions: NDArray[Any]) -> tuple[Any, ...]:
        """Step; return infos and reset infos by row, only where they say something new."""
        observations, rewards, dones, infos = self.venv.step(actions)
        plain = self.plain_info
        some = {row: info for row, info in enumerate(infos) if len(info) > len(plain) or info != plain}
        resets = {row: self.venv.unwrapped.reset_infos[row] for row in np.flatnonzero(dones).tolist()}
        return observations, rewards, dones, some, resets

    def has_attr(self, name: str) -> bool:
        """Return whether every environment has the attribute."""
        return self.venv.has_attr(name)

    def get_images(self) -> list[Any]:
        """Return one picture per environment."""
        return list(self.venv.get_images())

    def __getattr__(self, name: str) -> Any:
        return getattr(self.venv, name)


def _work(remote: Connection, pickled_venv_fn: bytes, seconds_awake: float) -> None:
    """Answer the main process until it closes the connection."""
    # Ctrl-C reaches all processes of a terminal; the main one decides what becomes of it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    group: _Group | None = None
    with contextlib.suppress(EOFError, OSError):
        while True:
            _watch(remote, seconds_awake)
            message = remote.recv_bytes()
            number = message[: _NUMBER.size]
            try:
                method, args, kwargs = pickle.loads(message[_NUMBER.size :])
                if method == "close":
                    break
                if group is None:
                    group = _Group(cloudpickle.loads(pickled_venv_fn)())
                    if isinstance(group.venv, DummyVecEnv):
                        group.venv.buf_infos = _Uncopied(group.venv.buf_infos)
                answer = _pickled((_OK, getattr(group, method)(*args, **kwargs)))
            except Exception as error:
                answer = _pickled_error(error)
            remote.send_bytes(number + answer)
    if group is not None:
        group.venv.close()
    remote.close()


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Put Ctrl-C and a request to terminate off to the end of the block; only the main thread knows interrupts."""
    put_off: list[tuple[int, Any]] = []
    handlers: dict[int, Any] = {}
    try:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if callable(handler := signal.getsignal(number)):
                    handlers[number] = handler
                    signal.signal(number, lambda *arguments: put_off.append(arguments))
        yield
    finally:
        for restored, handler in handlers.items():
            signal.signal(restored, handler)
    for interrupt, frame in put_off:
        handlers[interrupt](interrupt, frame)


def _watch(remote: Connection, seconds: float) -> None:
    """Look for a message for so long, without going to sleep."""
    end = time.perf_counter() + seconds
    while time.perf_counter() < end and not remote.poll():
        pass


def _pickled(answer: Any) -> bytes:
    try:
        return pickle.dumps(answer, -1)  # several times faster, and nearly all answers are arrays and plain data
    except Exception:
        return cloudpickle.dumps(answer)


def _pickled_error(error: Exception) -> bytes:
    text = traceback.format_exc()
    try:
        pickled = cloudpickle.dumps((_RAISED, (error, text)))
        cloudpickle.loads(pickled)  # an error with a constructor of its own may be pickled and then not be made again
    except Exception:
        return cloudpickle.dumps((_BROKEN, text))
    return pickled


@contextlib.contextmanager
def _main_script_hidden() -> Iterator[None]:
    """Start a process that does not import the calling script, which it would do only to unpickle what we send."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _joined(parts: Sequence[Any]) -> Any:
    """Return the workers' observations as one batch: arrays, or a dict or tuple of arrays."""
    first = parts[0]
    if isinstance(first, dict):
        return type(first)((key, np.concatenate([part[key] for part in parts])) for key in first)
    if isinstance(first, tuple):
        return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return np.concatenate(parts)
