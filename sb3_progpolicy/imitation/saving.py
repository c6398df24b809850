"""The state of an imitation in a file, so that an interrupted one goes on as if nothing had happened."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_progpolicy.imitation.candidates import Plain, Scored
from sb3_progpolicy.imitation.decision_list import DecisionList, Floats
from sb3_progpolicy.programs.files import write_atomically


@dataclass(frozen=True)
class State:
    """All that an imitation knows between two rounds.

    :param number: rounds that are done
    :param next_seed: of the next episode
    :param generators: states of NumPy's generators, by name
    :param observations: labelled states, ``(n, n_inputs)``
    :param targets: their labels, ``(n, n_outputs)``
    :param weights: ``(n,)``
    :param present: the present list
    :param plain: the best plain lists
    :param best: score and list; ``None`` before the first validation
    :param runners_up: the best few with their scores
    :param result: of the best list in its validation
    :param reference: value of the best list before it was made smaller
    :param has_goal: whether an episode that was visited told of success
    """

    number: int
    next_seed: int
    generators: Mapping[str, Any]
    observations: np.ndarray
    targets: Floats
    weights: Floats
    present: DecisionList | None
    plain: tuple[Plain, ...]
    best: Scored | None
    runners_up: tuple[Scored, ...]
    result: Mapping[str, float]
    reference: float
    has_goal: bool


def save_state(path: Path, origin: Mapping[str, Any], state: State) -> None:
    """Write a state.

    :param path: of the file
    :param origin: what the imitation is of
    :param state: to write
    """
    scored = [*([state.best] if state.best is not None else []), *state.runners_up]
    lists = {f"scored{index}": program for index, (_, program) in enumerate(scored)}
    lists.update({f"plain{index}": plain.candidate for index, plain in enumerate(state.plain)})
    if state.present is not None:
        lists["present"] = state.present
    arrays: dict[str, Any] = {
        f"{name}_{part}": getattr(program, part)
        for name, program in lists.items()
        for part in ("conditions", "controllers", "owners")
    }
    about = {
        "origin": _as_json(origin),
        "number": state.number,
        "next_seed": state.next_seed,
        "generators": state.generators,
        "has_best": state.best is not None,
        "scores": [score for score, _ in scored],
        "plain": [(plain.scores, plain.n_lost, plain.refused) for plain in state.plain],
        "result": dict(state.result),
        "reference": state.reference,
        "has_goal": state.has_goal,
    }
    content = io.BytesIO()
    np.savez_compressed(
        content,
        about=np.array(json.dumps(about)),
        observations=state.observations,
        targets=state.targets,
        weights=state.weights,
        **arrays,
    )
    write_atomically(path, content.getvalue())


def load_state(path: Path, origin: Mapping[str, Any]) -> State:
    """Read a state.

    :param path: of the file
    :param origin: what the imitation is of
    :raises ValueError: if the file is of another imitation or is damaged
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            parts = {name: arrays[name] for name in arrays.files}
        about = json.loads(str(parts["about"]))
        known = about["origin"]
        scored = [(score, _list(parts, f"scored{index}")) for index, score in enumerate(about["scores"])]
        state = State(
            number=about["number"],
            next_seed=about["next_seed"],
            generators=about["generators"],
            observations=parts["observations"],
            targets=parts["targets"],
            weights=parts["weights"],
            present=_list(parts, "present") if "present_controllers" in parts else None,
            plain=tuple(
                Plain(_list(parts, f"plain{index}"), tuple(scores), n_lost, refused)
                for index, (scores, n_lost, refused) in enumerate(about["plain"])
            ),
            best=scored[0] if about["has_best"] else None,
            runners_up=tuple(scored[int(about["has_best"]) :]),
            result=about["result"],
            reference=about["reference"],
            has_goal=about["has_goal"],
        )
    except (OSError, EOFError, ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path} is not the state of an imitation: {error}; remove it to begin anew") from None
    given = _as_json(origin)
    different = [name for name in {**known, **given} if known.get(name) != given.get(name)]
    if different:
        raise ValueError(
            f"{path} is of an imitation with another {', '.join(different)}; give the same arguments, or remove it to "
            "begin anew"
        )
    return state


def _as_json(origin: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a file gives back when it has been written and read."""
    return dict(json.loads(json.dumps(dict(origin), default=str)))


def _list(parts: Mapping[str, Any], name: str) -> DecisionList:
    given = ("conditions", "controllers", "owners")
    return DecisionList(*(parts[f"{name}_{part}"] for part in given if f"{name}_{part}" in parts))
