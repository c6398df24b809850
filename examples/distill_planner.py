"""Turn a scripted controller into one program, here that of a robot that pushes blocks.

python examples/distill_planner.py [--env PandaPush-v0] [--timesteps 30000]
"""

from __future__ import annotations

import argparse

import torch as th

from sb3_progpolicy import compare_with_teacher, imitate

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--env", default="PandaPush-v0", help="id of a domain with a planner")
parser.add_argument("--timesteps", type=int, default=30_000, help="states to label")
parser.add_argument("--max-conditions", type=int, default=11, help="of the program at most")
arguments = parser.parse_args()
th.set_num_threads(1)

program = imitate(
    "planner",
    arguments.env,
    n_timesteps=arguments.timesteps,
    max_conditions=arguments.max_conditions,
    callback=lambda so_far: print(f"round {so_far.round} of {so_far.n_rounds}: {so_far.result}"),
)
print(program)
result = compare_with_teacher("planner", program, arguments.env, n_episodes=12)
for name, of_teacher in result.teacher.items():
    print(f"{name}: planner {of_teacher:.2f}, program {result.program[name]:.2f}")
