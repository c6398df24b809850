"""Sphinx settings, and the pages of the environments, made from their docstrings."""

from __future__ import annotations

import inspect
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator

from progpolicy_envs import DOMAINS
from sb3_progpolicy import load_pretrained, pretrained_names
from sb3_progpolicy.pages import export_html

project = "sb3-progpolicy"
author = "the sb3-progpolicy developers"
copyright = author
release = version = installed_version("sb3-progpolicy")

extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"sb3-progpolicy {release}"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True

ENVIRONMENTS = Path(__file__).parent / "environments"
IMAGES = Path(__file__).parent / "images"
N_PLANNED = 100  # seeds for which the planners' figures are computed
CONTROLLERS = Path(__file__).parents[1] / "benchmarks" / "results" / "panda_control.md"


def environment_page(env_id: str) -> str:
    """Return the page of an environment: its docstring, which is Markdown in Gymnasium's form, and its variations."""
    spec, domain = gym.spec(env_id), DOMAINS[env_id]
    entry_point = spec.entry_point
    creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    picture = IMAGES / f"{page_name(env_id)}.png"
    lines = [f"# {env_id}", ""]
    if picture.exists():
        lines += [f"![A state of {env_id}](../images/{picture.name})", ""]
    lines += [inspect.getdoc(creator) or "", "", "## Variations", ""]
    sets = {
        "Training": domain.train,
        "Validation, to choose hyperparameters by": domain.validation,
        "Unseen, to test on": domain.unseen,
    }
    for words, variations in sets.items():
        lines += [f"{words}:", "", *(f"* `{variation}`" for variation in variations), ""]
    return "\n".join(lines + (controller_figures(env_id) if domain.simulation else planner_figures(env_id)))


def planner_figures(env_id: str) -> list[str]:
    """Return how many steps the exact planner of a planning domain needs, computed now."""
    lines = [
        "## Planner",
        "",
        "Steps of the exact planner (`progpolicy_envs.planners`), the fewest there are, over the starts of seeds 0 to "
        f'{N_PLANNED - 1}; `reset` returns them as `info["optimal_steps"]`:',
        "",
        "| Variation | mean | least | most |",
        "|---|---|---|---|",
    ]
    env = gym.make(env_id)
    domain = DOMAINS[env_id]
    for variation in (*domain.train, *domain.validation, *domain.unseen):
        steps = [env.reset(seed=seed, options=dict(variation))[1]["optimal_steps"] for seed in range(N_PLANNED)]
        name = ", ".join(f"{key} = {value}" for key, value in variation.items())
        lines.append(f"| {name} | {np.mean(steps):.1f} | {min(steps)} | {max(steps)} |")
    env.close()
    return [*lines, ""]


def controller_figures(env_id: str) -> list[str]:
    """Return how often the scripted controller solves a Panda task."""
    command, commit, *table = [line for line in CONTROLLERS.read_text(encoding="utf-8").splitlines() if line]
    rows = [line for line in table if line.startswith(("| Task ", "|---", f"| {env_id} "))]
    words = (
        "How often the scripted controller (`progpolicy_envs.planners.panda`) solves the task, with our physics and "
        "with the finer ones of panda-gym, 500 Hz and 20 physics steps for each action, from the same starts:"
    )
    return ["## Scripted controller", "", words, "", *rows, "", f"{command} {commit}", ""]


def page_name(env_id: str) -> str:
    """Return ``hanoi`` for ``Hanoi-v0``; of several versions an older one has its number, as ``hiking_v0``."""
    name, _, version = env_id.rpartition("-v")
    versions = [other.rpartition("-v")[2] for other in DOMAINS if other.startswith(f"{name}-v")]
    return name.lower() if version == max(versions, key=int) else f"{name.lower()}_v{version}"


def write_environment_pages(app: object) -> None:
    """Write one page for each domain; unchanged ones are left alone, so that they are not built again."""
    for env_id in DOMAINS:
        page, path = environment_page(env_id), ENVIRONMENTS / f"{page_name(env_id)}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != page:
            path.write_text(page, encoding="utf-8")


def write_program_pages(app: Any, error: Exception | None) -> None:
    """Write a page for each shipped program next to the built documentation; the guide on programs has the links."""
    if error is not None or app.builder.format != "html":
        return
    folder = Path(app.outdir) / "programs"
    folder.mkdir(exist_ok=True)
    for name in pretrained_names():
        try:
            export_html(load_pretrained(name), folder / f"{name}.html")
        except ModuleNotFoundError as missing:  # PyBullet, of which there are no wheels for Python 3.12 and later
            print(f"no page for {name}: {missing}")


def setup(app: Any) -> None:
    """Have the environments' pages written before Sphinx looks for source files, the programs' after it is done."""
    app.connect("builder-inited", write_environment_pages)
    app.connect("build-finished", write_program_pages)
