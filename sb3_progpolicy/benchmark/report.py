"""The report of a suite: tables, pictures and one HTML page that needs no other file."""

from __future__ import annotations

import html
import io
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from matplotlib.figure import Figure

from sb3_progpolicy.benchmark import figures, tables
from sb3_progpolicy.benchmark.export import as_csv
from sb3_progpolicy.benchmark.statistics import interquartile_mean
from sb3_progpolicy.benchmark.tables import Row, label
from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.io import parse_program
from sb3_progpolicy.programs.program import Program

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; color: #1a1a1a; }
h1, h2, h3 { line-height: 1.2; } h2 { margin-top: 2.5rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 14px; }
th, td { padding: .3rem .6rem; text-align: right; white-space: nowrap; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
td.best { font-weight: 700; background: #fdeee4; } td.unseen { border-left: 0; } th.unseen { color: #a33f00; }
td small { color: #666; font-weight: 400; } svg { max-width: 100%; height: auto; }
details { margin: .4rem 0; } pre { background: #f6f6f6; padding: .8rem; overflow-x: auto; font-size: 13px; }
"""


def write_report(name: str, cells: Sequence[Row], rows: Sequence[Row], folder: Path) -> Path:
    """Write ``table.md``, ``table.tex``, ``table.csv``, pictures as SVG and PNG, and ``index.html``.

    :param name: of the suite
    :param cells: of :meth:`~sb3_progpolicy.benchmark.store.Store.cells`
    :param rows: of :meth:`~sb3_progpolicy.benchmark.store.Store.rows`
    :param folder: to write to; made if it does not exist
    :return: the page
    :raises ValueError: if no cell is done yet
    """
    if not rows:
        raise ValueError(f"no cell of {name} is done yet; there is nothing to report")
    folder.mkdir(parents=True, exist_ok=True)
    drawn = draw(cells, rows)
    for title, figure in drawn.items():
        write_atomically(folder / f"{title}.svg", figures.as_svg(figure))
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=150)
        write_atomically(folder / f"{title}.png", buffer.getvalue())
    write_atomically(folder / "table.md", f"# {name}\n\n{tables.markdown(rows)}")
    write_atomically(folder / "table.tex", tables.latex(rows))
    write_atomically(folder / "table.csv", as_csv(tables.table_rows(rows)))
    page = folder / "index.html"
    write_atomically(page, _page(name, cells, rows, drawn))
    return page


def draw(cells: Sequence[Row], rows: Sequence[Row]) -> dict[str, Figure]:
    """Return the pictures of a report by name.

    :param cells: of a store
    :param rows: of a store
    """
    looks = figures.look(list(dict.fromkeys(cell["method"] for cell in cells)))
    envs = list(dict.fromkeys(row["env"] for row in rows))
    drawn = {}
    if any(cell["result"] and cell["result"]["curve"] for cell in cells):
        drawn["curves"] = figures.curves(cells, envs, looks)
    for env in envs:
        scores = tables.scores_by_method(rows, env)
        drawn[f"means_{env}"] = figures.means(scores, looks)
        drawn[f"profiles_{env}"] = figures.profiles(scores, looks)
    return drawn


def _page(name: str, cells: Sequence[Row], rows: Sequence[Row], drawn: Mapping[str, Figure]) -> str:
    done = [cell for cell in cells if cell["result"] is not None]
    versions = sorted({row["versions"] for row in rows})
    commits = sorted({row["commit"] for row in rows})
    hours = sum(cell["result"]["processor_seconds"] for cell in done) / 3600
    parts = [
        f"<h1>{html.escape(name)}</h1>",
        f"<p>{len(done)} of {len(cells)} cells, {len(rows)} rows, {hours:.1f} hours of processor time. sb3-progpolicy "
        f"{version('sb3-progpolicy')}, commit {html.escape(', '.join(commits) or 'unknown')}.</p>",
    ]
    for env in dict.fromkeys(row["env"] for row in rows):
        own = [row for row in rows if row["env"] == env]
        parts += [f"<h2>{html.escape(env)}</h2>", _table(own), _means(own)]
        parts += [figures.as_svg(drawn[f"{kind}_{env}"]) for kind in ("means", "profiles")]
    parts.append(f"<p>{html.escape(tables.LEGEND.replace(chr(92), ''))}</p>")
    if "curves" in drawn:
        parts += ["<h2>Training curves</h2>", "<p>Steps to the goal on the validation variations: mean over seeds and "]
        parts[-1] += "95 % bootstrap band.</p>"
        parts.append(figures.as_svg(drawn["curves"]))
    parts += ["<h2>Learned programs</h2>", *_programs(done)]
    parts += ["<h2>Versions</h2>", *(f"<pre>{html.escape(text)}</pre>" for text in versions)]
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(name)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _table(rows: Sequence[Row]) -> str:
    found = tables.entries(rows)
    columns, least = tables.columns_of(found), tables.best_steps(found)
    heads = "".join(f'<th class="{part}">{html.escape(text)}{"*" * (part == "unseen")}</th>' for part, text in columns)
    lines = [f"<tr><th>method</th><th>seeds</th>{heads}</tr>"]
    for method in dict.fromkeys(entry.method for entry in found):
        own = {(e.set, label(e.env, e.variation)): e for e in found if e.method == method}
        texts = []
        for column in columns:
            entry = own.get(column)
            if entry is None:
                texts.append("<td></td>")
                continue
            best = " best" if tables.is_best(entry, least) else ""
            ratio = "" if entry.ratio is None else f" <small>{entry.ratio:.2f}</small>"
            ratio = ratio if entry.success == 1 else f" <small>[{entry.success:.0%}]</small>"
            trained = "°" if entry.relation == "trained" else ""
            title = f"{entry.success:.0%} solved, {entry.relation}"
            text = f"{entry.mean:.0f} ± {entry.std:.0f}{ratio}{trained}"
            texts.append(f'<td class="{entry.set}{best}" title="{title}">{text}</td>')
        capped = "†" if any(entry.capped for entry in own.values()) else ""
        seeds = max(entry.seeds for entry in own.values())
        lines.append(f"<tr><td>{html.escape(method)}{capped}</td><td>{seeds}</td>{''.join(texts)}</tr>")
    return f'<div class="wide"><table>{"".join(lines)}</table></div>'


def _means(rows: Sequence[Row]) -> str:
    texts = []
    for method, scores in tables.scores_by_method(rows).items():
        interval = interquartile_mean(scores)
        texts.append(f"{html.escape(method)} {interval.value:.2f} [{interval.low:.2f}, {interval.high:.2f}]")
    return f"<p>Interquartile mean of planner's steps over steps taken, unseen variations: {'; '.join(texts)}.</p>"


def _programs(cells: Sequence[Row]) -> list[str]:
    parts = []
    for cell in cells:
        described = cell["result"]["program"]
        if described is None:
            continue
        program = Program(**vars(parse_program(described.encode())))
        title = html.escape(f"{cell['method']} on {cell['env']}, seed {cell['seed']}, learned by {program.learned_by}")
        parts.append(f"<details><summary>{title}</summary><pre>{html.escape(str(program))}</pre></details>")
    return parts or ["<p>No method of this suite learns a program.</p>"]
