"""Learn a program for the Tower of Hanoi, read it, and run it on more discs than it was trained on."""

from __future__ import annotations

import argparse

from sb3_progpolicy import ReptilePPO, evaluate_program

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--timesteps", type=int, default=400_000, help="environment steps of the training")
arguments = parser.parse_args()

# For an id of this package, the tasks are the domain's training variations: 1, 2, 3 and 4 discs, any source and target
# peg. 32 environments are built in one batch. `depth` bounds the length: depth 3 offers programs of 0, 1 and 2
# conditions, and the search decides between them.
model = ReptilePPO(
    "ProgPolicy",
    "Hanoi-v0",
    learning_rate=0.01,
    batch_size=512,
    n_epochs=10,
    meta_learning_rate=0.5,
    search_fraction=0.3,
    length_coef=0.05,
    policy_kwargs={"depth": 3, "condition_size": 2},
    seed=0,
    device="cpu",
)
model.learn(arguments.timesteps, progress_bar=True)

# The most likely program as plain data. Printing it prints the if-then-else.
program = model.program()
print(program)

# 5 to 7 discs were never seen in training. An episode that fails counts as 500 steps, the cap.
for result in evaluate_program(program, "Hanoi-v0", [{"n_discs": n_discs} for n_discs in (3, 5, 6, 7)]):
    print(result.variation, "steps:", result.steps_mean, "optimum:", result.optimal_steps_mean)
