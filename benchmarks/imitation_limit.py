"""How far a program could come that imitates HikingEgo's planner, if it had any shape and all data there is.

    python benchmarks/imitation_limit.py [--starts 20000] [--episodes 300]

The planner knows the whole map, the program sees a window of it. Where no star is in sight, the planner's action is not
a function of the window. The best that imitation can learn there is the action that is most often right, one for each
window of the training maps, learned by heart from many starts with one star. This student does so, and does what the
planner does wherever it sees a star. A program that has only labels to learn from can hardly reach more.

Writes ``benchmarks/results/imitation_limit.csv`` and a ``.json`` with command, commit and versions.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from rich.progress import track
from study import commit, write_results

from progpolicy_envs import find_domain
from sb3_progpolicy.imitation import make_teacher

ENV_ID = "HikingEgo-v0"
COLUMNS = ("n_stars", "episodes", "success_rate", "starts", "out_of_sight", "agrees", "commit")
EVALUATION_SEED = 500_000


def main() -> None:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=20_000, help="starts with one star that are learned by heart")
    parser.add_argument("--episodes", type=int, default=300, help="episodes with each number of stars")
    options = parser.parse_args()
    domain = find_domain(ENV_ID)
    assert domain is not None
    env: Any = gym.make(ENV_ID)
    teacher: Any = make_teacher("planner", env)

    def right() -> np.ndarray:
        return np.asarray(teacher.good_actions([env.unwrapped.state])[0])

    votes: dict[bytes, np.ndarray] = {}
    n_hidden = 0
    for seed in track(range(options.starts), "Starts"):
        seen, _ = env.reset(seed=seed, options=dict(domain.train[0]))
        if not (seen == 1).any():
            n_hidden += 1
            votes[seen.tobytes()] = votes.get(seen.tobytes(), np.zeros(4)) + right()
    agrees = sum(float(vote.max()) for vote in votes.values()) / n_hidden
    rows = []
    for variation in domain.train:
        n_successes = 0
        for episode in track(range(options.episodes), f"{variation['n_stars']} stars"):
            seen, _ = env.reset(seed=EVALUATION_SEED + episode, options=dict(variation))
            ended = False
            while not ended:
                by_heart = None if (seen == 1).any() else votes.get(seen.tobytes())
                seen, _, terminated, truncated, info = env.step(
                    int(np.argmax(right() if by_heart is None else by_heart))
                )
                ended = terminated or truncated
            n_successes += bool(info["is_success"])
        rows.append(
            {
                "n_stars": variation["n_stars"],
                "episodes": options.episodes,
                "success_rate": round(n_successes / options.episodes, 4),
                "starts": options.starts,
                "out_of_sight": round(n_hidden / options.starts, 4),
                "agrees": round(agrees, 4),
                "commit": commit(),
            }
        )
    write_results("imitation_limit", COLUMNS, rows, {})
    for row in rows:
        print(f"{row['n_stars']} stars: {row['success_rate']:.1%}")


if __name__ == "__main__":
    main()
