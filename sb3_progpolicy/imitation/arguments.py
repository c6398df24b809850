"""The arguments of an imitation, checked before an episode is played."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_progpolicy.bounds import check_whole
from sb3_progpolicy.imitation.augmentation import STARTS
from sb3_progpolicy.imitation.recurrent import RECURRENT_CELLS

#: Of the conditions that :func:`~sb3_progpolicy.imitate` makes.
CELLS = ("affine", "min", *RECURRENT_CELLS)


def check_tasks(env_id: Any, tasks: Any) -> None:
    """Check an environment id and the variations of its tasks.

    :raises ValueError: if they are not a text and a sequence of mappings
    """
    if not isinstance(env_id, str):
        raise ValueError(f"env_id={env_id!r} is not accepted; it is the id of an environment, such as 'CartPole-v1'")
    if tasks is None:
        return
    is_sequence = isinstance(tasks, Sequence) and not isinstance(tasks, str)
    if not is_sequence or not tasks or not all(isinstance(variation, Mapping) for variation in tasks):
        raise ValueError(
            f"tasks={tasks!r} is not accepted; it is a sequence of at least one variation, such as "
            "[{'n_discs': 1}, {'n_discs': 2}]; [{}] is the environment as it is"
        )


def check_arguments(
    *,
    n_timesteps: Any,
    least_timesteps: int,
    max_conditions: Any,
    cell: Any,
    seed: Any,
    n_envs: Any,
    interaction: bool,
    ignore: Any,
    score_tolerance: float,
    plain_tolerance: float | None,
    n_episodes: Any,
    augment: Any,
    checkpoint: str | os.PathLike[str] | None,
) -> Path | None:
    """Check what :func:`~sb3_progpolicy.imitate` was given; see there.

    :param least_timesteps: that are accepted for each environment
    :return: the checkpoint as a path
    :raises ValueError: if an argument is not accepted, or would have no effect
    """
    if cell not in CELLS:
        raise ValueError(f"cell={cell!r} is not accepted; cells of imitated programs are {', '.join(CELLS)}")
    remembers, is_plain = cell in RECURRENT_CELLS, cell == "min"
    check_whole("seed", seed, 0)
    check_whole("n_envs", n_envs, 1)
    check_whole("n_timesteps", n_timesteps, least_timesteps * n_envs)
    check_whole("max_conditions", max_conditions, 0)
    if (is_plain or remembers) and max_conditions < 1:
        raise ValueError(f"cell={cell!r} is not accepted with max_conditions=0; with at least 1 it is")
    if n_episodes is not None:
        check_whole("n_episodes", n_episodes, 1)
    if plain_tolerance is not None and (is_plain or remembers):
        raise ValueError(
            f"plain_tolerance={plain_tolerance} is not accepted with cell={cell!r}: "
            + ("a plain program is taken" if is_plain else "there are no plain ones")
        )
    if not (score_tolerance >= 0 and (plain_tolerance is None or plain_tolerance >= 0)):
        raise ValueError(
            f"score_tolerance={score_tolerance} and plain_tolerance={plain_tolerance} are not accepted; shares of at "
            "least 0 are"
        )
    if isinstance(ignore, str) or not all(isinstance(name, str) for name in ignore):
        raise ValueError(f"ignore={ignore!r} is not accepted; it is a sequence of names of inputs, such as ('left',)")
    _check_augment(augment, interaction, cell if remembers else None)
    return _checked_path(checkpoint, cell if remembers else None)


def _check_augment(augment: Any, interaction: bool, recurrent: str | None) -> None:
    if augment is None:
        return
    if not (isinstance(augment, str) or callable(augment)):
        raise ValueError(
            f"augment={augment!r} is not accepted; it is a name or a function of observations and a generator"
        )
    if recurrent is not None:
        raise ValueError(
            f"augment={augment!r} is not accepted with cell={recurrent!r}: a state that was not visited has no past"
        )
    if interaction and augment not in STARTS:
        raise ValueError(
            f"augment={augment!r} is not accepted with interaction=True: an observation that was changed has no "
            "previous action and reward"
        )


def _checked_path(checkpoint: str | os.PathLike[str] | None, recurrent: str | None) -> Path | None:
    if checkpoint is None:
        return None
    if recurrent is not None:
        raise ValueError(
            f"checkpoint={str(checkpoint)!r} is not accepted with cell={recurrent!r}: the state of such an imitation "
            "is not kept"
        )
    path = Path(checkpoint)
    if not path.parent.is_dir():
        raise ValueError(f"checkpoint={str(checkpoint)!r} is not accepted: there is no folder {path.parent}")
    return path
