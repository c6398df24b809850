"""``progpolicy render``: an episode as an animated GIF or an MP4 film."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder, default_variations, parse_variations
from sb3_progpolicy.cli.streams import quiet_stdout
from sb3_progpolicy.experiment.film import FORMATS, environment_of, record
from sb3_progpolicy.experiment.sources import find_source
from sb3_progpolicy.nearest import unknown


def render(
    run_or_name: Annotated[
        str,
        typer.Argument(help="run folder, program, model or pretrained name; with --planner or --random also an id"),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="file to write, .gif or .mp4")],
    variation: Annotated[list[str] | None, typer.Option("--set", help="the variation: n_discs=7")] = None,
    planner: Annotated[bool, typer.Option("--planner", help="the domain's planner acts")] = False,
    random: Annotated[bool, typer.Option("--random", help="actions are drawn at random")] = False,
    semantics: Annotated[str, typer.Option("--semantics", help="crisp or soft")] = "crisp",
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the environment")] = 0,
    fps: Annotated[int | None, typer.Option("--fps", min=1, max=50, help="frames per second")] = None,
    max_steps: Annotated[int | None, typer.Option("--max-steps", min=1, help="cap of the episode")] = None,
    env: Annotated[str | None, typer.Option("--env", help="another environment than it was trained in")] = None,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Play one episode and write it as an animated GIF or an MP4 film."""
    if output.suffix.lower() not in FORMATS:
        raise ValueError(f"-o {str(output)!r} is not accepted; the file is a .gif or an .mp4")
    check_folder(output)
    if planner and random:
        raise ValueError("--planner and --random are not accepted together")
    if semantics not in ("crisp", "soft"):
        raise unknown("semantics", semantics, ("crisp", "soft"))
    if semantics == "soft" and (planner or random):
        raise ValueError("--semantics is for programs; neither a planner nor drawn actions have one")
    with quiet_stdout():
        actor = "planner" if planner else "random" if random else "policy"
        found = find_source(run_or_name, allow_pickle) if actor == "policy" else environment_of(run_or_name)
        source = found.within(env)
        assert source.env_id is not None
        variations = parse_variations(variation) if variation else default_variations(source.env_id)[-1:]
        if len(variations) != 1:
            raise ValueError(f"--set gives {len(variations)} variations; one episode has one")
        steps, success = record(source, output, variations[0], actor, semantics, seed, fps, max_steps)
    outcome = "" if success is None else ", goal reached" if success else ", goal not reached"
    typer.echo(f"Wrote {output}: {steps} steps{outcome}", err=True)
