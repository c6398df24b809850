"""The parts of a :class:`~sb3_progpolicy.GroupedVecEnv`: one in the calling process, each other one in its own."""

from __future__ import annotations

import contextlib
import pickle
import signal
import struct
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any

import cloudpickle
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs

#: What came of a call: its result; an error and its traceback, or ``None`` for one of this process; words.
OK, RAISED, BROKEN = "ok", "raised", "broken"
SECONDS_TO_CLOSE = 5.0
#: Who waits looks for the message for so long before it goes to sleep; to be woken takes 0.1 to 0.3 ms.
SECONDS_AWAKE = 2e-3
#: Stands before every message: the number of the call.
_NUMBER = struct.Struct("Q")

VenvFn = Callable[[], VecEnv]
#: Name, arguments and keyword arguments of a method of a part.
Call = tuple[str, tuple[Any, ...], dict[str, Any]]


class Here:
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
            return OK, getattr(self._group, method)(*args, **kwargs)
        except Exception as error:
            return RAISED, (error, None)

    def close(self) -> None:
        """Close the environments."""
        if self._group is not None:
            self._group.venv.close()

    def join(self) -> None:
        """Do nothing; there is no process to wait for."""


class Worker:
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
        with uninterrupted():
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
            return BROKEN, f"its answer cannot be unpickled\n{traceback.format_exc()}"
        return kind, value

    def _take(self) -> bytes:
        self._remote.poll(None)
        with uninterrupted():
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
        self.process.join(SECONDS_TO_CLOSE)
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
                answer = _pickled((OK, getattr(group, method)(*args, **kwargs)))
            except Exception as error:
                answer = _pickled_error(error)
            remote.send_bytes(number + answer)
    if group is not None:
        group.venv.close()
    remote.close()


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
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
        pickled = cloudpickle.dumps((RAISED, (error, text)))
        cloudpickle.loads(pickled)  # an error with a constructor of its own may be pickled and then not be made again
    except Exception:
        return cloudpickle.dumps((BROKEN, text))
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
