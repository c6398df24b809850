"""The domains: what makes their environments, which variations to train on, and which to test on.

Registration, the plugin, the benchmark and the docs read them from here; no other file lists ids.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import product
from typing import Any

from progpolicy_envs.variation import Variation


@dataclass(frozen=True)
class Domain:
    """One task domain.

    :param id: environment id
    :param entry_point: what makes one environment, as ``module:name``
    :param vector_entry_point: what makes a batch of them, as ``module:name``
    :param size: name of the parameter that makes tasks harder, such as ``n_discs``
    :param train: the variations to train on, the easiest first
    :param unseen: the variations to test generalisation on
    :param arguments: constructor arguments with which the id is registered
    :param simulation: whether its steps are physics, so costly that several processes are worth having
    """

    id: str
    entry_point: str
    vector_entry_point: str
    size: str
    train: tuple[Variation, ...]
    unseen: tuple[Variation, ...]
    arguments: Mapping[str, Any] = field(default_factory=dict)
    simulation: bool = False


DOMAINS: dict[str, Domain] = {
    domain.id: domain
    for domain in (
        Domain(
            id="Hanoi-v0",
            entry_point="progpolicy_envs.hanoi:HanoiEnv",
            vector_entry_point="progpolicy_envs.hanoi:HanoiVectorEnv",
            size="n_discs",
            train=tuple({"n_discs": n_discs, "source": "random", "target": "random"} for n_discs in (1, 2, 3, 4)),
            unseen=tuple({"n_discs": n_discs} for n_discs in (5, 6, 7, 8)),
        ),
        Domain(
            id="Hiking-v0",
            entry_point="progpolicy_envs.hiking:HikingEnv",
            vector_entry_point="progpolicy_envs.hiking:HikingVectorEnv",
            size="n_stars",
            train=tuple({"n_stars": n_stars} for n_stars in (1, 2, 3, 4)),
            unseen=tuple({"n_stars": n_stars} for n_stars in (5, 6, 7, 8, 9, 10)),
        ),
        # From the hiker's point of view: what is learned on some maps is tested on others.
        Domain(
            id="HikingEgo-v0",
            entry_point="progpolicy_envs.hiking:HikingEgoEnv",
            vector_entry_point="progpolicy_envs.hiking:HikingEgoVectorEnv",
            size="n_stars",
            train=tuple(
                {"n_stars": n_stars, "layout": layout}
                for n_stars, layout in product((1, 2, 3, 4), ("valley", "comb", "fork"))
            ),
            unseen=tuple(
                {"n_stars": n_stars, "layout": layout}
                for n_stars, layout in product((5, 6, 7, 8, 9, 10), ("spiral", "lakeside", "random"))
            ),
        ),
        Domain(
            id="Stacking-v0",
            entry_point="progpolicy_envs.stacking:StackingEnv",
            vector_entry_point="progpolicy_envs.stacking:StackingVectorEnv",
            size="n_plates",
            train=tuple({"n_plates": n_plates} for n_plates in (1, 2, 3, 4)),
            unseen=tuple({"n_plates": n_plates} for n_plates in (5, 6, 7, 8)),
        ),
        *(
            Domain(
                id=f"Panda{task}-v0",
                entry_point=f"progpolicy_envs.panda:make_{task.lower()}",
                vector_entry_point=f"progpolicy_envs.panda.vector:Panda{task}VectorEnv",
                size=size,
                train=tuple({size: number} for number in (1, 2, 3)),
                unseen=tuple({size: number} for number in (4, 5, 6, 7, 8)),
                simulation=True,
            )
            for task, size in (
                ("Reach", "n_targets"),
                ("Push", "n_objects"),
                ("Slide", "n_objects"),
                ("Stack", "n_objects"),
            )
        ),
    )
}


def get_domain(env_id: str) -> Domain:
    """Return the domain of an environment id.

    :param env_id: such as ``"Hanoi-v0"``, with or without a module prefix (``"progpolicy_envs:Hanoi-v0"``)
    :raises ValueError: if this package has no such environment; the message names the nearest ids
    """
    name = env_id.rpartition(":")[2]
    if name not in DOMAINS:
        near = get_close_matches(name, DOMAINS, n=3, cutoff=0.3) or list(DOMAINS)
        raise ValueError(f"{env_id!r} is not one of this package's environments; nearest: {', '.join(near)}")
    return DOMAINS[name]
