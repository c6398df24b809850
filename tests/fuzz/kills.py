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
from tests.test_resume import TIMESTEPS, assert_same_bits, make, parameters, start, train

STEPS = 4 * TIMESTEPS  # long enough for a kill at a random moment to come before the end
TRAIN = f"train(make('ProgPolicy'), Path({{0!r}}), timesteps={STEPS})"
RESUME = f"train(load_last_good({{0!r}}, ReptilePPO.load, env='Hanoi-v0'), Path({{0!r}}), timesteps={STEPS})"
MAX_TRIES = 10


@lru_cache
def uninterrupted() -> tuple[dict[str, Any], float]:
    """The parameters at the end of a training that nothing stopped, and its seconds."""
    th.set_num_threads(1)
    folder = Path(tempfile.mkdtemp())
    try:
        started = time.monotonic()
        return train(make("ProgPolicy"), folder / "model.zip", timesteps=STEPS), time.monotonic() - started
    finally:
        shutil.rmtree(folder)


def case(rng: np.random.Generator, folder: Path) -> str:
    """Kill a training after a random time past its first checkpoint, resume it, and compare the ends.

    A kill that comes after the end is made again, earlier.

    :raises AssertionError: if a parameter differs, or a half-written checkpoint cannot be loaded
    """
    (expected, seconds), path = uninterrupted(), folder / "model.zip"
    for _ in range(MAX_TRIES):
        shutil.rmtree(folder)
        folder.mkdir()
        killed = start(TRAIN.format(str(path)))
        while not path.is_file():
            assert killed.poll() is None, f"training ended with {killed.returncode} before its first checkpoint"
            time.sleep(0.005)
        time.sleep(float(rng.uniform(0, seconds)))
        killed.send_signal(signal.SIGKILL)
        killed.communicate()
        if not path.with_suffix(".final.zip").exists():
            break
    else:
        raise AssertionError(f"{MAX_TRIES} trainings ended within {seconds:.1f} s of their first checkpoint")
    resumed = start(RESUME.format(str(path)))
    resumed.communicate(timeout=120)
    assert resumed.returncode == 0, f"resuming ended with {resumed.returncode}"
    assert previous_of(path).exists()
    assert_same_bits(expected, parameters(path))
    return "killed and resumed"
