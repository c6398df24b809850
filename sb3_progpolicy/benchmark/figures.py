"""Pictures of a benchmark: curves with confidence bands, interquartile means, performance profiles."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from progpolicy_envs import get_domain
from sb3_progpolicy.benchmark.statistics import Scores, interquartile_mean, mean_over_seeds, performance_profile
from sb3_progpolicy.benchmark.tables import Row, curves_by_method

# Colours that can be told apart by the colour-blind (Okabe and Ito), the first for our own method.
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999999", "#7F3C8D", "#B8A800")
STYLES = ("-", "--", "-.", ":")


def look(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return a colour and a line style for each method, the same in all pictures of a report; the first lie on top."""
    found = {}
    for number, method in enumerate(methods):
        colour, style = COLOURS[number % len(COLOURS)], STYLES[number % len(STYLES)]
        found[method] = {"color": colour, "linestyle": style, "zorder": 3 - number / 100}
    return found


def curves(cells: Sequence[Row], envs: Sequence[str], looks: Mapping[str, dict[str, Any]]) -> Figure:
    """Draw the steps to the goal on the validation variations over the environment steps of training.

    :param cells: of a store
    :param envs: ids of the domains, a panel each
    :param looks: of :func:`look`
    """
    figure = Figure(figsize=(4.2 * len(envs), 3.4), layout="constrained")
    for number, env in enumerate(envs):
        axes = figure.add_subplot(1, len(envs), number + 1)
        for method, (times, values) in curves_by_method(cells, env).items():
            bands = [mean_over_seeds(values[:, column]) for column in range(len(times))]
            axes.plot(times, [band.value for band in bands], label=method, **looks[method])
            lows, highs = [band.low for band in bands], [band.high for band in bands]
            axes.fill_between(times, lows, highs, color=looks[method]["color"], alpha=0.15, linewidth=0)
        sizes = sorted({str(variation[get_domain(env).size]) for variation in get_domain(env).validation})
        axes.set_title(f"{env}, {get_domain(env).size} {', '.join(sizes)}", fontsize=10)
        axes.set_xlabel("environment steps")
        axes.xaxis.set_major_formatter(EngFormatter())
        axes.set_ylabel("steps to the goal" if number == 0 else "")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    _legend(figure, looks)
    return figure


def means(scores: Mapping[str, Scores], looks: Mapping[str, dict[str, Any]]) -> Figure:
    """Draw the interquartile mean of each method with its 95 % interval.

    :param scores: by method
    :param looks: of :func:`look`
    """
    figure = Figure(figsize=(6.4, 0.42 * len(scores) + 1.0), layout="constrained")
    axes = figure.add_subplot()
    for place, (method, own) in enumerate(list(scores.items())[::-1]):
        interval = interquartile_mean(own)
        axes.barh(place, interval.high - interval.low, left=interval.low, color=looks[method]["color"], alpha=0.4)
        axes.plot([interval.value] * 2, [place - 0.4, place + 0.4], color=looks[method]["color"], linewidth=2.5)
    axes.set_yticks(range(len(scores)), list(scores)[::-1])
    axes.set_xlim(0, 1.02)
    axes.set_xlabel("planner's steps over steps taken (interquartile mean, unseen)")
    axes.grid(axis="x", alpha=0.3)
    return figure


def profiles(scores: Mapping[str, Scores], looks: Mapping[str, dict[str, Any]]) -> Figure:
    """Draw for each method the share of runs that reach a score.

    :param scores: by method
    :param looks: of :func:`look`
    """
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.add_subplot()
    thresholds = np.linspace(0, 1, 201)
    for method, own in scores.items():
        axes.plot(thresholds, performance_profile(own, thresholds), label=method, **looks[method])
    axes.set_xlabel("score: planner's steps over steps taken")
    axes.set_ylabel("share of runs with at least this score")
    axes.set_xlim(0, 1)
    axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.3)
    _legend(figure, looks)
    return figure


def _legend(figure: Figure, looks: Mapping[str, dict[str, Any]]) -> None:
    handles = {line.get_label(): line for axes in figure.axes for line in axes.get_lines()}
    shown = [method for method in looks if method in handles]
    if shown:
        figure.legend([handles[method] for method in shown], shown, loc="outside right upper", fontsize=8)


def as_svg(figure: Figure) -> str:
    """Return a picture as an ``<svg>`` element; the same picture gives the same text."""
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "progpolicy", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]
