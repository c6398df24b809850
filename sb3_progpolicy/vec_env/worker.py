"""The parts of a :class:`~sb3_progpolicy.GroupedVecEnv`: a ``VecEnv`` in the calling process or in a worker process."""

from __future__ import annotations

import contextlib
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any

import cloudpickle
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs

SECONDS_TO_CLOSE = 5.0

VenvFn = Callable[[], VecEnv]
#: Name, arguments and keyword arguments of a method of a part.
Call = tuple[str, tuple[Any, ...], dict[str, Any]]


class WorkerDiedError(RuntimeError):
    """A worker process has ended without being asked to: it crashed, or was killed, for example for lack of memory."""


class LocalPart:
    """A part in the calling process.

    :param venv_fn: makes the ``VecEnv``
    """

    usable = True

    def __init__(self, venv_fn: VenvFn) -> None:
        self._venv_fn = venv_fn
        self._env: _PartEnv | None = None
        self._call: Call | None = None
        self._result: Any = None

    @property
    def pending(self) -> bool:
        """Whether a call was sent that has not run."""
        return self._call is not None

    def send(self, call: Call) -> None:
        """Keep a call for :meth:`wait`."""
        self._call = call

    def wait(self) -> None:
        """Run the call, while the workers run theirs. An interrupted call is not run again."""
        assert self._call is not None
        (method, args, kwargs), self._call = self._call, None
        if self._env is None:
            self._env = _PartEnv(self._venv_fn())
        self._result = getattr(self._env, method)(*args, **kwargs)

    def receive(self) -> Any:
        """Return the result of the call."""
        return self._result

    def close(self) -> None:
        """Close the environments."""
        if self._env is not None:
            self._env.venv.close()

    def join(self) -> None:
        """Do nothing: there is no process to wait for."""


class WorkerPart:
    """A part in a process of its own.

    :param context: multiprocessing's, which starts the process
    :param number: of the worker, for its name
    :param venv_fn: makes the ``VecEnv``, in the worker
    """

    def __init__(self, context: Any, number: int, venv_fn: VenvFn) -> None:
        #: Whether a call was sent whose result has not been received.
        self.pending = False
        #: Whether messages can be exchanged: the worker has not died, and no exception has cut a message in two.
        self.usable = True
        #: The environments of this part, for the message of an error.
        self.rows: range | None = None
        self._connection, connection_of_worker = context.Pipe()
        self.process = context.Process(
            target=_work, args=(connection_of_worker, cloudpickle.dumps(venv_fn)), name=f"worker {number}", daemon=True
        )
        with _main_script_hidden():
            self.process.start()
        connection_of_worker.close()

    def send(self, call: Call) -> None:
        """Send a call.

        :raises WorkerDiedError: if the process has ended
        """
        # Arrays pickle several times faster than they cloudpickle; other arguments may come from the main script.
        message = (pickle if call[0] == "step" else cloudpickle).dumps(call)
        with self._whole_message():
            self._connection.send_bytes(message)
            self.pending = True

    def wait(self) -> None:
        """Wait until there is a result, or the process has ended."""
        self._connection.poll(None)

    def receive(self) -> Any:
        """Return the result of the call.

        :raises WorkerDiedError: if the process has ended
        :raises RuntimeError: if the result, or the error that the call raised, cannot be sent between processes
        :raises Exception: what the call raised, with the worker's traceback as its cause
        """
        with self._whole_message():
            message = self._connection.recv_bytes()
            self.pending = False
        try:
            result, error, text = pickle.loads(message)
        except Exception as reason:
            raise RuntimeError(f"the result of a call in {self.process.name} cannot be unpickled") from reason
        if not text:
            return result
        cause = RuntimeError(f"an environment failed in {self.process.name}:\n{text}")
        if error is None:
            raise cause
        raise error from cause

    @contextlib.contextmanager
    def _whole_message(self) -> Iterator[None]:
        """Leave the connection usable only if the block runs to its end."""
        self.usable = False
        try:
            yield
        except (EOFError, OSError):
            self.process.join(SECONDS_TO_CLOSE)
            if self.process.is_alive():
                raise  # something else, such as the TimeoutError of an alarm
            raise WorkerDiedError(self._death()) from None
        self.usable = True

    def _death(self) -> str:
        code = self.process.exitcode
        how = signal.strsignal(-code) if code < 0 else f"exit code {code}"
        rows = f" with environments {self.rows.start} to {self.rows.stop - 1}" if self.rows else ""
        return f"{self.process.name}{rows} died ({how}); all environments are closed, make new ones"

    def close(self) -> None:
        """Ask the process to end."""
        with contextlib.suppress(OSError):
            self._connection.send_bytes(pickle.dumps(("close", (), {})))
        # If the worker is in the middle of sending a result, this makes it stop.
        self._connection.close()

    def join(self) -> None:
        """Wait for the process to end; make it end if it takes too long."""
        self.process.join(SECONDS_TO_CLOSE)
        if self.process.is_alive():
            self.process.terminate()
            self.process.join()


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Keep Ctrl-C, and a request to terminate that a Python function handles, to the end of the block.

    So they cannot cut a message in two and make the connection useless. Only the main thread hears of signals.
    """
    handlers: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        known = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        handlers = {number: handler for number, handler in known.items() if callable(handler)}
    interrupted: list[int] = []
    try:
        for number in handlers:
            signal.signal(number, lambda caught, _: interrupted.append(caught))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for number in interrupted[:1]:
        signal.raise_signal(number)


class _PartEnv:
    """The ``VecEnv`` of a part, with the methods that a grouped environment calls; most are the ``VecEnv``'s own."""

    def __init__(self, venv: VecEnv) -> None:
        self.venv = venv

    def describe(self) -> tuple[int, Any, Any, Any]:
        """Return the number of environments, the spaces and the metadata."""
        venv = self.venv
        return venv.num_envs, venv.observation_space, venv.action_space, getattr(venv, "metadata", {})

    def reset(self, seed: int | None, options: list[dict[str, Any]]) -> tuple[VecEnvObs, list[dict[str, Any]]]:
        """Reset, the first environment with ``seed``, the next with ``seed + 1``; return observations and infos."""
        if seed is not None:
            self.venv.seed(seed)
        self.venv.set_options(options)
        return self.venv.reset(), self.venv.unwrapped.reset_infos

    def step(self, actions: NDArray[Any]) -> tuple[Any, ...]:
        """Step; return what SB3's ``step`` does and the reset infos of the episodes that begin, by row."""
        observations, rewards, dones, infos = self.venv.step(actions)
        reset_infos = {row: self.venv.unwrapped.reset_infos[row] for row in np.flatnonzero(dones).tolist()}
        return observations, rewards, dones, infos, reset_infos

    def __getattr__(self, name: str) -> Any:
        return getattr(self.venv, name)


def _work(connection: Connection, pickled_venv_fn: bytes) -> None:
    """Run the calls of the main process until it closes the connection."""
    # Ctrl-C reaches every process of a terminal. The main one decides what to do about it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    env: _PartEnv | None = None
    with contextlib.suppress(EOFError, OSError):
        while True:
            message = connection.recv_bytes()
            try:
                method, args, kwargs = pickle.loads(message)
                if method == "close":
                    break
                if env is None:
                    env = _PartEnv(cloudpickle.loads(pickled_venv_fn)())
                answer = _pickled_result(getattr(env, method)(*args, **kwargs))
            except Exception as error:
                answer = _pickled_error(error)
            connection.send_bytes(answer)
    if env is not None:
        env.venv.close()
    connection.close()


def _pickled_result(result: Any) -> bytes:
    try:
        return pickle.dumps((result, None, ""), -1)  # several times faster, and enough for arrays and plain data
    except Exception:
        return cloudpickle.dumps((result, None, ""))


def _pickled_error(error: Exception) -> bytes:
    text = traceback.format_exc()
    try:
        pickled = cloudpickle.dumps((None, error, text))
        cloudpickle.loads(pickled)  # some errors can be pickled but not unpickled
    except Exception:
        return cloudpickle.dumps((None, None, text))
    return pickled


@contextlib.contextmanager
def _main_script_hidden() -> Iterator[None]:
    """A process that is started within the block does not import the calling script."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
