"""Samplers: in which order the variations of a task distribution are drawn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray


class Sampler(ABC):
    """Decides which variation comes next."""

    #: Which statistics of the variations :meth:`weights` is given: an attribute of ``TaskDistribution``.
    reads: ClassVar[Literal["success_rates", "learning_progress"]] = "success_rates"

    @abstractmethod
    def weights(self, n_variations: int, progress: float, statistics: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how likely each variation is, up to a factor.

        :param n_variations: how many there are, ordered from the easiest
        :param progress: of the training, from 0 to 1
        :param statistics: what :attr:`reads` names: the running success rate of each variation, or its learning
            progress; NaN where it has not been tried
        :return: ``(n_variations,)``, non-negative, not all 0
        """


@dataclass(frozen=True)
class UniformSampler(Sampler):
    """Every variation is equally likely."""

    def weights(self, n_variations: int, progress: float, statistics: NDArray[np.float64]) -> NDArray[np.float64]:
        """See :meth:`Sampler.weights`."""
        return np.ones(n_variations)


@dataclass(frozen=True)
class CurriculumSampler(Sampler):
    """Starts with the easiest variation and lets in the others one by one, in order.

    :param fraction: of the training, above 0 and up to 1, after which all of them are in
    """

    fraction: float = 0.7

    def __post_init__(self) -> None:
        if not 0 < self.fraction <= 1:
            raise ValueError(f"fraction={self.fraction} is not accepted; it is above 0 and at most 1")

    def weights(self, n_variations: int, progress: float, statistics: NDArray[np.float64]) -> NDArray[np.float64]:
        """See :meth:`Sampler.weights`."""
        n_in = 1 + int(n_variations * progress / self.fraction)
        return (np.arange(n_variations) < n_in).astype(np.float64)


@dataclass(frozen=True)
class FailureSampler(Sampler):
    """The more often a variation fails, the likelier it is.

    :param floor: weight of a variation that never fails, above 0; one that always fails, or is new, has ``1 + floor``
    """

    floor: float = 0.1

    def __post_init__(self) -> None:
        if not self.floor > 0:
            raise ValueError(f"floor={self.floor} is not accepted; it is above 0")

    def weights(self, n_variations: int, progress: float, statistics: NDArray[np.float64]) -> NDArray[np.float64]:
        """See :meth:`Sampler.weights`."""
        return 1 + self.floor - np.nan_to_num(statistics, nan=0.0)


@dataclass(frozen=True)
class ProgressSampler(Sampler):
    """The faster a variation's success changes, up or down, the likelier it is (Matiisen et al., 2017).

    What is learnt now and what is being forgotten comes often; what is mastered and what is too hard yet does not. The
    measure is absolute learning progress, as in *Teacher-Student Curriculum Learning* and in Portelas et al. (2019,
    *Teacher algorithms for curriculum learning of Deep RL in continuously parameterized environments*): the distance of
    a newer running mean of the success from an older one, or of the return where success is not told. Those not
    tried yet are as likely as the likeliest.

    :param floor: share of the draws, above 0 and up to 1, that is the same for all variations
    """

    floor: float = 0.2
    reads = "learning_progress"

    def __post_init__(self) -> None:
        if not 0 < self.floor <= 1:
            raise ValueError(f"floor={self.floor} is not accepted; it is above 0 and at most 1")

    def weights(self, n_variations: int, progress: float, statistics: NDArray[np.float64]) -> NDArray[np.float64]:
        """See :meth:`Sampler.weights`."""
        tried = statistics[np.isfinite(statistics)]
        changes = np.nan_to_num(statistics, nan=(tried.max(initial=0.0) or 1.0))
        if not changes.any():
            return np.ones(n_variations)
        return self.floor / n_variations + (1 - self.floor) * changes / changes.sum()


SAMPLERS: dict[str, type[Sampler]] = {
    "uniform": UniformSampler,
    "curriculum": CurriculumSampler,
    "failure": FailureSampler,
    "progress": ProgressSampler,
}


def make_sampler(given: str | Mapping[str, Any] | Sampler) -> Sampler:
    """Return a sampler.

    :param given: the name of one, a mapping of ``name`` and the sampler's arguments, or a sampler
    :raises ValueError: if there is none of that name, or it does not take the arguments
    """
    if isinstance(given, Sampler):
        return given
    arguments = dict(given) if isinstance(given, Mapping) else {"name": given}
    name = arguments.pop("name", None)
    if not isinstance(name, str) or name not in SAMPLERS:
        raise ValueError(f"sampler={given!r:.80} is not accepted; known samplers: {', '.join(SAMPLERS)}")
    accepted = getattr(SAMPLERS[name], "__dataclass_fields__", {})
    for argument, value in arguments.items():
        if argument not in accepted:
            raise ValueError(
                f"sampler: {argument}={value!r:.40} is not accepted; {name} takes {', '.join(accepted) or 'nothing'}"
            )
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"sampler: {argument}={value!r:.40} is not accepted; it is a number")
    return SAMPLERS[name](**arguments)
