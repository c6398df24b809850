"""``progpolicy play``: a person steps a planning domain in the terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import typer

from sb3_progpolicy.cli.parsing import parse_variations
from sb3_progpolicy.cli.streams import quiet_stdout

QUIT = "q"
#: Keys of actions with these names; all others are numbered from 1.
KEYS = {"north": "n", "east": "e", "south": "s", "west": "w", "pick": "p"}


def play(
    env: Annotated[str, typer.Argument(help="a planning domain, such as Hanoi-v0; see progpolicy envs")],
    variation: Annotated[list[str] | None, typer.Option("--set", help="the variation: n_discs=3")] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="of the environment")] = None,
) -> None:
    """Step a planning domain yourself: one key for each action, q to stop."""
    import gymnasium as gym

    from sb3_progpolicy.env_ids import spec_of

    variations = parse_variations(variation or [])
    if len(variations) != 1:
        raise ValueError(f"--set gives {len(variations)} variations; one episode has one")
    with quiet_stdout():
        env_id = spec_of(env).id
        _check_playable(env_id)
        game = gym.make(env_id, render_mode="ansi")
    try:
        _play(game, variations[0], seed, _pressed())
    finally:
        game.close()


def _check_playable(env_id: str) -> None:
    import gymnasium as gym
    from gymnasium.envs.registration import load_env_creator

    from progpolicy_envs import DOMAINS

    playable = [domain.id for domain in DOMAINS.values() if not domain.simulation]
    modes = getattr(load_env_creator(str(gym.spec(env_id).entry_point)), "metadata", {}).get("render_modes", [])
    if "ansi" not in modes or env_id not in playable:
        raise ValueError(f"{env_id!r} is not accepted; these can be played in a terminal: {', '.join(playable)}")


def action_keys(names: Sequence[str]) -> dict[str, int]:
    """Return the key of each action: its initial for directions and the like, otherwise its number.

    :param names: of the actions
    """
    return {KEYS.get(name, str(number + 1)): number for number, name in enumerate(names)}


def _play(game: Any, variation: dict[str, Any], seed: int | None, pressed: Iterator[str]) -> None:
    names = game.get_wrapper_attr("action_names")
    keys = action_keys(names)
    _, info = game.reset(seed=seed, options=variation)
    shown = "   ".join(f"{key} {names[number]}" for key, number in keys.items())
    typer.echo(f"{shown}   {QUIT} quit\n\n{game.render()}")
    steps, optimal, total = 0, info.get("optimal_steps"), 0.0
    for key in pressed:
        if key == QUIT:
            break
        if key not in keys:
            typer.echo(f"{key!r} is not a key; keys: {' '.join(keys)} {QUIT}")
            continue
        _, reward, terminated, truncated, info = game.step(keys[key])
        steps, total = steps + 1, total + float(reward)
        typer.echo(f"\n{steps}: {names[keys[key]]}, reward {float(reward):g}\n{game.render()}")
        if terminated or truncated:
            verdict = "Goal reached" if info["is_success"] else "Goal not reached"
            typer.echo(f"{verdict} in {steps} steps; the planner needs {optimal}. Return {total:g}.")
            return
    typer.echo(f"Stopped after {steps} steps; the planner needs {optimal} in all.")


def _pressed() -> Iterator[str]:
    """Yield what is typed: single keys in a terminal, otherwise every visible character up to the end of the input."""
    if sys.stdin.isatty():
        while True:
            try:
                yield typer.getchar().lower()
            except EOFError:
                return
    for line in sys.stdin:
        yield from (character for character in line.lower() if not character.isspace())
