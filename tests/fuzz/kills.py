"""Training that is killed at a random moment and resumed: it ends with the same bits as training that is not."""

from __future__ import annotations

import shutil
import signal
import tempfile
import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_progpolicy.reptile.checkpoint import previous_of
from tests.test_resume import assert_same_bits, make, parameters, start, train

TRAIN = "train(make('ProgPolicy'), Path({0!r}))"
RESUME = "train(load_last_good({0!r}, ReptilePPO.load, env='Hanoi-v0'), Path({0!r}))"


@lru_cache
def uninterrupted() -> dict[str, Any]:
    """The parameters at the end of a training that nothing stopped."""
    th.set_num_threads(1)
    folder = Path(tempfile.mkdtemp())
    try:
        return train(make("ProgPolicy"), folder / "model.zip")
    finally:
        shutil.rmtree(folder)


def case(rng: np.random.Generator, folder: Path) -> str:
    """Kill a training after a random time past its first checkpoint, resume it, and compare the ends.

    :raises AssertionError: if a parameter differs, or a half-written checkpoint cannot be loaded
    """
    expected, path = uninterrupted(), folder / "model.zip"
    process = start(TRAIN.format(str(path)))
    while not path.is_file():
        assert process.poll() is None, f"training ended with {process.returncode} before its first checkpoint"
        time.sleep(0.005)
    time.sleep(float(rng.uniform(0, 1)))
    process.send_signal(signal.SIGKILL)
    process.communicate()
    outcome = "killed after its end" if path.with_suffix(".final.zip").exists() else "killed and resumed"
    if outcome == "killed and resumed":
        resumed = start(RESUME.format(str(path)))
        resumed.communicate(timeout=120)
        assert resumed.returncode == 0, f"resuming ended with {resumed.returncode}"
        assert previous_of(path).exists()
    assert_same_bits(expected, parameters(path))
    return outcome
