"""Steps per second of the Panda tasks: against panda-gym, against their own bare physics, eight objects against one.

    python benchmarks/panda_speed.py [--blocks 4] [--rounds 9]

Random actions, one environment, one core. A block is a reset, not timed, and 50 steps, which is panda-gym's episode.
Seconds are of processor time, and in every round each candidate runs its blocks one after the other, so that a busy
machine slows all of them alike; the table shows medians over the rounds, of the ratios too.

The batch is eight simulations with one object in the batched form, in which training runs them in each process; its
steps are counted one by one.

The bare physics are the same blocks once more with nothing but the calls that go into the physics, recorded before:
nearly all of them ``stepSimulation``, then the motor commands, and now and then a finer time step or a body put to
sleep. The arm and the objects move as with the environment, to the last bit.
panda-gym's Stack has two blocks, so there ours has two as well. Its step is 1/25 s, ours 1/30 s.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

import gymnasium as gym
import pybullet

from progpolicy_envs import DOMAINS, Domain

STEPS, BATCH = 50, 8
TASKS = [domain for domain in DOMAINS.values() if domain.simulation]
#: Blocks that panda-gym's tasks have; those not named have one object.
PEER_BLOCKS = {"PandaStack-v3": 2}
MISSING = (
    "panda-gym is not installed, so its columns are empty; it is in the extra `peers`: "
    'pip install "sb3-progpolicy[peers]", or panda-gym alone'
)
#: What goes into the physics, as opposed to what is read from them.
PHYSICS_CALLS = ("stepSimulation", "setJointMotorControlArray", "setPhysicsEngineParameter", "changeDynamics")
Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]
AnyEnv = gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]
#: Runs a block and returns the seconds of its reset and of its steps.
Block = Callable[[int], tuple[float, float]]


def block_runner(env: AnyEnv) -> Block:
    """Return a runner of seeded blocks with random actions."""
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(STEPS)]

    def run(seed: int) -> tuple[float, float]:
        start = time.process_time()
        env.reset(seed=seed)
        reset = time.process_time()
        for action in actions:
            env.step(action)
        return reset - start, time.process_time() - reset

    return run


def ours(task: Domain, size: int) -> gym.Env[Any, Any]:
    """Return one of our environments without Gymnasium's checks."""
    return made(task.id, **{task.size: size})


def made(env_id: str, **arguments: Any) -> gym.Env[Any, Any]:
    """Make an environment; panda-gym's have the same names as ours and version 3, which Gymnasium takes for newer."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return gym.make(env_id, disable_env_checker=True, **arguments)


def batch(task: Domain) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Return several of our environments with one object each in their batched form."""
    return gym.make_vec(task.id, num_envs=BATCH, vectorization_mode="vector_entry_point")


def physics_runner(env: AnyEnv) -> Block:
    """Return a runner of the same blocks as :func:`block_runner`'s in which only the physics are computed."""
    worlds = [single.scene for single in getattr(env.unwrapped, "envs", [env.unwrapped])]
    run = block_runner(env)
    calls: dict[int, list[Call]] = {}
    ends: dict[int, Any] = {}

    def replay(seed: int) -> tuple[float, float]:
        if seed not in calls:
            recorded, in_reset = record(env, seed, run)
            calls[seed] = recorded[in_reset:]
            ends[seed] = [(world.robot.position, world.positions) for world in worlds]
        env.reset(seed=seed)
        start = time.process_time()
        for function, args, kwargs in calls[seed]:
            function(*args, **kwargs)
        seconds = time.process_time() - start
        for world in worlds:
            world.read()
        if [(world.robot.position, world.positions) for world in worlds] != ends[seed]:
            raise RuntimeError(f"the bare physics went another way than {env} from seed {seed}")
        return 0.0, seconds

    return replay


def record(env: AnyEnv, seed: int, run: Block) -> tuple[list[Call], int]:
    """Run a block; return the calls that went into the physics, and how many of them the reset made."""
    calls: list[Call] = []
    functions = {name: getattr(pybullet, name) for name in PHYSICS_CALLS}

    def recording(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> None:
            calls.append((function, args, kwargs))
            function(*args, **kwargs)

        return call

    try:
        for name, function in functions.items():
            setattr(pybullet, name, recording(function))
        env.reset(seed=seed)
        in_reset = len(calls)
        calls.clear()
        run(seed)
    finally:
        for name, function in functions.items():
            setattr(pybullet, name, function)
    return calls, in_reset


def panda_gym_is_installed() -> bool:
    """Import panda-gym, which registers its ids; return whether that was possible."""
    try:
        import panda_gym  # noqa: F401
    except ImportError:
        return False
    return True


def measure(runners: dict[str, Block], blocks: int, rounds: int) -> dict[str, list[tuple[float, float]]]:
    """Return for each candidate the seconds per reset and per step of each round."""
    for run in runners.values():
        for seed in range(blocks):
            run(seed)
    measured: dict[str, list[tuple[float, float]]] = {name: [] for name in runners}
    for _ in range(rounds):
        for name, run in runners.items():
            resets, steps = zip(*(run(seed) for seed in range(blocks)), strict=True)
            measured[name].append((sum(resets) / blocks, sum(steps) / blocks / STEPS))
    return measured


def ratio(numerators: Sequence[tuple[float, float]], denominators: Sequence[tuple[float, float]]) -> float:
    """Return the median over the rounds of the ratio of the seconds per step."""
    return median(one[1] / other[1] for one, other in zip(numerators, denominators, strict=True))


def table_row(task: Domain, blocks: int, rounds: int) -> str:
    """Measure a task and return its row."""
    name, _, _ = task.id.rpartition("-v")
    peer = f"{name}-v3"
    one, other = ours(task, 1), made(peer) if panda_gym_is_installed() else None
    runners = {"one": block_runner(one), "physics": physics_runner(one), "eight": block_runner(ours(task, 8))}
    several = batch(task)
    runners |= {"batch": block_runner(several), "physics of batch": physics_runner(several)}
    if other is not None:
        runners["equal"] = block_runner(ours(task, PEER_BLOCKS[peer])) if peer in PEER_BLOCKS else runners["one"]
        runners["peer"] = block_runner(other)
    measured = measure(runners, blocks, rounds)
    rate = {name: 1 / median(step for _, step in values) for name, values in measured.items()}
    resets = [1000 * median(reset for reset, _ in measured[name]) for name in ("one", "eight")]
    row = f"{name:<12}{rate['one']:>8,.0f}{rate['eight']:>8,.0f}{ratio(measured['eight'], measured['one']):>8.2f}"
    row += f"{rate['physics']:>10,.0f}{ratio(measured['physics'], measured['one']):>8.0%}"
    row += f"{BATCH * rate['batch']:>8,.0f}{ratio(measured['physics of batch'], measured['batch']):>8.0%}"
    if other is None:
        row += f"{'-':>11}{'-':>8}"
    else:
        row += f"{rate['peer']:>11,.0f}{ratio(measured['peer'], measured['equal']):>8.2f}"
    return row + f"{resets[0]:>11.1f}{resets[1]:>8.1f}"


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=4, help="blocks of 50 steps for each candidate in a round")
    parser.add_argument("--rounds", type=int, default=9, help="rounds of which the median is taken")
    options = parser.parse_args()
    rows = [table_row(task, options.blocks, options.rounds) for task in TASKS]
    print(f"steps/s, median of {options.rounds} interleaved rounds of {options.blocks} x {STEPS} steps\n")
    print(f"{'':<12}{'1 object':>8}{'8':>8}{'cost':>8}{'physics':>10}{'share':>8}{'batch':>8}{'share':>8}", end="")
    print(f"{'panda-gym':>11}{'ratio':>8}{'reset, ms':>11}{'8':>8}")
    print(*rows, sep="\n")
    print("\ncost: a step with 8 objects against one with 1; share: of a step's time that is bare physics;")
    print("ratio: our steps/s against panda-gym's; reset: with 1 object and with 8")
    if not panda_gym_is_installed():
        print(MISSING)


if __name__ == "__main__":
    main()
