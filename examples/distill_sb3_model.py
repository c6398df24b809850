"""Turn a network that Stable-Baselines3 has trained into a program that a person can read, and export it to Python.

    python examples/distill_sb3_model.py [--env CartPole-v1] [--timesteps 60000] [--states 20000]

With the extra ``box2d`` of Gymnasium also ``--env LunarLander-v3 --timesteps 500000``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch as th
from stable_baselines3 import PPO

from sb3_progpolicy import compare_with_teacher, imitate
from sb3_progpolicy.programs import export_python

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--env", default="CartPole-v1", help="environment id")
parser.add_argument("--timesteps", type=int, default=60_000, help="to train the network")
parser.add_argument("--states", type=int, default=20_000, help="that it labels")
parser.add_argument("--episodes", type=int, help="that programs are compared by while one is looked for")
parser.add_argument("--out", type=Path, default=Path("policy.py"), help="file of the exported program")
arguments = parser.parse_args()
th.set_num_threads(1)

teacher = PPO("MlpPolicy", arguments.env, seed=0, n_steps=256, device="cpu").learn(arguments.timesteps)
program = imitate(teacher, arguments.env, n_timesteps=arguments.states, n_episodes=arguments.episodes)
print(program)
result = compare_with_teacher(teacher, program, arguments.env, n_episodes=20)
print(f"Return: network {result.teacher['return']:.1f}, program {result.program['return']:.1f}")
print(f"{1 - result.distance:.1%} of the actions are the same." if program.action.kind == "discrete" else "")
export_python(program, arguments.out)
print(f"Wrote {arguments.out}, which needs neither torch nor NumPy")
