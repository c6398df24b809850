"""The page of a program, from a template, the program as JavaScript, and episodes as data."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.resources import files
from typing import Any

import gymnasium as gym
import numpy as np

from progpolicy_envs import Domain, find_domain
from sb3_progpolicy.pages.episodes import WORLDS, fits, record_episodes
from sb3_progpolicy.programs.export.grids import blocks_of
from sb3_progpolicy.programs.export.javascript import escaped_json, export_javascript
from sb3_progpolicy.programs.export.visitor import (
    action_rule,
    counted,
    deliver,
    input_importance,
    simplified_as,
    title,
)
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.surroundings import own_env_kwargs

#: In the order in which the page runs them; each uses only what stands before it.
SCRIPTS = ("worlds", "episode", "dom", "boards", "panda", "program", "reasons", "charts", "inputs", "app")
_GLOSSARY = ("Observation Space", "Action Space", "Rewards")


def export_html(
    program: ProgramData,
    out_file: str | os.PathLike[str] | Any | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> str | None:
    """Write a program as one web page that needs no network and no other file.

    It shows the program as a tree with the active branch lit, beside an episode to step through, with the scores of all
    actions down to what each term adds. There is one episode for each variation of the environment's domain. In the
    planning domains the reader can change the state, and the program acts in the page. A program of another environment
    is shown with its inputs as sliders.

    No text of a program becomes code or markup, whoever made it, and the page may load nothing.

    :param program: what to show
    :param out_file: a path or an open text file to write to
    :param env_kwargs: constructor arguments of the environment; by default those in the program's metadata
    :param seed: of the episodes
    :return: the page if ``out_file`` is ``None``, else ``None``
    :raises ValueError: if the program is not well formed
    :raises ModuleNotFoundError: if Jinja2 or markdown-it-py is missing, or what the environment needs
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError as error:
        raise ModuleNotFoundError('pages need Jinja2: pip install "sb3-progpolicy[page]"') from error
    source = export_javascript(program)
    domain = find_domain(_env_id(program))
    if env_kwargs is None:
        env_kwargs = own_env_kwargs(program)
    with _environment(program, domain, dict(env_kwargs)) as env:
        content = _content(program, env, domain, seed)
    templates = Environment(
        loader=PackageLoader(__package__, "."), autoescape=True, trim_blocks=True, undefined=StrictUndefined
    )
    folder = files(__package__)
    page = templates.get_template("page.html.jinja").render(
        **content,
        style=(folder / "page.css").read_text(encoding="utf-8"),
        policy=source,
        scripts=[(folder / "js" / f"{name}.js").read_text(encoding="utf-8") for name in SCRIPTS],
    )
    return deliver(page, out_file)


def _env_id(program: ProgramData) -> str | None:
    env_id = program.metadata.get("env")
    return env_id if isinstance(env_id, str) else None


@contextmanager
def _environment(
    program: ProgramData, domain: Domain | None, env_kwargs: dict[str, Any]
) -> Iterator[gym.Env[Any, Any] | None]:
    """The program's environment, or ``None`` if it is not known or the program does not fit it."""
    if domain is None:
        yield None
        return
    env = gym.make(domain.id, **env_kwargs)
    try:
        yield env if fits(program, env) else None
    finally:
        env.close()


def _content(program: ProgramData, env: gym.Env[Any, Any] | None, domain: Domain | None, seed: int) -> dict[str, Any]:
    """What the template and the scripts are given."""
    data: dict[str, Any] = {
        "world": None,
        "episodes": [],
        "grids": [vars(block) for block in blocks_of(program)],
        "importance": [input_importance(condition) for condition in program.conditions],
    }
    sections: list[tuple[str, str]] = []
    lead = "A program from observations to actions."
    if env is not None and domain is not None:
        context = getattr(env.unwrapped, "context", "hidden")
        in_page = domain.id in WORLDS and context == "hidden"
        data["world"] = domain.id if in_page else "Panda" if hasattr(env.unwrapped, "task") else None
        data["size"] = domain.size
        data["cap"] = env.spec and env.spec.max_episode_steps
        data["episodes"] = record_episodes(program, env, domain, in_page, seed)
        docstring = inspect.getdoc(type(env.unwrapped)) or ""
        lead = docstring.partition("\n\n")[0].replace("\n", " ") or lead
        sections = [(name, text) for name in _GLOSSARY if (text := _section(docstring, name))]
    return {
        "title": title(program),
        "heading": domain.id if domain is not None else title(program),
        "lead": lead,
        "facts": _facts(program),
        "rule": action_rule(program.action),
        "sections": [(name, _markup(text)) for name, text in sections],
        "interaction": program.interaction,
        "one_hot": program.action.kind in ("discrete", "multi_discrete"),
        "has_episodes": bool(data["episodes"]),
        "can_edit": data["world"] in WORLDS,
        "data": escaped_json(data),
    }


def _facts(program: ProgramData) -> list[str]:
    weights = [np.array(controller.weights).ravel() for controller in program.controllers]
    weights += [np.array(controller.bias) for controller in program.controllers]
    for condition in program.conditions:
        if not condition.remembers:
            weights += [np.array([constant, *row]) for constant, row in condition.sums]
            continue
        matrices = (condition.weight_ih, condition.weight_hh, condition.bias_ih, condition.bias_hh, condition.readout)
        weights += [np.array(matrix, dtype=float).ravel() for matrix in matrices]
        weights.append(np.array([condition.readout_bias]))
    numbers = np.concatenate(weights)
    n_conditions = len(program.conditions)
    facts = [
        f"{counted(n_conditions, 'condition') if n_conditions else 'no conditions'}, "
        f"{counted(n_conditions + 1, 'controller')}",
        f"reads {counted(program.n_inputs, 'number')}",
        f"{np.count_nonzero(numbers)} of {counted(len(numbers), 'weight')} not zero",
    ]
    for sentence in simplified_as(program):
        facts += [part[0].lower() + part[1:] for part in sentence.rstrip(".").split("; ")]
        facts.append("what was learnt may differ beyond training")
    timesteps = program.metadata.get("timesteps")
    if isinstance(timesteps, int) and timesteps > 0:
        facts.append(f"trained for {timesteps:,} steps".replace(",", "\N{NARROW NO-BREAK SPACE}"))
    return facts


def _section(docstring: str, name: str) -> str:
    """The text under one heading of a docstring, up to the next heading."""
    found = re.search(rf"^## {name}\n(.*?)(?=^##|\Z)", docstring, re.MULTILINE | re.DOTALL)
    return _with_whole_rows(found[1].strip()) if found else ""


def _with_whole_rows(text: str) -> str:
    """A row of a table without a first cell goes on with the row above; Markdown wants both in one line."""
    lines: list[str] = []
    for line in text.splitlines():
        cells = line.split("|")
        if lines and len(cells) > 2 and not line.partition("|")[0].strip() and not cells[1].strip():
            above = lines.pop().split("|")
            cells = [f"{first.rstrip()} {more.strip()}".rstrip() for first, more in zip(above, cells, strict=True)]
            line = "|".join(cells)
        lines.append(line)
    return "\n".join(lines)


def _markup(text: str) -> Any:
    """Markdown as HTML, with all HTML in it escaped."""
    try:
        from markdown_it import MarkdownIt
    except ImportError as error:
        raise ModuleNotFoundError('pages need markdown-it-py: pip install "sb3-progpolicy[page]"') from error
    from markupsafe import Markup

    return Markup(MarkdownIt("commonmark", {"html": False}).enable("table").render(text))
