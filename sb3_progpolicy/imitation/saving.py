"""The state of an imitation in a file, so that an interrupted one goes on."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_progpolicy.imitation.decision_list import DecisionList
from sb3_progpolicy.programs.files import write_atomically

if TYPE_CHECKING:
    from sb3_progpolicy.imitation.learner import Learner

Best = tuple[float, DecisionList] | None


def save_state(
    path: Path, origin: Mapping[str, Any], number: int, learner: Learner, best: Best, next_seed: int
) -> None:
    """Write labelled states, the present list and the best one.

    :param path: of the file
    :param origin: what the imitation is of
    :param number: rounds that are done
    :param learner: the student
    :param best: score and list
    :param next_seed: of the next episode
    """
    lists: dict[str, DecisionList | None] = {"present": learner.raw, "best": None if best is None else best[1]}
    arrays: dict[str, Any] = {
        f"{name}_{part}": getattr(program, part)
        for name, program in lists.items()
        if program is not None
        for part in ("conditions", "controllers")
    }
    score = None if best is None else best[0]
    about = {"origin": _as_json(origin), "number": number, "score": score, "next_seed": next_seed}
    content = io.BytesIO()
    np.savez_compressed(
        content,
        about=np.array(json.dumps(about)),
        observations=learner.observations,
        targets=learner.targets.astype(np.float32),
        weights=learner.weights.astype(np.float32),
        **arrays,
    )
    write_atomically(path, content.getvalue())


def load_state(path: Path, origin: Mapping[str, Any], learner: Learner) -> tuple[int, Best, int]:
    """Put a saved state into a student.

    :param path: of the file
    :param origin: what the imitation is of
    :param learner: the student
    :return: rounds that are done, the best score and list, the seed of the next episode
    :raises ValueError: if the file is of another imitation or is damaged
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            parts = {name: arrays[name] for name in arrays.files}
        about = json.loads(str(parts["about"]))
        known = about["origin"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not the state of an imitation: {error}; remove it to begin anew") from None
    given = _as_json(origin)
    different = [name for name in {**known, **given} if known.get(name) != given.get(name)]
    if different:
        raise ValueError(
            f"{path} is of an imitation with another {', '.join(different)}; give the same arguments, or remove it to "
            "begin anew"
        )
    learner.observations = parts["observations"]
    learner.targets, learner.weights = parts["targets"].astype(np.float64), parts["weights"].astype(np.float64)
    learner.rng = np.random.default_rng((learner.settings.seed, about["number"]))
    learner.raw = _list(parts, "present")
    best = _list(parts, "best")
    return about["number"], None if best is None else (about["score"], best), about["next_seed"]


def _as_json(origin: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a file gives back when it has been written and read."""
    return dict(json.loads(json.dumps(dict(origin), default=str)))


def _list(parts: Mapping[str, Any], name: str) -> DecisionList | None:
    if f"{name}_conditions" not in parts:
        return None
    return DecisionList(parts[f"{name}_conditions"], parts[f"{name}_controllers"])
