"""Runs the cases of a fuzzer, each from a seed of its own, and counts how they end."""

from __future__ import annotations

import resource
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

SECONDS = 120.0  # of one case; far more than any needs
MEGABYTES = 1024  # by which the memory of the process may grow


@dataclass(frozen=True)
class Fuzzer:
    """A kind of case.

    :param case: plays one case in an empty folder and returns the name of its outcome; raises what is a fault
    :param cases: cases of a long run
    :param short: cases of a run in the test suite
    """

    case: Callable[[np.random.Generator, Path], str]
    cases: int
    short: int


def run(fuzzer: Fuzzer, cases: int, seed: int) -> Counter[str]:
    """Play cases and count their outcomes.

    :raises AssertionError: naming the first case that fails, takes more than two minutes or a gigabyte
    """
    outcomes: Counter[str] = Counter()
    before = _peak_megabytes()
    for number in range(cases):
        rng = np.random.default_rng([seed, number])
        try:
            with TemporaryDirectory() as folder, _time_limit():
                outcomes[fuzzer.case(rng, Path(folder))] += 1
            grown = _peak_megabytes() - before
            assert grown < MEGABYTES, f"the process grew by {grown} MB"
        except Exception as error:
            raise AssertionError(f"case {number} of seed {seed}: {type(error).__name__}: {error}") from error
    return outcomes


@contextmanager
def _time_limit() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError(f"more than {SECONDS:g} seconds")

    previous = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)


def _peak_megabytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak // (1024 if sys.platform != "darwin" else 1024**2)
