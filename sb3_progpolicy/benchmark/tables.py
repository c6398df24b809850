"""The paper's table: steps of every method on every variation, as Markdown, LaTeX and CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs import get_domain
from sb3_progpolicy.benchmark.statistics import Scores, score_of

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Entry:
    """A method on a variation.

    :param method: its name in the suite
    :param env: id of the domain
    :param set: ``"train"`` or ``"unseen"``
    :param variation: its parameters
    :param relation: how the variation stands to what the method was trained on
    :param seeds: number of seeds
    :param mean: of the steps, over seeds
    :param std: standard deviation over seeds
    :param success: mean success rate, 0 to 1
    :param ratio: mean of the steps as a multiple of the planner's; ``None`` where there is no planner
    :param capped: whether a training was ended by the limit on processor time
    """

    method: str
    env: str
    set: str
    variation: Mapping[str, Any]
    relation: str
    seeds: int
    mean: float
    std: float
    success: float
    ratio: float | None
    capped: bool


def readable(rows: Sequence[Row]) -> list[Row]:
    """Return the rows that count: of a program those of the crisp semantics, which is what can be read and shipped."""
    return [row for row in rows if row["semantics"] in (None, "crisp")]


def entries(rows: Sequence[Row]) -> list[Entry]:
    """Return the table's entries, in the order in which the rows come.

    :param rows: of a store
    """
    grouped: dict[Any, list[Row]] = {}
    for row in readable(rows):
        name = (row["env"], row["set"], tuple(sorted(row["variation"].items())), row["method"])
        grouped.setdefault(name, []).append(row)
    made = []
    for group in grouped.values():
        first, steps = group[0], np.array([row["steps_mean"] for row in group])
        planned = [row["optimal_steps_mean"] for row in group]
        ratio = None if not all(planned) else float(np.mean(steps / np.array(planned, dtype=float)))
        made.append(
            Entry(
                method=first["method"],
                env=first["env"],
                set=first["set"],
                variation=first["variation"],
                relation=first["relation"],
                seeds=len(group),
                mean=float(steps.mean()),
                std=float(steps.std()),
                success=float(np.mean([row["success_rate"] for row in group])),
                ratio=ratio,
                capped=any(row["capped"] for row in group),
            )
        )
    return made


def scores_by_method(rows: Sequence[Row], env: str | None = None, part: str = "unseen") -> dict[str, Scores]:
    """Return for each method its scores on the variations of one set, ``(n_seeds,)`` for each.

    :param rows: of a store
    :param env: id of a domain; all by default
    :param part: ``"train"`` or ``"unseen"``
    """
    collected: dict[str, dict[str, list[float]]] = {}
    for row in readable(rows):
        if row["set"] == part and env in (None, row["env"]):
            task = f"{row['env']} {label(row['env'], row['variation'])}"
            collected.setdefault(row["method"], {}).setdefault(task, []).append(score_of(row))
    return {method: {task: np.array(values) for task, values in tasks.items()} for method, tasks in collected.items()}


def label(env: str, variation: Mapping[str, Any]) -> str:
    """Return a short name of a variation, such as ``7`` for seven discs."""
    size = get_domain(env).size
    others = [str(value) for name, value in variation.items() if name != size]
    return " ".join([str(variation[size]), *others])


def columns_of(found: Sequence[Entry]) -> list[tuple[str, str]]:
    """Return set and label of a domain's variations, in order."""
    return list(dict.fromkeys((entry.set, label(entry.env, entry.variation)) for entry in found))


def markdown(rows: Sequence[Row]) -> str:
    """Return a table for each domain.

    :param rows: of a store
    """
    found, lines = entries(rows), []
    for env in dict.fromkeys(entry.env for entry in found):
        own = [entry for entry in found if entry.env == env]
        columns = columns_of(own)
        lines += [f"## {env}", "", f"Steps by {get_domain(env).size}, mean ± standard deviation over seeds.", ""]
        lines.append("| method | seeds | " + " | ".join(f"{name}{_mark(part)}" for part, name in columns) + " |")
        lines.append("|---|---:|" + "---:|" * len(columns))
        best = best_steps(own)
        for method in dict.fromkeys(entry.method for entry in own):
            cells = {(e.set, label(env, e.variation)): e for e in own if e.method == method}
            texts = [_text(cells.get(column), best) for column in columns]
            seeds = max(entry.seeds for entry in cells.values())
            capped = "†" if any(entry.capped for entry in cells.values()) else ""
            lines.append(f"| {method}{capped} | {seeds} | {' | '.join(texts)} |")
        lines.append("")
    return "\n".join([*lines, LEGEND, ""])


LEGEND = (
    "\\* unseen: nothing was trained on it or chosen by it. ° the method was trained on it. Bold: the fewest steps, or "
    "at most 2 % more. In brackets: multiple of the planner's steps, or [share of episodes solved] where some are not; "
    "a failed episode counts as the cap. † a training ended at the limit on processor time. Programs are run crisp, as "
    "they are read."
)


def _mark(part: str) -> str:
    return "\\*" if part == "unseen" else ""


def best_steps(found: Sequence[Entry]) -> dict[tuple[str, str], float]:
    """Return the fewest steps of each column, by set and label.

    :param found: entries of one domain
    """
    best: dict[tuple[str, str], float] = {}
    for entry in found:
        column = (entry.set, label(entry.env, entry.variation))
        best[column] = min(best.get(column, np.inf), entry.mean)
    return best


def is_best(entry: Entry, best: Mapping[tuple[str, str], float]) -> bool:
    """Return whether an entry solves something and takes at most 2 % more steps than the best of its column.

    :param entry: of the table
    :param best: of :func:`best_steps`
    """
    return entry.success > 0 and entry.mean <= 1.02 * best[entry.set, label(entry.env, entry.variation)]


def _text(entry: Entry | None, best: Mapping[tuple[str, str], float]) -> str:
    if entry is None:
        return ""
    text = f"{entry.mean:.0f} ± {entry.std:.0f}".replace(" ", "\N{NO-BREAK SPACE}")
    if entry.success < 1:
        text += f" [{entry.success:.0%}]"
    elif entry.ratio is not None:
        text += f" ({entry.ratio:.2f})"
    if is_best(entry, best):
        text = f"**{text}**"
    return text + ("°" if entry.relation == "trained" else "")


def latex(rows: Sequence[Row]) -> str:
    """Return a ``tabular`` for each domain; needs the package ``booktabs``.

    :param rows: of a store
    """
    found, lines = entries(rows), ["% \\usepackage{booktabs}"]
    for env in dict.fromkeys(entry.env for entry in found):
        own = [entry for entry in found if entry.env == env]
        columns, best = columns_of(own), best_steps(own)
        lines += [f"% {env}", f"\\begin{{tabular}}{{l{'r' * len(columns)}}}", "\\toprule"]
        heads = [f"{_escaped(name)}{'$^*$' if part == 'unseen' else ''}" for part, name in columns]
        lines += [" & ".join(["method", *heads]) + " \\\\", "\\midrule"]
        for method in dict.fromkeys(entry.method for entry in own):
            cells = {(e.set, label(env, e.variation)): e for e in own if e.method == method}
            texts = []
            for column in columns:
                entry = cells.get(column)
                text = "" if entry is None else f"${entry.mean:.0f} \\pm {entry.std:.0f}$"
                bold = entry is not None and is_best(entry, best)
                texts.append(f"\\boldmath{text}" if bold else text)
            capped = "$^\\dagger$" if any(entry.capped for entry in cells.values()) else ""
            lines.append(" & ".join([_escaped(method) + capped, *texts]) + " \\\\")
        lines += ["\\bottomrule", "\\end{tabular}", ""]
    return "\n".join(lines)


def _escaped(text: str) -> str:
    for character in "\\&%$#_{}":
        text = text.replace(character, "\\textbackslash{}" if character == "\\" else f"\\{character}")
    return text


def table_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the table's entries as plain rows, for CSV.

    :param rows: of a store
    """
    return [
        {
            "env": entry.env,
            "method": entry.method,
            "set": entry.set,
            "variation": dict(entry.variation),
            "relation": entry.relation,
            "seeds": entry.seeds,
            "steps_mean": round(entry.mean, 2),
            "steps_std": round(entry.std, 2),
            "success_rate": round(entry.success, 4),
            "ratio": None if entry.ratio is None else round(entry.ratio, 3),
            "capped": entry.capped,
        }
        for entry in entries(rows)
    ]


def curves_by_method(cells: Sequence[Row], env: str) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return each method's training curves on a domain: environment steps ``(n,)``, steps to the goal ``(n_seeds, n)``.

    At each point the mean over the validation variations counts. Curves end with the shortest of a method's seeds.

    :param cells: of a store
    :param env: id of the domain
    """
    curves: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = {}
    for cell in cells:
        if cell["env"] != env or cell["result"] is None or not cell["result"]["curve"]:
            continue
        points: dict[int, list[float]] = {}
        for point in cell["result"]["curve"]:
            points.setdefault(point["timesteps"], []).append(point["steps_mean"])
        times = np.array(sorted(points), dtype=float)
        values = np.array([np.mean(points[int(time)]) for time in times])
        curves.setdefault(cell["method"], []).append((times, values))
    joined = {}
    for method, seeds in curves.items():
        length = min(len(times) for times, _ in seeds)
        joined[method] = (seeds[0][0][:length], np.array([values[:length] for _, values in seeds]))
    return joined
