"""Print how the hand-written programs do: ``python -m tests.handwritten``.

``--only planning`` and ``--only panda`` run one half. The Panda programs are held against the scripted controllers, on
the same seeds; ``--output`` writes their table in Markdown.
"""

import argparse
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import gymnasium as gym

from progpolicy_envs import get_domain
from sb3_progpolicy.programs.files import write_atomically
from tests.handwritten.evaluate import play, play_batch, play_plan, size_of
from tests.handwritten.hanoi import hanoi_program
from tests.handwritten.hiking import egocentric_program, map_program
from tests.handwritten.panda import PROGRAMS
from tests.handwritten.stacking import stacking_program

PACKAGES = ("gymnasium", "pybullet", "numpy")


def planning(n_seeds: int) -> None:
    """Print one line per planning domain and set of variations."""
    print(f"seeds 0 to {n_seeds - 1} of every variation; ratio = all steps / all of the planner's steps\n")
    print(f"{'domain':<26}{'branches':>9}{'set':>8}{'success':>9}{'steps':>8}{'planner':>9}{'ratio':>7}")
    for program in (hanoi_program(), map_program(), egocentric_program(), stacking_program()):
        domain = get_domain(program.metadata["env"])
        for part, variations in (("train", domain.train), ("validation", domain.validation), ("unseen", domain.unseen)):
            episodes = [
                episode for variation in variations for episode in play_batch(program, domain.id, n_seeds, **variation)
            ]
            success = sum(episode.success for episode in episodes) / len(episodes)
            steps, optimal = (sum(getattr(e, what) for e in episodes) / len(episodes) for what in ("steps", "optimal"))
            print(
                f"{domain.id:<26}{size_of(program)[1]:>9}{part:>8}{success:>9.1%}{steps:>8.2f}{optimal:>9.2f}"
                f"{steps / optimal:>7.3f}"
            )


def panda(n_seeds: int, sizes: list[int]) -> list[str]:
    """Print and return one row per Panda task and number of objects; a size is unseen above the training sizes."""
    rows = [
        "| Task | Branches | Objects | Set | Solved | Scripted | Steps | Scripted | Most | Ratio |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    print(*rows, sep="\n")
    for env_id, make_program in PROGRAMS.items():
        program, domain = make_program(), get_domain(env_id)
        env = gym.make(env_id)
        for size in sizes:
            variation = {domain.size: size}
            part = next(name for name in ("train", "validation", "unseen") if variation in getattr(domain, name))
            ours = [play(program, env, seed, **variation) for seed in range(n_seeds)]
            scripted = [play_plan(env, seed, **variation) for seed in range(n_seeds)]
            both = [(a.steps, b.steps) for a, b in zip(ours, scripted, strict=True) if a.success and b.success]
            comparison = "- | - | - | -"
            if both:
                steps, scripted_steps = (sum(column) / len(both) for column in zip(*both, strict=True))
                most = max(steps for steps, _ in both)
                comparison = f"{steps:.1f} | {scripted_steps:.1f} | {most} | {steps / scripted_steps:.3f}"
            rows.append(
                f"| {env_id} | {size_of(program)[1]} | {size} | {part} | {sum(e.success for e in ours)}/{n_seeds} "
                f"| {sum(e.success for e in scripted)}/{n_seeds} | {comparison} |"
            )
            print(rows[-1], flush=True)
        env.close()
    return rows


def provenance(n_seeds: int, sizes: list[int], output: Path) -> str:
    """Return command, commit and versions as the first lines of a table."""
    numbers = " ".join(map(str, sizes))
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True).stdout
    versions = ", ".join([f"Python {platform.python_version()}", *(f"{name} {version(name)}" for name in PACKAGES)])
    return (
        f"`python -m tests.handwritten --only panda --panda-seeds {n_seeds} --sizes {numbers} --output {output}`\n\n"
        f"Commit {commit.strip()}; {versions}.\n\n"
        "The hand-written programs against the scripted controllers on the same seeds, from 0, within 500 steps. "
        "Steps are means over the episodes that both solve, and so is the ratio; the most steps are the program's.\n\n"
    )


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.handwritten", description=__doc__)
    parser.add_argument("--only", choices=("planning", "panda"), help="run one half")
    parser.add_argument("--seeds", type=int, default=100, help="seeds of each planning variation")
    parser.add_argument("--panda-seeds", type=int, default=20, help="seeds of each number of objects")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 3, 5, 8], help="numbers of objects")
    parser.add_argument("--output", type=Path, help="where to write the Panda table")
    arguments = parser.parse_args()
    if arguments.only != "panda":
        planning(arguments.seeds)
        print()
    if arguments.only != "planning":
        rows = panda(arguments.panda_seeds, arguments.sizes)
        if arguments.output:
            header = provenance(arguments.panda_seeds, arguments.sizes, arguments.output)
            write_atomically(arguments.output, header + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
