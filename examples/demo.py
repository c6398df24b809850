"""Learn the Tower of Hanoi with 1-4 discs from scratch, solve 12, and say why: what ``make demo`` runs.

Settings: sb3_progpolicy/hyperparams/reptile_ppo.yml. The program as it was learnt is simplified to the fewest whole
numbers that make the same decisions on 1-4 discs, and run from all pegs to all pegs with up to 12. Both programs, a
drawing, a page to step through, the certificate and a film go to ``runs/demo``.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # pictures go to files; no window is needed

import gymnasium as gym
from matplotlib import pyplot as plt
from PIL import Image
from rich.console import Console
from rich.table import Table

from sb3_progpolicy import ReptilePPO, Verification, evaluate_program, simplify, verify
from sb3_progpolicy.analysis.verify import certificate
from sb3_progpolicy.experiment.config import make_config
from sb3_progpolicy.experiment.run import build_model
from sb3_progpolicy.pages import export_html
from sb3_progpolicy.programs import Program, ProgramRunner, export_text, join_inputs, plot_program

ENV = "Hanoi-v0"
TRAINED_ON = 4
SIZES = range(1, 9)
CERTIFIED = range(1, 13)


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


def certificate_table(rows: list[Verification]) -> Table:
    """Show from how many pairs of pegs the goal is reached, and from how many in the fewest steps."""
    table = Table(title="The simplified program, from every peg to every other")
    for column in ("discs", "starts", "solved", "optimal"):
        table.add_column(column, justify="right")
    for row in rows:
        unseen = row.variation["n_discs"] > TRAINED_ON
        cells = (row.variation["n_discs"], row.starts, row.solved, row.optimal)
        table.add_row(*map(str, cells), style="bold" if unseen else None)
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

    found = simplify(program, time_limit=3)
    small = found.program
    console.print(f"{found.terms_before} numbers, of which {found.terms_after} terms make the same decisions:\n")
    console.print(export_text(small, max_terms=None), markup=False, highlight=False, soft_wrap=True)
    rows = verify(small, ENV, [{"n_discs": n_discs} for n_discs in CERTIFIED])
    console.print(certificate_table(rows))

    arguments.out.mkdir(parents=True, exist_ok=True)
    program.save(arguments.out / "program.json")
    small.save(arguments.out / "simplified.json")
    written = certificate(small, ENV, rows, "python examples/demo.py")
    (arguments.out / "certificate.json").write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")
    export_html(small, arguments.out / "hanoi.html")
    plot_program(small).figure.savefig(arguments.out / "program.png", dpi=150, bbox_inches="tight")
    plt.close("all")
    save_film(program, arguments.out / "hanoi.gif", n_discs=TRAINED_ON + 1)
    console.print(
        f"Trained in {seconds:.0f} s. Written to {arguments.out}/: program.json, simplified.json, certificate.json, "
        f"program.png, hanoi.gif. A page to step through: {arguments.out / 'hanoi.html'}"
    )


if __name__ == "__main__":
    main()
