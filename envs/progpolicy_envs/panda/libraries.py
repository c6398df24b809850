"""PyBullet and Gymnasium-Robotics, imported without what they print; their one place of import."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

__all__ = ["GoalEnv", "pybullet", "pybullet_data"]


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Discard what is written to stdout and stderr, by C libraries too."""
    with open(os.devnull, "w") as nowhere, contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(nowhere))
        stack.enter_context(contextlib.redirect_stderr(nowhere))
        for stream in (1, 2):
            try:
                kept = os.dup(stream)
            except OSError:  # closed, as in a daemon
                continue
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, stream)
            os.dup2(nowhere.fileno(), stream)
        yield


with _silence():
    try:
        import pybullet
        import pybullet_data
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'The Panda environments need PyBullet: pip install "sb3-progpolicy[panda]". There are no wheels of it for '
            "Python 3.12 and later; there pip compiles it, which takes a C++ compiler and some minutes.",
            name=error.name,
        ) from None
    from gymnasium_robotics.core import GoalEnv
