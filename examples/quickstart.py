"""Learn a program for the Tower of Hanoi, read it, and run it on more discs than it was trained on."""

from __future__ import annotations

import argparse

from sb3_progpolicy import ReptilePPO, evaluate_program

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=400_000, help="environment steps of the training")
arguments = parser.parse_args()

# For an id of this package, the tasks are the domain's training variations: 1, 2, 3 and 4 discs, any source and target
# peg, and the environments are built as one batch. Programs of 0, 1 and 2 conditions are searched; policy_kwargs with
# another `depth` searches more or fewer.
model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=128, n_steps=32, gamma=0.95, ent_coef=0.03, seed=0, device="cpu")
model.learn(arguments.timesteps, progress_bar=True)

# The most likely program as plain data. Printing it prints the if-then-else.
program = model.program()
print(program)

# 5 to 7 discs were never seen in training. An episode that fails counts as 500 steps, the cap.
for result in evaluate_program(program, "Hanoi-v0", [{"n_discs": n_discs} for n_discs in (3, 5, 6, 7)]):
    print(result.variation, "steps:", result.steps_mean, "optimum:", result.optimal_steps_mean)
