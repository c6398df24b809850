"""The domains: what makes their environments, and which variations to train on, to choose by, and to test on.

Registration, the plugin, the benchmark and the docs read them from here; no other file lists ids. A domain of your own
joins them by :func:`register_domain`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import product
from numbers import Real
from typing import Any, Literal

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from progpolicy_envs.symmetry import Grid, Symmetry
from progpolicy_envs.variation import Variation, VariationSpace

#: How a variation stands to those trained on: one of them, between them, beyond them, or smaller than all of them.
Relation = Literal["trained", "interpolated", "extrapolated", "easier"]


@dataclass(frozen=True)
class Domain:
    """One task domain.

    :param id: environment id
    :param size: name of the parameter that makes tasks harder, such as ``n_discs``; a number
    :param train: the variations to train on, the easiest first
    :param validation: the variations to choose hyperparameters and checkpoints by: one size beyond training
    :param unseen: the variations to test generalisation on, which nothing is chosen by
    :param entry_point: what makes one environment, as ``module:name``; empty where the id is registered elsewhere
    :param vector_entry_point: what makes a batch of them, as ``module:name``; empty for none
    :param arguments: constructor arguments with which the id is registered
    :param simulation: whether its steps are physics, so costly that several processes are worth having
    :raises ValueError: if a set is empty, a variation does not give the size, or one is in two sets
    """

    id: str
    size: str
    train: tuple[Variation, ...]
    validation: tuple[Variation, ...]
    unseen: tuple[Variation, ...]
    entry_point: str = ""
    vector_entry_point: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    simulation: bool = False

    def __post_init__(self) -> None:
        sets = {"train": self.train, "validation": self.validation, "unseen": self.unseen}
        for name, variations in sets.items():
            if not variations:
                raise ValueError(f"{name}={variations!r} is not accepted; {self.id} needs at least one variation there")
            for variation in variations:
                if not isinstance(variation, Mapping):
                    raise ValueError(
                        f"{name}={variations!r} is not accepted; it is a sequence of mappings from parameters to values"
                    )
                size = variation.get(self.size)
                if isinstance(size, bool) or not isinstance(size, Real):
                    raise ValueError(
                        f"{name}: {variation!r} is not accepted; it gives {self.size!r}, the size, as a number"
                    )
        for one, other in (("train", "validation"), ("train", "unseen"), ("validation", "unseen")):
            for variation in sets[one]:
                if variation in sets[other]:
                    raise ValueError(f"{variation!r} is not accepted in both {one} and {other}")

    @property
    def space(self) -> VariationSpace | None:
        """The parameters: their kinds, bounds and defaults; ``None`` if the environment does not declare them."""
        space = self._declared("variations", None)
        return space if isinstance(space, VariationSpace) else None

    @property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Generators of the symmetries under which the rules do not change; none if none are declared."""
        return tuple(self._declared("symmetries", ()))

    @property
    def grids(self) -> tuple[Grid, ...]:
        """The blocks of an observation that lie on a grid."""
        return tuple(self._declared("grids", ()))

    def _declared(self, name: str, default: Any) -> Any:
        """Return what the environment's class declares under a name."""
        creator = load_env_creator(self.entry_point) if self.entry_point else gym.spec(self.id).entry_point
        if isinstance(creator, str):
            creator = load_env_creator(creator)
        return getattr(creator, name, default)

    @property
    def trained(self) -> tuple[Variation, ...]:
        """The training variations in the form in which they are tested: with the parameters of the unseen ones.

        What is drawn anew for each episode in training, such as Hanoi's pegs, is at its default in tests.
        """
        names = self.unseen[0]
        tested = ({name: value for name, value in variation.items() if name in names} for variation in self.train)
        return tuple(dict(pairs) for pairs in dict.fromkeys(tuple(variation.items()) for variation in tested))

    def relation(self, variation: Variation, trained: Sequence[Variation] | None = None) -> Relation:
        """Return how a variation stands to those trained on.

        Parameters that only one of two variations gives are not compared. One of a trained size that differs
        otherwise, such as another map, is extrapolated.

        :param variation: to be tested
        :param trained: trained on; :attr:`train` by default
        """
        trained, size = self.train if trained is None else trained, variation[self.size]
        sizes = [known[self.size] for known in trained]
        if size < min(sizes):
            return "easier"
        if any(all(known.get(name, value) == value for name, value in variation.items()) for known in trained):
            return "trained"
        return "interpolated" if size < max(sizes) and size not in sizes else "extrapolated"


DOMAINS: dict[str, Domain] = {
    domain.id: domain
    for domain in (
        Domain(
            id="Hanoi-v0",
            entry_point="progpolicy_envs.hanoi:HanoiEnv",
            vector_entry_point="progpolicy_envs.hanoi:HanoiVectorEnv",
            size="n_discs",
            train=tuple({"n_discs": n_discs, "source": "random", "target": "random"} for n_discs in (1, 2, 3, 4)),
            validation=({"n_discs": 5},),
            unseen=tuple({"n_discs": n_discs} for n_discs in (6, 7, 8)),
        ),
        *(
            Domain(
                id=f"Hiking-{version}",
                entry_point=f"progpolicy_envs.hiking:{name}Env",
                vector_entry_point=f"progpolicy_envs.hiking:{name}VectorEnv",
                size="n_stars",
                train=tuple({"n_stars": n_stars} for n_stars in (1, 2, 3, 4)),
                validation=({"n_stars": 5},),
                unseen=tuple({"n_stars": n_stars} for n_stars in (6, 7, 8, 9, 10)),
            )
            for version, name in (("v0", "HikingV0"), ("v1", "Hiking"))
        ),
        # From the hiker's point of view: what is learned on generated maps is tested on others. On a few maps the
        # window tells where the hiker is, and what is learned is these maps by heart.
        Domain(
            id="HikingEgo-v0",
            entry_point="progpolicy_envs.hiking:HikingEgoEnv",
            vector_entry_point="progpolicy_envs.hiking:HikingEgoVectorEnv",
            size="n_stars",
            train=tuple({"n_stars": n_stars, "layout": "practice"} for n_stars in (1, 2, 3, 4)),
            validation=tuple({"n_stars": 5, "layout": layout} for layout in ("valley", "comb", "fork")),
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
            validation=({"n_plates": 5},),
            unseen=tuple({"n_plates": n_plates} for n_plates in (6, 7, 8)),
        ),
        *(
            Domain(
                id=f"Panda{task}-v0",
                entry_point=f"progpolicy_envs.panda:make_{task.lower()}",
                vector_entry_point=f"progpolicy_envs.panda.vector:Panda{task}VectorEnv",
                size=size,
                train=tuple({size: number} for number in (1, 2, 3)),
                validation=({size: 4},),
                unseen=tuple({size: number} for number in (5, 6, 7, 8)),
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


def find_domain(env_id: str | None) -> Domain | None:
    """Return the domain of an environment id, ``None`` if it is of none.

    :param env_id: with or without a module prefix; ``None`` where it is not known
    """
    return DOMAINS.get((env_id or "").rpartition(":")[2])


def get_domain(env_id: str) -> Domain:
    """Return the domain of an environment id.

    :param env_id: such as ``"Hanoi-v0"``, with or without a module prefix (``"progpolicy_envs:Hanoi-v0"``)
    :raises ValueError: if this package has no such environment; the message names the nearest ids
    """
    domain = find_domain(env_id)
    if domain is None:
        near = get_close_matches(env_id.rpartition(":")[2], DOMAINS, n=3, cutoff=0.3) or list(DOMAINS)
        raise ValueError(f"{env_id!r} is not one of this package's environments; nearest: {', '.join(near)}")
    return domain


def register_domain(
    id: str,
    size: str,
    train: Sequence[Mapping[str, Any]],
    validation: Sequence[Mapping[str, Any]],
    unseen: Sequence[Mapping[str, Any]],
    simulation: bool = False,
) -> Domain:
    """Declare the variations of an environment of your own, so that training, tuning and the benchmark know them.

    .. code-block:: python

        gym.register("Corridor-v0", entry_point="corridor:CorridorEnv", max_episode_steps=100)
        register_domain("Corridor-v0", "length", train=[{"length": 3}, {"length": 4}],
                        validation=[{"length": 5}], unseen=[{"length": 8}, {"length": 12}])

    Call it in the module that registers the id: other processes find both by importing it, as
    ``"corridor:Corridor-v0"``.

    :param id: a registered id, without a module prefix
    :param size: name of the parameter that makes tasks harder
    :param train: the variations to train on, the easiest first
    :param validation: the variations to choose hyperparameters by
    :param unseen: the variations to test on
    :param simulation: whether its steps are so costly that several processes are worth having
    :return: the domain, which is in :data:`DOMAINS` now; one of the same id is replaced, unless it is this package's
    :raises ValueError: if the id is not registered or is one of this package's, or a variation is not accepted
    """
    if id not in gym.registry:
        raise ValueError(f"id={id!r} is not registered; call gym.register first, and give the id without its module")
    if id in DOMAINS and DOMAINS[id].entry_point:
        raise ValueError(f"id={id!r} is not accepted; this package has a domain of this name")
    train, validation, unseen = (tuple(dict(one) for one in variations) for variations in (train, validation, unseen))
    domain = Domain(id, size, train, validation, unseen, simulation=simulation)
    if (space := domain.space) is not None:
        for variation in (*train, *validation, *unseen):
            space.parse(variation)
    DOMAINS[id] = domain
    return domain
