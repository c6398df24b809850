"""How large and how fast the shipped programs are, beside a network and a decision tree for the same task.

    python benchmarks/sizes.py [--episodes 20] [--mlp Hanoi-v0=runs/ppo/Hanoi-v0_1/model.zip]

Three policies for each task, all with the program's input: the shipped program; the network of SB3's PPO, two layers of
64; a scikit-learn decision tree of depth 8, fitted to the program's own decisions on its training variations. (A tree
with as many leaves as the program has branches, often one, would decide nothing.) The measures are those of
arXiv 2503.08322, the size of a policy and the time of a decision, for its saved file and as plain Python, into which
all three are unfolded. Beside them: the numbers that are not zero, operations, and the time in the policy's own
library (``predict`` of SB3 and scikit-learn, one observation a call) and of the program as C, if there is a compiler.

``numbers``: weights and constants of a program or of the actor; of a tree the thresholds and the numbers in the leaves.
``mul_add``: multiplications and additions of a decision, at most; tanh is not counted, the network has 128.
``comparisons``: of the largest score, the bounds and the conditions; of a tree, of the mean path.
``saved_bytes``: the program's JSON, SB3's ``policy.save`` (which holds the critic, too), scikit-learn's pickle.
``success``: crisp, on the training variations, on starts that the tree was not fitted to; ``unseen_success``: on the
larger variations that no training sees. An untrained network has
none: its sizes and times are those of a trained one. ``--mlp`` gives a trained one.

Writes ``benchmarks/results/sizes.csv`` and a ``.json`` with command, commit and versions. Needs the extra ``sizes``.
"""

from __future__ import annotations

import argparse
import ctypes
import pickle
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from sklearn.tree import DecisionTreeClassifier, DecisionTreeRegressor
from stable_baselines3 import PPO
from study import write_results

from progpolicy_envs import DOMAINS
from sb3_progpolicy import load_pretrained, make_fast_vec_env, pretrained_names
from sb3_progpolicy.evaluation import Evaluation, evaluate_model, evaluate_program
from sb3_progpolicy.interaction import VecInteractionHistory
from sb3_progpolicy.programs import Program, ProgramRunner, export_c, export_python, load_program
from sb3_progpolicy.spaces import ActionSpec

COLUMNS = (
    "env", "policy", "numbers", "saved_bytes", "python_bytes", "mul_add", "comparisons", "python_us", "c_us",
    "library_us", "success", "unseen_success", "episodes",
)  # fmt: skip
#: Programs as `progpolicy simplify` leaves them.
SIMPLIFIED = Path(__file__).parent / "results" / "simplified"
DEPTH = 8
DISTILLATION_SEED, EVALUATION_SEED = 0, 10_000
# What a unit makes of its sums and its memory: 0.5 + 0.5 * tanh(0.5 * x) for a gate, then the update.
OPERATIONS_OF_A_UNIT = {"affine": 0, "min": 0, "rnn": 0, "gru": 2 * 3 + 5, "lstm": 3 * 3 + 4, "switch": 2}
Row = dict[str, Any]
Floats = NDArray[np.floating]
C_LOOP = """
#include <stddef.h>
#include "policy.h"
void play(int n, int width, int n_actions, const double *x, const TYPE *previous, TYPE *actions)
{
    PREFIX_state state;
    PREFIX_reset(&state);
    for (int k = 0; k < n; k++)
        PREFIX_act(&state, x + k * width, previous + k * n_actions, 0.0, 0.0, actions + k * n_actions);
}
"""


@dataclass
class Player:
    """What :func:`evaluate_model` needs of a model: a choice of actions for X.

    :param observation_space: of X
    :param choose: actions for X ``(n_envs, n_inputs)`` and the state of the last call, ``None`` at first
    """

    observation_space: Any
    choose: Callable[[Floats, Any], tuple[NDArray[Any], Any]]
    action_space = None  # chooses what it learnt from

    def get_env(self) -> None:
        """It was not trained in an environment."""

    def get_vec_normalize_env(self) -> None:
        """Nothing is normalised."""

    def predict(self, x: Floats, state: Any, dones: Any, deterministic: bool) -> tuple[NDArray[Any], Any]:
        """Choose as SB3's models do."""
        return self.choose(x, state)


def decisions(program: Program, env_id: str, space: Any, episodes: int) -> tuple[Floats, NDArray[Any]]:
    """Return the X and the actions of the program on its training variations, as SB3's environments give X."""
    seen, taken = [], []

    def choose(x: Floats, runner: ProgramRunner | None) -> tuple[NDArray[Any], ProgramRunner]:
        runner = runner or ProgramRunner(program, len(x))
        actions = runner.act(x)
        seen.append(x.copy())
        taken.append(actions)
        return actions, runner

    player: Any = Player(space, choose)
    evaluate_model(player, env_id, DOMAINS[env_id].train, episodes, DISTILLATION_SEED)
    return np.concatenate(seen), np.concatenate(taken)


# Counting


def count_nonzero(*arrays: Any) -> int:
    """Return how many numbers are not zero."""
    return sum(int(np.count_nonzero(np.asarray(array, dtype=float))) for array in arrays)


def program_numbers(program: Program) -> list[tuple[Any, ...]]:
    """Return the numbers of every part of a program: conditions, then controllers."""
    parts = [(c.weight_ih, c.weight_hh, c.bias_ih, c.bias_hh, c.readout, c.readout_bias) for c in program.conditions]
    return [*parts, *((controller.weights, controller.bias) for controller in program.controllers)]


def choice_comparisons(action: ActionSpec) -> int:
    """Return the comparisons that turn outputs into an action."""
    if action.kind == "box":
        return 2 * action.n_outputs
    return action.n_outputs - (0 if action.kind == "multi_binary" else len(action.sizes))


def program_operations(program: Program) -> tuple[int, int]:
    """Return multiplications and additions, and comparisons: all conditions and the largest controller."""
    conditions = sum(
        2 * count_nonzero(c.weight_ih, c.weight_hh, c.readout)
        + count_nonzero(c.bias_ih, c.readout_bias, c.bias_hh if c.cell == "gru" else ())
        + OPERATIONS_OF_A_UNIT[c.cell] * c.hidden_size
        for c in program.conditions
    )
    controller = max(2 * count_nonzero(c.weights) + count_nonzero(c.bias) for c in program.controllers)
    tests = sum(max(1, len(condition.sums)) for condition in program.conditions)
    return conditions + controller, tests + choice_comparisons(program.action)


# Unfolding into Python


def unfolded_mlp(layers: list[tuple[Floats, Floats]], action: ActionSpec) -> str:
    """Return the network as statements, one for each unit."""
    lines, names = ["from math import tanh", "", "", "def act(x):"], [f"x[{k}]" for k in range(layers[0][0].shape[1])]
    for index, (weights, bias) in enumerate(layers):
        sums = [
            " + ".join([repr(float(b)), *(f"{float(w)!r} * {name}" for w, name in zip(row, names, strict=True))])
            for row, b in zip(weights, bias, strict=True)
        ]
        names = [f"h{index}_{unit}" for unit in range(len(sums))]
        last = index == len(layers) - 1
        lines += [f"    {n} = {s}" if last else f"    {n} = tanh({s})" for n, s in zip(names, sums, strict=True)]
    outputs = f"({', '.join(names)},)"
    if action.kind == "box":
        bounds = zip(names, action.low, action.high, strict=True)
        lines.append(f"    return [{', '.join(f'min(max({n}, {low!r}), {high!r})' for n, low, high in bounds)}]")
    else:
        lines += [f"    scores = {outputs}", f"    return scores.index(max(scores)) + {action.start}"]
    return "\n".join(lines) + "\n"


def unfolded_tree(tree: Any) -> str:
    """Return a fitted tree as nested if-then-else."""
    inner, classes = tree.tree_, getattr(tree, "classes_", None)

    def lines(node: int, indent: str) -> Iterator[str]:
        if inner.children_left[node] < 0:
            value = inner.value[node]
            yield f"{indent}return {value[:, 0].tolist() if classes is None else int(classes[value[0].argmax()])}"
            return
        yield f"{indent}if x[{inner.feature[node]}] <= {float(inner.threshold[node])!r}:"
        yield from lines(inner.children_left[node], indent + "    ")
        yield f"{indent}else:"
        yield from lines(inner.children_right[node], indent + "    ")

    return "\n".join(["def act(x):", *lines(0, "    ")]) + "\n"


def loaded(source: str) -> dict[str, Any]:
    """Return what a source that was just written defines."""
    namespace: dict[str, Any] = {"__name__": "policy"}
    exec(compile(source, "policy.py", "exec"), namespace)
    return namespace


# Time


def microseconds(decide: Callable[[Any], Any], inputs: list[Any], rounds: int) -> float:
    """Return the time of one decision in the best of several rounds over all inputs."""
    best = float("inf")
    for _ in range(rounds):
        started = time.perf_counter()
        for x in inputs:
            decide(x)
        best = min(best, time.perf_counter() - started)
    return round(1e6 * best / len(inputs), 3)


def history(program: Program, x: Floats) -> list[Any]:
    """Return the previous actions in X, ``None`` where there is none; of Discrete and Box spaces."""
    held = x[:, program.n_observations : -2]
    if program.action.kind == "box":
        return held.tolist()
    return [int(row.argmax()) + program.action.start if row.any() else None for row in held]


def c_microseconds(program: Program, x: Floats, rounds: int) -> float | None:
    """Return the time of one decision of the compiled header, ``None`` without a compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    box = program.action.kind == "box"
    source = str(export_c(program))
    prefix = re.search(r"(\w+)_state;", source)
    assert prefix is not None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "policy.h").write_text(source, encoding="utf-8")
        loop = C_LOOP.replace("PREFIX", prefix[1]).replace("TYPE", "double" if box else "long long")
        (folder / "loop.c").write_text(loop, encoding="utf-8")
        command = [compiler, "-std=c99", "-O2", "-shared", "-fPIC", "-o", "loop.so", "loop.c", "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        library = ctypes.CDLL(str(folder / "loop.so"))
    n_actions = program.action.n_outputs if box else 1
    kind = np.float64 if box else np.int64
    given = [program.action.start if action is None else action for action in history(program, x)]
    arrays = [
        np.ascontiguousarray(x[:, : program.n_observations], dtype=np.float64),
        np.array(given, dtype=kind),
        np.zeros(len(x) * n_actions, dtype=kind),
    ]
    pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
    sizes = map(ctypes.c_int, (len(x), program.n_observations, n_actions))
    arguments = [*sizes, *pointers]
    best = float("inf")
    for _ in range(rounds):
        started = time.perf_counter()
        library.play(*arguments)
        best = min(best, time.perf_counter() - started)
    return round(1e6 * best / len(x), 4)


# The three policies


def success(env_id: str, evaluate: Callable[[Any], list[Evaluation]]) -> Row:
    """Return the share of episodes solved on the training and on the unseen variations."""
    domain = DOMAINS[env_id]
    sets = {"success": domain.train, "unseen_success": domain.unseen}
    return {
        name: round(float(np.mean([row.success_rate for row in evaluate(variations)])), 4)
        for name, variations in sets.items()
    }


def measure_program(
    program: Program, env_id: str, x: Floats, options: argparse.Namespace, policy_name: str = "program"
) -> Row:
    """Return the row of a program."""
    source = str(export_python(program))
    policy = loaded(source)["ProgramPolicy"]()
    observations = x[:, : program.n_observations].tolist()
    steps = list(zip(observations, history(program, x), x[:, -2].tolist(), x[:, -1].tolist(), strict=True))
    with tempfile.TemporaryDirectory() as folder:
        program.save(Path(folder) / "program.json")
        saved = (Path(folder) / "program.json").stat().st_size
    mul_add, comparisons = program_operations(program)
    return {
        "policy": policy_name,
        "numbers": sum(count_nonzero(*part) for part in program_numbers(program)),
        "saved_bytes": saved,
        "python_bytes": len(source.encode()),
        "mul_add": mul_add,
        "comparisons": comparisons,
        "python_us": microseconds(lambda step: policy.act(*step), steps, options.rounds),
        "c_us": c_microseconds(program, np.tile(x, (20, 1)), options.rounds),
        **success(
            env_id,
            lambda variations: evaluate_program(program, env_id, variations, options.episodes, seed=EVALUATION_SEED),
        ),
    }


def measure_mlp(program: Program, env_id: str, x: Floats, venv: Any, options: argparse.Namespace) -> Row:
    """Return the row of PPO's network, trained where its file is given."""
    path = options.mlp.get(env_id)
    model = PPO.load(path, device="cpu") if path else PPO("MlpPolicy", venv, n_steps=64, device="cpu", seed=0)
    policy: Any = model.policy
    linear = [m for m in (*policy.mlp_extractor.policy_net, policy.action_net) if isinstance(m, th.nn.Linear)]
    layers = [(m.weight.detach().numpy(), m.bias.detach().numpy()) for m in linear]
    width = layers[0][0].shape[1]  # a network given may read the observation alone
    source = unfolded_mlp(layers, program.action)
    evaluated = {}
    if path:
        evaluated = success(
            env_id, lambda variations: evaluate_model(model, env_id, variations, options.episodes, EVALUATION_SEED)
        )
    with tempfile.TemporaryDirectory() as folder:
        policy.save(Path(folder) / "policy.pth")
        saved = (Path(folder) / "policy.pth").stat().st_size
    inputs = list(x[:, :width].astype(np.float32))
    return {
        "policy": f"PPO MLP {'x'.join(str(len(bias)) for _, bias in layers[:-1])}{'' if path else ', untrained'}",
        "numbers": count_nonzero(*(array for layer in layers for array in layer)),
        "saved_bytes": saved,
        "python_bytes": len(source.encode()),
        "mul_add": sum(2 * weights.size for weights, _ in layers),
        "comparisons": choice_comparisons(program.action),
        "python_us": microseconds(loaded(source)["act"], x[:200, :width].tolist(), options.rounds),
        "library_us": microseconds(lambda row: model.predict(row, deterministic=True), inputs[:200], options.rounds),
        **evaluated,
    }


def measure_tree(program: Program, env_id: str, space: Any, options: argparse.Namespace, fitted_to: Any) -> Row:
    """Return the row of the tree fitted to the program's decisions."""
    x, actions = fitted_to
    box = program.action.kind == "box"
    tree = (DecisionTreeRegressor if box else DecisionTreeClassifier)(max_depth=DEPTH, random_state=0).fit(x, actions)
    source = unfolded_tree(tree)
    act = loaded(source)["act"]
    np.testing.assert_allclose([act(row) for row in x[:200]], tree.predict(x[:200]))

    def choose(given: Floats, state: Any) -> tuple[NDArray[Any], Any]:
        return tree.predict(given).astype(actions.dtype), state

    player: Any = Player(space, choose)
    inner = tree.tree_
    thresholds = inner.threshold[inner.children_left >= 0]
    return {
        "policy": f"tree, depth {DEPTH}, {tree.get_n_leaves()} leaves",
        "numbers": count_nonzero(thresholds) + tree.get_n_leaves() * (program.action.n_outputs if box else 1),
        "saved_bytes": len(pickle.dumps(tree)),
        "python_bytes": len(source.encode()),
        "mul_add": 0,
        "comparisons": round(float(tree.decision_path(x).sum(axis=1).mean()) - 1, 1),
        "python_us": microseconds(act, x[:2_000].tolist(), options.rounds),
        "library_us": microseconds(tree.predict, [row[None] for row in x[:200]], options.rounds),
        **success(
            env_id, lambda variations: evaluate_model(player, env_id, variations, options.episodes, EVALUATION_SEED)
        ),
    }


def measure(env_id: str, options: argparse.Namespace) -> list[Row]:
    """Return the rows of a task."""
    program = load_pretrained(env_id)
    if not program.interaction or program.action.kind not in ("discrete", "box"):
        raise ValueError(f"{env_id}: programs that read the history and act in Discrete or Box spaces are accepted")
    path = SIMPLIFIED / f"{env_id}.json"
    simple = load_program(path) if path.is_file() else None
    venv = VecInteractionHistory(make_fast_vec_env(env_id, 1))
    try:
        space = venv.observation_space
        x, actions = decisions(program, env_id, space, options.episodes)
        few = x[np.random.default_rng(0).permutation(len(x))[:2_000]]
        rows = [
            measure_program(program, env_id, few, options),
            *([measure_program(simple, env_id, few, options, "program, simplified")] if simple else []),
            measure_mlp(program, env_id, few, venv, options),
            measure_tree(program, env_id, space, options, (x, actions)),
        ]
    finally:
        venv.close()
    return [{"env": env_id, **row, "episodes": options.episodes} for row in rows]


def print_table(rows: list[Row]) -> None:
    """Print the rows, with what an empty cell means."""
    titles = ("task", "policy", "numbers", "bytes", "Python bytes", "mul, add", "compare", "Python µs", "C µs",
              "library µs", "success", "unseen")  # fmt: skip
    table = Table(
        *titles, caption="success: crisp, on the training and on unseen variations; empty for an untrained network"
    )
    for row in rows:
        cells = ["" if row.get(column) is None else str(row[column]) for column in COLUMNS[: len(titles)]]
        cells[-2:] = [f"{row[name]:.1%}" if name in row else "" for name in ("success", "unseen_success")]
        table.add_row(*cells, end_section=row["policy"].startswith("tree"))
    Console(width=150).print(table)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", choices=pretrained_names(), default=pretrained_names())
    parser.add_argument("--episodes", type=int, default=20, help="on each variation, to fit the tree and to evaluate")
    parser.add_argument("--rounds", type=int, default=5, help="of each measurement of time; the best counts")
    parser.add_argument("--mlp", nargs="*", default=[], metavar="ENV=MODEL.ZIP", help="trained models of SB3's PPO")
    parser.add_argument("--name", default="sizes", help="name of the result files")
    options = parser.parse_args()
    options.mlp = dict(pair.split("=", 1) for pair in options.mlp)
    th.set_num_threads(1)
    rows = [row for env_id in options.envs for row in measure(env_id, options)]
    write_results(options.name, COLUMNS, rows, {}, packages=("scikit-learn",))
    print_table(rows)


if __name__ == "__main__":
    main()
