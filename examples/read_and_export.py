"""Read a program, write it in several formats, and run the exported file, which needs no torch and no NumPy."""

from __future__ import annotations

import argparse
import runpy
from pathlib import Path

import gymnasium as gym
import matplotlib

matplotlib.use("Agg")

import progpolicy_envs  # noqa: F401  registers Hanoi-v0
from sb3_progpolicy.programs import (
    Program,
    export_c,
    export_graphviz,
    export_latex,
    export_python,
    export_text,
    load_program,
    plot_program,
)

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("program", nargs="?", type=Path, help="a program.json for Hanoi-v0; without it, one is trained")
parser.add_argument("--timesteps", type=int, default=100_000, help="environment steps, if a program has to be trained")
parser.add_argument("--out", type=Path, default=Path("runs/export"), help="folder for the files")
arguments = parser.parse_args()


def get_program() -> Program:
    """Load the program given, or train one."""
    if arguments.program:
        return load_program(arguments.program)
    from sb3_progpolicy import ReptilePPO

    model = ReptilePPO("ProgPolicy", "Hanoi-v0", learning_rate=0.01, n_epochs=10, batch_size=512, seed=0, device="cpu")
    return model.learn(arguments.timesteps).program()


program = get_program()
out = arguments.out
out.mkdir(parents=True, exist_ok=True)

# A JSON file: no pickle, so that a file from a stranger can be opened.
program.save(out / "program.json")
assert load_program(out / "program.json") == program

# As text, as a picture, as Graphviz source, as LaTeX, as Python and as C; export_onnx writes a model for runtimes.
print(export_text(program))
plot_program(program).figure.savefig(out / "program.png", dpi=150, bbox_inches="tight")
export_graphviz(program, out / "program.dot")  # dot -Tsvg program.dot
(out / "program.tex").write_text(export_latex(program), encoding="utf-8")
export_python(program, out / "hanoi_program.py")
export_c(program, out / "hanoi_program.h")

# The Python file stands alone: copy it anywhere. It keeps the state of the conditions itself; tell it what happened.
policy = runpy.run_path(str(out / "hanoi_program.py"))["ProgramPolicy"]()
env = gym.make("Hanoi-v0", n_discs=3, render_mode="ansi")
observation, info = env.reset()
action, reward, ended, steps = None, 0.0, False, 0
while not ended:
    action = policy.act(observation.tolist(), action, reward, ended)
    observation, reward, terminated, truncated, info = env.step(action)
    ended, steps = terminated or truncated, steps + 1
print(env.render())
print(f"{'solved' if info['is_success'] else 'not solved'} after {steps} steps; files in {out}/")
