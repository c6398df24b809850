"""Readable names of what a program reads and says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple


class Names(NamedTuple):
    """Names of an environment's observation and of its actions, or of the numbers of a continuous action."""

    observations: tuple[str, ...]
    actions: tuple[str, ...]


_POSITION = ("position", "velocity")
#: Of Gymnasium's environments, which have no names of their own, in the order of their documentation.
GYMNASIUM_NAMES: Mapping[str, Names] = {
    "CartPole": Names(
        ("cart position", "cart velocity", "pole angle", "pole velocity"),
        ("push left", "push right"),
    ),
    "Acrobot": Names(
        ("cos angle 1", "sin angle 1", "cos angle 2", "sin angle 2", "velocity 1", "velocity 2"),
        ("torque -1", "torque 0", "torque +1"),
    ),
    "MountainCar": Names(_POSITION, ("push left", "no push", "push right")),
    "MountainCarContinuous": Names(_POSITION, ("force",)),
    "Pendulum": Names(("cos angle", "sin angle", "velocity"), ("torque",)),
    "LunarLander": Names(
        ("x", "y", "x velocity", "y velocity", "angle", "angular velocity", "left leg", "right leg"),
        ("no engine", "left engine", "main engine", "right engine"),
    ),
    "LunarLanderContinuous": Names(
        ("x", "y", "x velocity", "y velocity", "angle", "angular velocity", "left leg", "right leg"),
        ("main engine", "side engines"),
    ),
}


def readable_names(
    observations: Sequence[Any] | None,
    actions: Sequence[Any] | None,
    env_id: str | None,
    n_observations: int,
    n_outputs: int,
    history: bool,
) -> Names:
    """Return names of a program's inputs and outputs.

    They are the environment's own if it has as many as are needed, else those of :data:`GYMNASIUM_NAMES`, else
    ``observation[i]`` and ``action[i]``.

    :param observations: the environment's ``observation_names``; ``None`` if it has none
    :param actions: its ``action_names``; ``None`` if it has none
    :param env_id: its registered id; ``None`` if it is not known
    :param n_observations: length of an observation
    :param n_outputs: of a controller
    :param history: whether the previous action, reward and done flag are inputs, too
    :return: a name for each input, and one for each output
    """
    known = GYMNASIUM_NAMES.get((env_id or "").rpartition(":")[2].rpartition("-v")[0], Names((), ()))
    inputs = _fitting(observations, known.observations, "observation", n_observations)
    outputs = _fitting(actions, known.actions, "action", n_outputs)
    if history:
        inputs = (*inputs, *(f"previous {name}" for name in outputs), "previous reward", "previous done")
    return Names(inputs, outputs)


def _fitting(own: Sequence[Any] | None, known: tuple[str, ...], kind: str, number: int) -> tuple[str, ...]:
    for names in (tuple(map(str, own if own is not None else ())), known):
        if len(names) == number:
            return names
    return tuple(f"{kind}[{index}]" for index in range(number))


def check_ignored(ignore: Sequence[str], inputs: Sequence[str], default: Sequence[str] = ()) -> None:
    """Check the names of inputs that are not to be read.

    :param ignore: the names
    :param inputs: names of all
    :param default: names that may be missing
    :raises ValueError: if there is no input of a name, or none is left
    """
    if missing := [name for name in ignore if name not in inputs and name not in default]:
        raise ValueError(f"ignore: there is no input {', '.join(missing)}; the inputs are {', '.join(inputs)}")
    if set(inputs) <= set(ignore):
        raise ValueError(f"ignore={tuple(ignore)} is not accepted: it leaves no input")
