"""Random programs of every shape, and random episodes for them to act in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import strategies as st

from sb3_progpolicy.programs import ActionSpec, Condition, Controller, IfThenElse, Program
from sb3_progpolicy.programs.syntax import GATES, Cell, Matrix, Vector

CELLS = tuple(GATES)
KINDS = ("discrete", "box", "multi_discrete", "multi_binary")
seeds = st.integers(0, 2**32 - 1)


def vector(rng: np.random.Generator, size: int, scale: float = 2.0) -> Vector:
    """Numbers of which a fifth are zero and a fifth whole, so that ties and skipped terms happen."""
    values = rng.normal(scale=scale, size=size)
    kind = rng.integers(5, size=size)
    return tuple(np.where(kind == 0, 0.0, np.where(kind == 1, np.round(values), values)).tolist())


def matrix(rng: np.random.Generator, rows: int, columns: int) -> Matrix:
    return tuple(vector(rng, columns) for _ in range(rows))


def condition(rng: np.random.Generator, cell: Cell, n_inputs: int, hidden_size: int) -> Condition:
    if cell == "affine":
        return Condition(cell, (), (), (), (), vector(rng, n_inputs), vector(rng, 1)[0])
    if cell == "min":
        return Condition(cell, matrix(rng, hidden_size, n_inputs), (), vector(rng, hidden_size), (), (), 0.0)
    rows = len(GATES[cell]) * hidden_size
    return Condition(
        cell,
        matrix(rng, rows, n_inputs),
        matrix(rng, rows, hidden_size),
        vector(rng, rows),
        vector(rng, rows),
        vector(rng, hidden_size),
        vector(rng, 1)[0],
    )


def action_spec(rng: np.random.Generator, kind: str) -> ActionSpec:
    if kind == "discrete":
        return ActionSpec("discrete", (int(rng.integers(1, 7)),), start=int(rng.integers(-2, 3)))
    if kind == "box":
        n = int(rng.integers(1, 5))
        low = rng.normal(size=n).astype(np.float32).astype(float)
        return ActionSpec("box", (n,), tuple(low.tolist()), tuple((low + 1).tolist()))
    if kind == "multi_discrete":
        return ActionSpec("multi_discrete", tuple(rng.integers(1, 5, size=rng.integers(1, 4)).tolist()))
    return ActionSpec("multi_binary", (int(rng.integers(1, 5)),))


def build_program(
    seed: int, cells: list[Cell], kind: str, interaction: bool, n_observations: int = 5, hidden_size: int = 2
) -> Program:
    rng = np.random.default_rng(seed)
    action = action_spec(rng, kind)
    n_inputs = n_observations + (action.history_size + 2 if interaction else 0)

    def controller() -> Controller:
        return Controller(matrix(rng, action.n_outputs, n_inputs), vector(rng, action.n_outputs))

    body: Any = controller()
    for cell in cells:
        body = IfThenElse(condition(rng, cell, n_inputs, hidden_size), controller(), body)
    return Program(
        body=body,
        n_observations=n_observations,
        action=action,
        interaction=interaction,
        input_names=tuple(f"input {index}[x]" for index in range(n_inputs)),
        output_names=tuple(f"output {index}->" for index in range(action.n_outputs)),
        temperature=float(rng.uniform(0.1, 2)),
        metadata={"env": "Test-v0", "seed": seed, "nested": {"list": [1, 0.1, None, True, "é"]}},
    )


programs = st.builds(
    build_program,
    seed=seeds,
    cells=st.lists(st.sampled_from(CELLS), max_size=4),
    kind=st.sampled_from(KINDS),
    interaction=st.booleans(),
    n_observations=st.integers(1, 6),
    hidden_size=st.integers(1, 4),
)


def small_program(rng: np.random.Generator) -> Program:
    """A random program with up to two conditions."""
    return build_program(
        seed=int(rng.integers(2**32)),
        cells=[CELLS[index] for index in rng.integers(len(CELLS), size=rng.integers(3))],
        kind=KINDS[rng.integers(len(KINDS))],
        interaction=bool(rng.integers(2)),
        n_observations=int(rng.integers(1, 5)),
        hidden_size=int(rng.integers(1, 3)),
    )


def sparse(program: Program, seed: int) -> Program:
    """The program with at most three weights of each sum kept and rounded to whole numbers; some read nothing."""
    rng = np.random.default_rng(seed)

    def row(weights: Vector) -> Vector:
        kept = rng.permutation(len(weights)) < rng.integers(0, 4)
        return tuple(np.where(kept, np.round(weights), 0.0).tolist())

    def controller(node: Controller) -> Controller:
        constant = rng.random() < 0.5
        rows = tuple((0.0,) * len(weights) if constant else row(weights) for weights in node.weights)
        return Controller(rows, tuple(np.round(node.bias).tolist()))

    body: Any = controller(program.controllers[-1])
    for test, then in reversed(list(zip(program.conditions, program.controllers[:-1], strict=True))):
        kept = {"readout": row(test.readout)} if test.cell == "affine" else {}
        test = replace(test, weight_ih=tuple(map(row, test.weight_ih)), **kept)
        body = IfThenElse(test, controller(then), body)
    return replace(program, body=body)


def hanoi_program(seed: int = 0, cell: Cell = "gru", hidden_size: int = 3, n_conditions: int = 2) -> Program:
    """A random program with the size and the names of one for Hanoi-v0."""
    rng = np.random.default_rng(seed)
    moves = [f"move {source}->{target}" for source in range(3) for target in range(3) if source != target]
    observed = [f"{feature}[{peg}]" for peg in range(3) for feature in ("rank", "colour", "empty")]
    names = (*observed, *(f"previous {move}" for move in moves), "previous reward", "previous done")

    def controller() -> Controller:
        return Controller(tuple(vector(rng, 17) for _ in range(6)), vector(rng, 6))

    body: Any = controller()
    for _ in range(n_conditions):
        body = IfThenElse(condition(rng, cell, 17, hidden_size), controller(), body)
    return Program(
        body=body,
        n_observations=9,
        action=ActionSpec("discrete", (6,)),
        interaction=True,
        input_names=names,
        output_names=tuple(moves),
        metadata={"env": "Hanoi-v0"},
    )


def random_actions(rng: np.random.Generator, action: ActionSpec, n_envs: int) -> Any:
    if action.kind == "discrete":
        return rng.integers(action.n_outputs, size=n_envs) + action.start
    if action.kind == "multi_discrete":
        return np.column_stack([rng.integers(size, size=n_envs) for size in action.sizes])
    if action.kind == "multi_binary":
        return rng.integers(2, size=(n_envs, action.n_outputs))
    return rng.uniform(action.low, action.high, size=(n_envs, action.n_outputs))
