"""Memory does not grow with the number of episodes."""

import gc
import os
from pathlib import Path

import gymnasium as gym
import pytest

from progpolicy_envs import DOMAINS

STATM = Path("/proc/self/statm")
N_RESETS = 1000
ALLOWED_BYTES = 2**20  # 1 kB for each reset would be seen


def resident_bytes() -> int:
    gc.collect()
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not STATM.exists(), reason="reads the resident memory from /proc, which this system lacks")
@pytest.mark.parametrize("domain", DOMAINS.values(), ids=lambda domain: domain.id)
def test_memory_is_flat_over_a_thousand_resets(domain) -> None:
    env = gym.make(domain.id)
    variations = [*domain.train, *domain.validation, *domain.unseen]

    def resets(number: int) -> None:
        for seed in range(number):
            env.reset(seed=seed, options=variations[seed % len(variations)])
            env.step(env.action_space.sample())

    # What is computed once for each map and size, and what the allocator keeps, is there after the first resets.
    resets(3 * len(variations) + 200)
    before = resident_bytes()
    resets(N_RESETS)
    assert resident_bytes() - before < ALLOWED_BYTES
    env.close()
