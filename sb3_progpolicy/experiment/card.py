"""Model cards: how a run was trained, what it reaches on each variation, its program and a film."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from progpolicy_envs import find_domain
from sb3_progpolicy.evaluation import Evaluation
from sb3_progpolicy.experiment.film import record
from sb3_progpolicy.experiment.folder import CONFIG, VERSIONS, read_config, timesteps_of
from sb3_progpolicy.experiment.methods import METHODS
from sb3_progpolicy.experiment.run import trained_variations
from sb3_progpolicy.experiment.sources import Source, evaluate_source
from sb3_progpolicy.hyperparams import read_yaml
from sb3_progpolicy.programs import export_text
from sb3_progpolicy.programs.files import write_atomically


def write_card(
    source: Source,
    folder: Path | None,
    variations: Sequence[Mapping[str, Any]],
    output: Path,
    n_episodes: int = 20,
    film: bool = True,
) -> None:
    """Write a model card in Markdown and, beside it, the film that it shows.

    :param source: what the card is of
    :param folder: of the run, if it is one
    :param variations: to evaluate on; the last is filmed
    :param output: file to write, ``.md``
    :param n_episodes: on each variation
    :param film: whether to film a program
    """
    rows = evaluate_source(source, variations, n_episodes)
    lines = [f"# {_title(source, folder)}", "", *_training(source, folder), *_table(source, folder, rows, n_episodes)]
    if source.program is not None:
        if film:
            picture = output.with_suffix(".gif")
            steps, success = record(source, picture, variations[-1])
            outcome = {True: ", goal reached", False: ", goal not reached", None: ""}[success]
            words = f"{_name(variations[-1])}: {steps} steps{outcome}"
            lines += ["## Film", "", f"![{words}]({picture.name})", "", f"{words}.", ""]
        lines += ["## Program", "", "```", export_text(source.program).rstrip(), "```", ""]
    write_atomically(output, "\n".join(lines))


def _title(source: Source, folder: Path | None) -> str:
    algo = "" if folder is None else f"{read_config(folder).algo} on "
    return f"{algo}{source.env_id}"


def _training(source: Source, folder: Path | None) -> list[str]:
    if folder is None:
        known = {} if source.program is None else source.program.metadata
        facts = [f"* {name}: {value}" for name, value in known.items() if not isinstance(value, (dict, list))]
        trained = _trained_on(source, folder)
        if trained:
            facts.append(f"* Trained on: {', '.join(map(str, trained))}")
        return ["## Training", "", *(facts or ["Nothing is known of it."]), ""]
    config = read_config(folder)
    method = METHODS[config.algo]
    steps = timesteps_of(folder / "model.zip")
    again = f"progpolicy train --algo {config.algo} --env {config.env} --seed {config.seed}"
    lines = [
        "## Training",
        "",
        f"* Method: `{method.name}`, {method.description} ({method.source})",
        f"* Environment: `{config.env}` {dict(config.env_kwargs) or ''}".rstrip(),
        f"* Steps: {'unknown' if steps is None else steps} of {config.n_timesteps}",
        f"* Seed: {config.seed}",
    ]
    domain = find_domain(config.env)
    tasks = config.hyperparams.get("tasks")
    if tasks is not None:
        lines.append(f"* Trained on: {tasks}")
    elif domain is not None and method.across_variations:
        lines.append(f"* Trained on: {', '.join(str(variation) for variation in domain.train)}")
    path = folder / VERSIONS
    if path.is_file():
        versions = read_yaml(path.read_text(encoding="utf-8"))
        lines.append("* Versions: " + ", ".join(f"{name} {version}" for name, version in versions.items()))
    hyperparams = yaml.safe_dump(dict(config.hyperparams), sort_keys=False).rstrip()
    return [
        *lines,
        "",
        f"`{again}` with the hyperparameters below (`{CONFIG}` in its folder) trains it again:",
        "",
        "```yaml",
        hyperparams,
        "```",
        "",
    ]


def _trained_on(source: Source, folder: Path | None) -> Sequence[dict[str, Any]] | None:
    """Return the variations that a run, a shipped program or a file that says so was trained on, else ``None``."""
    domain = find_domain(source.env_id)
    if folder is not None:
        return None if domain is None else trained_variations(read_config(folder), domain)
    known = None if source.program is None else source.program.metadata.get("trained_on")
    if isinstance(known, list) and known and all(isinstance(variation, dict) for variation in known):
        return known
    shipped = source.program is not None and not Path(source.name).exists()
    return domain.train if domain is not None and shipped else None


def _name(variation: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in variation.items()) or "as it is"


def _table(source: Source, folder: Path | None, rows: Sequence[Evaluation], n_episodes: int) -> list[str]:
    domain = find_domain(source.env_id)
    trained = _trained_on(source, folder)
    lines = [
        "## Results",
        "",
        f"{n_episodes} episodes on each variation"
        + (". " if all(row.success_rate is None for row in rows) else "; one that fails counts as the cap on steps. ")
        + ("The program is run crisp, as it is read." if source.program is not None else "Most likely actions."),
        "",
        "| variation | training | success | steps | planner | ratio | return |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        relation = ""
        sizes = [] if domain is None else [known.get(domain.size) for known in (row.variation, *(trained or ()))]
        if domain is not None and trained and all(isinstance(size, int) for size in sizes):
            relation = domain.relation(dict(row.variation), trained)
        name = _name(row.variation)
        optimum = "-" if row.optimal_steps_mean is None else f"{row.optimal_steps_mean:.1f}"
        ratio = "-" if row.ratio is None else f"{row.ratio:.2f}"
        steps = f"{row.steps_mean:.1f} ± {row.steps_std:.1f}"
        success = "-" if row.success_rate is None else f"{row.success_rate:.0%}"
        reward = f"{row.return_mean:.1f} ± {row.return_std:.1f}"
        lines.append(f"| {name} | {relation} | {success} | {steps} | {optimum} | {ratio} | {reward} |")
    return [*lines, ""]
