"""Learn the Tower of Hanoi with 1-4 discs from scratch and solve 8: what ``make demo`` runs.

Settings: sb3_progpolicy/hyperparams/reptile_ppo.yml. The program, a drawing of it and a film go to ``runs/demo``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # pictures go to files; no window is needed

import gymnasium as gym
from matplotlib import pyplot as plt
from PIL import Image
from rich.console import Console
from rich.table import Table

from sb3_progpolicy import ReptilePPO, evaluate_program
from sb3_progpolicy.experiment.config import make_config
from sb3_progpolicy.experiment.run import build_model
from sb3_progpolicy.programs import Program, ProgramRunner, export_text, join_inputs, plot_program

ENV = "Hanoi-v0"
TRAINED_ON = 4
SIZES = range(1, 9)


def learn_program(timesteps: int | None, seed: int) -> Program:
    """Train on 1-4 discs and return the extracted program."""
    config = make_config("reptile_ppo", ENV, seed, timesteps, device="cpu")
    model, _ = build_model(config)
    assert isinstance(model, ReptilePPO)
    model.learn(config.n_timesteps, progress_bar=True)
    return model.program()


def results_table(program: Program) -> Table:
    """Run the program on 1-8 discs, both as a real if-then-else (crisp) and as the mixture it was trained as (soft)."""
    table = Table(title=f"Trained on 1-{TRAINED_ON} discs")
    for column in ("discs", "optimal steps", "crisp", "ratio", "soft", "ratio"):
        table.add_column(column, justify="right")
    variations = [{"n_discs": n_discs} for n_discs in SIZES]
    crisp, soft = (evaluate_program(program, ENV, variations, semantics=name) for name in ("crisp", "soft"))
    for n_discs, *results in zip(SIZES, crisp, soft, strict=True):
        optimum = 2**n_discs - 1
        cells = []
        for result in results:
            solved = result.success_rate == 1
            cells += [f"{result.steps_mean:.0f}", f"{result.steps_mean / optimum:.2f}"] if solved else ["failed", ""]
        unseen = n_discs > TRAINED_ON
        table.add_row(str(n_discs), str(optimum), *cells, style="bold" if unseen else None)
    return table


def save_film(program: Program, path: Path, n_discs: int) -> None:
    """Write an animated GIF of one episode."""
    env = gym.make(ENV, n_discs=n_discs, render_mode="rgb_array")
    runner = ProgramRunner(program)
    observation, _ = env.reset()
    action, reward, ended = None, 0.0, False
    frames = [env.render()]
    while not ended:
        action = runner.act(join_inputs(program, observation, action, reward, ended))
        observation, reward, terminated, truncated, _ = env.step(action[0])
        ended = terminated or truncated
        frames.append(env.render())
    env.close()
    first, *rest = [Image.fromarray(frame).convert("P", palette=Image.Palette.ADAPTIVE, colors=32) for frame in frames]
    first.save(path, save_all=True, append_images=[*rest, *[rest[-1]] * 8], duration=120, loop=0, optimize=True)


def main() -> None:
    """Train, print, evaluate, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--timesteps", type=int, help="environment steps; by default those of the settings file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/demo"), help="folder for the files")
    arguments = parser.parse_args()

    start = time.perf_counter()
    program = learn_program(arguments.timesteps, arguments.seed)
    seconds = time.perf_counter() - start

    console = Console()
    # export_text has brackets and numbers of its own, which rich would read as markup.
    console.print(export_text(program), markup=False, highlight=False, soft_wrap=True)
    console.print(results_table(program))

    arguments.out.mkdir(parents=True, exist_ok=True)
    program.save(arguments.out / "program.json")
    plot_program(program).figure.savefig(arguments.out / "program.png", dpi=150, bbox_inches="tight")
    plt.close("all")
    save_film(program, arguments.out / "hanoi.gif", n_discs=TRAINED_ON + 1)
    console.print(f"Trained in {seconds:.0f} s. Written to {arguments.out}/: program.json, program.png, hanoi.gif")


if __name__ == "__main__":
    main()
