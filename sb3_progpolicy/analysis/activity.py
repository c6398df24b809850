"""Which branch of a program acts at each step of an episode, as data and as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_progpolicy.evaluation import evaluate_program
from sb3_progpolicy.programs.export.visitor import Decimals, counted, largest_terms, title
from sb3_progpolicy.programs.syntax import Condition, ProgramData

INK, QUIET, LINE = "#263238", "#78858c", "#dfe4e7"
COLOURS = ("#12715b", "#e0a526", "#b5411f", "#3b6ea5", "#7a5195", "#5f8c2f", "#c2577f", "#4a4a4a")
_LABEL, _TERMS = 46, 3  # characters and terms of a condition
_COUNT = "left"  # the input that counts what is still to be done, in the Panda tasks


@dataclass(frozen=True)
class Activity:
    """One episode of a program.

    :param program: that acted
    :param env: environment id
    :param variation: the parameters that were set
    :param inputs: X at each step, ``(n_steps, n_inputs)``
    :param branches: index of the controller that acted, from the outermost inwards, ``(n_steps,)``
    :param success: whether the goal was reached
    """

    program: ProgramData
    env: str
    variation: Mapping[str, Any]
    inputs: NDArray[np.float64]
    branches: NDArray[np.int64]
    success: bool

    @property
    def shares(self) -> NDArray[np.float64]:
        """Share of the steps in which each controller acted, ``(n_controllers,)``."""
        return np.bincount(self.branches, minlength=len(self.program.controllers)) / len(self.branches)


def record_activity(
    program: ProgramData,
    env_id: str | None = None,
    variation: Mapping[str, Any] | None = None,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
) -> Activity:
    """Play one episode with the crisp program and keep which branch acts.

    :param program: what to run
    :param env_id: environment id; by default the one in the program's metadata
    :param variation: parameters to set; by default the environment's own
    :param seed: of the episode
    :param env_kwargs: constructor arguments of the environment
    :raises ValueError: if an argument is not accepted or the program does not fit the environment
    """
    inputs: list[NDArray[np.float64]] = []
    branches: list[int] = []

    def watch(now: NDArray[np.float64], branch: NDArray[np.int64]) -> None:
        inputs.append(now[0].copy())
        branches.append(int(branch[0]))

    chosen = dict(variation or {})
    (row,) = evaluate_program(program, env_id, [chosen], 1, seed=seed, env_kwargs=env_kwargs, watch=watch)
    return Activity(program, row.env, chosen, np.array(inputs), np.array(branches), row.success_rate == 1)


def plot_activity(activity: Activity, ax: Any = None) -> Any:
    """Draw an episode: a row for each branch, filled at the steps at which it acts.

    Beside each row stand the condition's largest terms and the share of steps. Dashed lines are steps at which the
    input ``left`` changes, where there is one: an object is finished, or is not any more.

    :param activity: what to draw
    :param ax: matplotlib axes to draw into; by default a new figure
    :return: the axes
    :raises ImportError: if matplotlib is missing
    """
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError('plot_activity needs matplotlib: pip install "sb3-progpolicy[plot]"') from error
    program, n_steps = activity.program, len(activity.branches)
    n_rows = len(program.controllers)
    if ax is None:
        _, ax = plt.subplots(figsize=(10, 1.0 + 0.28 * n_rows), layout="constrained")
    for row, share in enumerate(activity.shares):
        acts = np.flatnonzero(activity.branches == row)
        # Runs of steps that follow each other are one bar.
        parts = np.split(acts, np.flatnonzero(np.diff(acts) > 1) + 1) if len(acts) else []
        bars = [(int(part[0]), len(part)) for part in parts]
        ax.broken_barh(bars, (row - 0.38, 0.76), facecolors=COLOURS[row % len(COLOURS)])
        ax.text(1.01, row, f"{share:.0%}", transform=ax.get_yaxis_transform(), va="center", color=QUIET, size=8)
    for step in _changes(activity):
        ax.axvline(step, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
    number = Decimals(2)
    labels = [_label(condition, index, number, program) for index, condition in enumerate(program.conditions)]
    ax.set_yticks(
        range(n_rows), [*labels, "else" if labels else "always"], family="monospace", size=8, parse_math=False
    )
    ax.set(xlim=(0, n_steps), ylim=(n_rows - 0.5, -0.5), xlabel="step")
    ax.grid(axis="y", color=LINE, linewidth=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.tick_params(axis="y", length=0)
    what = ", ".join(f"{name}={value}" for name, value in activity.variation.items())
    ending = f"{'at' if activity.success else 'not at'} the goal after {counted(n_steps, 'step')}"
    heading = f"{title(program)}{', ' + what if what else ''}: {ending}"
    ax.set_title(heading, loc="left", size=10, color=INK, parse_math=False)
    return ax


def _changes(activity: Activity) -> list[int]:
    names = activity.program.input_names
    if _COUNT not in names:
        return []
    count = activity.inputs[:, names.index(_COUNT)]
    return [int(step) for step in np.flatnonzero(np.diff(count)) + 1]


def _label(condition: Condition, index: int, number: Decimals, program: ProgramData) -> str:
    """Return a condition in a few words."""
    if condition.remembers:
        return f"B{index + 1}: memory ({condition.cell})"
    most = _TERMS if condition.cell == "affine" else 1
    sums = [_sum(constant, weights, number, program.input_names, most) for constant, weights in condition.sums]
    text = sums[0] if condition.cell == "affine" else f"min({', '.join(sums)})"
    text = f"B{index + 1} = {text} >= 0"
    text = text if len(text) <= _LABEL else f"{text[: _LABEL - 3]}..."
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _sum(constant: float, weights: Sequence[float], number: Decimals, names: Sequence[str], most: int) -> str:
    terms = largest_terms(weights, names, number.digits, most)
    text = " ".join(f"{'-' if weight < 0 else '+'} {number.factor(weight, '*')}{name}" for weight, name in terms.shown)
    return f"{number(constant) + ' ' if constant else ''}{text}{' + ...' if terms.n_dropped else ''}"
