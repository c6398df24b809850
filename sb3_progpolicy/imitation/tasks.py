"""What is learned on, and the names of what is read and given."""

from __future__ import annotations

from typing import Any

from progpolicy_envs import find_domain
from sb3_progpolicy.imitation.rollouts import Variations


def training_variations(env_id: str, tasks: Variations | None) -> tuple[Variations, list[int]]:
    """Return the variations to learn on and the rank of each one's size.

    :param env_id: environment id
    :param tasks: variations, the easiest first; by default those that the domain is trained on
    :raises ValueError: if there are none
    """
    domain = find_domain(env_id)
    if tasks is not None and not len(tasks):
        raise ValueError("tasks=[] is not accepted; at least one variation, such as {}, is needed")
    variations: Variations = list(tasks) if tasks is not None else list(domain.train) if domain is not None else [{}]
    if domain is None or not all(domain.size in variation for variation in variations):
        return variations, [0] * len(variations)
    sizes = sorted({variation[domain.size] for variation in variations})
    return variations, [sizes.index(variation[domain.size]) for variation in variations]


def names_of(env: Any, n_outputs: int, interaction: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return readable names of a program's inputs and outputs, the environment's own where it has them.

    :param env: an environment
    :param n_outputs: of a controller
    :param interaction: whether the previous action, reward and done flag are inputs, too
    """
    n_observations = env.observation_space.shape[0]
    inputs = tuple(map(str, getattr(env.unwrapped, "observation_names", ())))
    outputs = tuple(map(str, getattr(env.unwrapped, "action_names", ())))
    if len(inputs) != n_observations:
        inputs = tuple(f"observation[{index}]" for index in range(n_observations))
    if len(outputs) != n_outputs:
        outputs = tuple(f"action[{index}]" for index in range(n_outputs))
    if interaction:
        inputs = (*inputs, *(f"previous {name}" for name in outputs), "previous reward", "previous done")
    return inputs, outputs
