"""``progpolicy plan``: the actions of an environment's own planner."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
import typer

from sb3_progpolicy.cli.parsing import parse_variations
from sb3_progpolicy.cli.streams import quiet_stdout


def plan(
    env: Annotated[str, typer.Argument(help="an environment with a planner, such as Hanoi-v0; see progpolicy envs")],
    options: Annotated[
        list[str] | None, typer.Option("--set", help="the variation and the start: n_discs=3 discs=[1,0,0]")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the environment")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="a JSON object on stdout, nothing else")] = False,
) -> None:
    """Print the actions of an environment's planner, step by step.

    In the planning domains it is a shortest solution, in the Panda tasks an episode of the scripted controller.
    """
    chosen = parse_variations(options or [])
    if len(chosen) != 1:
        raise ValueError(f"--set gives {len(chosen)} variations; one plan has one")
    with quiet_stdout():
        env_id, names, actions, success = _planned(env, chosen[0], seed)
    if as_json:
        content = {"env": env_id, "options": chosen[0], "seed": seed, "actions": actions, "steps": len(actions)}
        typer.echo(json.dumps({**content, "is_success": success}))
        return
    for line in _table(actions, names):
        typer.echo(line)
    typer.echo(f"{'Goal reached' if success else 'Goal not reached'} in {len(actions)} steps.")


def _planned(env_id: str, options: dict[str, Any], seed: int) -> tuple[str, Sequence[str], list[Any], bool]:
    """Let the planner act for an episode; return the id, the names of actions, the actions and whether they succeed."""
    import gymnasium as gym

    from sb3_progpolicy.env_ids import spec_of

    game = gym.make(spec_of(env_id).id)
    try:
        if not hasattr(game.unwrapped, "plan"):
            from progpolicy_envs import DOMAINS

            raise ValueError(f"{env_id!r} is not accepted; it has no plan(). These have: {', '.join(DOMAINS)}")
        _, info = game.reset(seed=seed, options=options)
        actions, done = list[Any](), False
        for action in game.unwrapped.plan():  # that of a Panda task looks at the state before each action
            actions.append(np.asarray(action).tolist())
            *_, terminated, truncated, info = game.step(action)
            done = terminated or truncated
            if done:
                break
        names = [str(name) for name in getattr(game.unwrapped, "action_names", ())]
        # Where nothing is left to do the plan is empty, and no step says so.
        return env_id, names, actions, not actions or bool(info.get("is_success", False))
    finally:
        game.close()


def _table(actions: Sequence[Any], names: Sequence[str]) -> Iterator[str]:
    """Yield the lines of a table: a step's number and its action, in words, or in numbers below their names."""
    width = max(len("step"), len(str(len(actions))))
    continuous = bool(actions) and isinstance(actions[0], list)
    columns = [max(len(name), 6) for name in names]
    heading = "  ".join(name.rjust(size) for name, size in zip(names, columns, strict=True)) if continuous else "action"
    yield f"{'step':>{width}}  {heading or 'action'}"
    for number, action in enumerate(actions, 1):
        if continuous:
            sizes = columns if len(columns) == len(action) else [6] * len(action)
            shown = "  ".join(f"{part:{size}.3f}" for part, size in zip(action, sizes, strict=True))
        else:
            shown = names[action] if action < len(names) else str(action)
        yield f"{number:>{width}}  {shown}"
