"""Several runs side by side: what they reach on each variation, and a picture of it and of their training."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_progpolicy.env_ids import same_env
from sb3_progpolicy.evaluation import Evaluation
from sb3_progpolicy.experiment.folder import EVALUATIONS
from sb3_progpolicy.experiment.sources import Source, evaluate_source


@dataclass(frozen=True)
class Compared:
    """One of the runs.

    :param name: as given
    :param rows: what it reaches, one for each variation
    :param curve: environment steps, and mean steps to the goal at them; empty without evaluations during training
    """

    name: str
    rows: list[Evaluation]
    curve: list[tuple[int, float]]


def compare_sources(
    sources: Sequence[Source], variations: Sequence[Mapping[str, Any]], n_episodes: int, seed: int = 0
) -> list[Compared]:
    """Evaluate runs on the same episodes of the same variations.

    :param sources: from :func:`~sb3_progpolicy.experiment.sources.find_source`, all of one environment
    :param variations: to evaluate on
    :param n_episodes: on each
    :param seed: of the environments
    :raises ValueError: if the environments differ
    """
    if not all(same_env(source.env_id, sources[0].env_id) for source in sources):
        listed = ", ".join(f"{source.name}: {source.env_id}" for source in sources)
        raise ValueError(f"runs of different environments cannot be compared: {listed}")
    return [
        Compared(source.name, evaluate_source(source, variations, n_episodes, seed=seed), read_curve(Path(source.name)))
        for source in sources
    ]


def read_curve(folder: Path) -> list[tuple[int, float]]:
    """Return the evaluations that a run made during training: environment steps and mean steps to the goal.

    :param folder: of the run; a curve is empty where there were none
    """
    path = folder / EVALUATIONS
    if not path.is_file():
        return []
    points: dict[int, list[float]] = {}
    for row in json.loads(path.read_text(encoding="utf-8")):
        points.setdefault(int(row["timesteps"]), []).append(float(row["steps_mean"]))
    return [(timesteps, sum(values) / len(values)) for timesteps, values in sorted(points.items())]


def draw_comparison(compared: Sequence[Compared]) -> Any:
    """Return a picture: steps to the goal on each variation and, where there are any, training curves.

    :param compared: the runs
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    has_curves = any(run.curve for run in compared)
    figure = Figure(figsize=(11 if has_curves else 6.4, 4), layout="constrained")
    axes = figure.subplots(1, 2 if has_curves else 1, squeeze=False)[0]
    labels = [", ".join(str(value) for value in row.variation.values()) or "as it is" for row in compared[0].rows]
    has_goal = compared[0].rows[0].success_rate is not None
    for run in compared:
        values = [row.steps_mean if has_goal else row.return_mean for row in run.rows]
        axes[0].plot(labels, values, marker="o", label=run.name)
    planned = [row.optimal_steps_mean for row in compared[0].rows]
    if all(steps is not None for steps in planned):
        axes[0].plot(labels, planned, color="black", linestyle=":", label="planner")
    names = dict.fromkeys(name for row in compared[0].rows for name in row.variation)
    axes[0].set_xlabel(", ".join(names) or "variation")
    axes[0].set_ylabel("steps to the goal" if has_goal else "return")
    if has_goal:
        axes[0].set_yscale("log")
    if has_curves:
        for run in compared:
            axes[1].plot(*(zip(*run.curve, strict=True) if run.curve else ((), ())), marker=".", label=run.name)
        axes[1].set_xlabel("environment steps")
        axes[1].xaxis.set_major_formatter(EngFormatter())
        axes[1].set_ylabel("steps to the goal, validation variations")
        axes[1].set_ylim(bottom=0)
    for panel in axes:
        panel.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    return figure
