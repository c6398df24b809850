"""What is learned on, and the names of what is read and given."""

from __future__ import annotations

from typing import Any

from progpolicy_envs import find_domain
from sb3_progpolicy.imitation.rollouts import Variations
from sb3_progpolicy.names import Names, readable_names
from sb3_progpolicy.reptile.options import refuse_starts


def training_variations(env_id: str, tasks: Variations | None) -> tuple[Variations, list[int]]:
    """Return the variations to learn on and the rank of each one's size.

    :param env_id: environment id
    :param tasks: variations, the easiest first; by default those that the domain is trained on
    :raises ValueError: if there are none, or one gives a part of a start
    """
    domain = find_domain(env_id)
    if tasks is not None and not len(tasks):
        raise ValueError("tasks=[] is not accepted; at least one variation, such as {}, is needed")
    refuse_starts(env_id, tasks or ())
    variations: Variations = list(tasks) if tasks is not None else list(domain.train) if domain is not None else [{}]
    if domain is None or not all(domain.size in variation for variation in variations):
        return variations, [0] * len(variations)
    sizes = sorted({variation[domain.size] for variation in variations})
    return variations, [sizes.index(variation[domain.size]) for variation in variations]


def validation_variations(env_id: str) -> Variations:
    """Return the variations that a domain has for choosing: one size beyond those it is trained on; none elsewhere."""
    domain = find_domain(env_id)
    return () if domain is None else domain.validation


def names_of(env: Any, n_outputs: int, interaction: bool) -> Names:
    """Return readable names of a program's inputs and outputs, see :func:`~sb3_progpolicy.names.readable_names`.

    :param env: an environment
    :param n_outputs: of a controller
    :param interaction: whether the previous action, reward and done flag are inputs, too
    """
    return readable_names(
        getattr(env.unwrapped, "observation_names", None),
        getattr(env.unwrapped, "action_names", None),
        getattr(env.spec, "id", None),
        env.observation_space.shape[0],
        n_outputs,
        interaction,
    )
