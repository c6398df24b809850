"""``progpolicy card``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sb3_progpolicy.cli.parsing import ALLOW_PICKLE, check_folder, default_variations, parse_variations
from sb3_progpolicy.cli.streams import quiet_stdout


def card(
    run_or_name: Annotated[str, typer.Argument(help="run folder, program (.json), model (.zip) or pretrained name")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="file; in a run's folder, card.md")] = None,
    variations: Annotated[
        list[str] | None, typer.Option("--set", help="variations to evaluate on; the last is filmed: n_discs=1-7")
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="on each variation")] = 20,
    film: Annotated[bool, typer.Option("--film/--no-film", help="whether to film a program, beside the card")] = True,
    env: Annotated[
        str | None,
        typer.Option("--env", help="its environment, where a module has to be imported for it, as module:Id-v0"),
    ] = None,
    allow_pickle: Annotated[bool, typer.Option("--allow-pickle", help=ALLOW_PICKLE)] = False,
) -> None:
    """Write a model card: how it was trained, what it reaches on each variation, its program and a film."""
    import torch

    from sb3_progpolicy.env_ids import same_env
    from sb3_progpolicy.experiment.card import write_card
    from sb3_progpolicy.experiment.sources import find_source

    torch.set_num_threads(1)
    folder = Path(run_or_name) if Path(run_or_name).is_dir() else None
    if output is None:
        output = (folder or Path()) / "card.md"
    if output.suffix.lower() != ".md":
        raise ValueError(f"-o {str(output)!r} is not accepted; the file is a .md")
    check_folder(output)
    with quiet_stdout():
        found = find_source(run_or_name, allow_pickle)
        if env is not None and found.named_env is not None and not same_env(env, found.named_env):
            raise ValueError(f"--env {env} is not accepted; a card is for {found.named_env}, where it was trained")
        source = found.within(env)
        assert source.env_id is not None
        chosen = parse_variations(variations) if variations else default_variations(source.env_id)
        write_card(source, folder, chosen, output, episodes, film)
    typer.echo(f"Wrote {output}", err=True)
