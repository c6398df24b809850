"""Task distributions: the variations to train on, and in which order they are drawn."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from progpolicy_envs import find_domain
from sb3_progpolicy.reptile.options import ReadOptions, constructor_arguments, unread_names

Variation = dict[str, Any]
Draw = Callable[[np.random.Generator], Any]
Apply = Literal["options", "attributes", "constructor"]
APPLY: tuple[Apply, ...] = ("options", "attributes", "constructor")
MAX_LABEL = 30  # characters that SB3's table of logs shows


class Sampler(ABC):
    """Decides which variation comes next."""

    @abstractmethod
    def weights(self, n_variations: int, progress: float, success_rates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how likely each variation is, up to a factor.

        :param n_variations: how many there are, ordered from the easiest
        :param progress: of the training, from 0 to 1
        :param success_rates: running success rate of each variation, NaN where it has not been tried
        :return: ``(n_variations,)``, non-negative, not all 0
        """


@dataclass(frozen=True)
class UniformSampler(Sampler):
    """Every variation is equally likely."""

    def weights(self, n_variations: int, progress: float, success_rates: NDArray[np.float64]) -> NDArray[np.float64]:
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

    def weights(self, n_variations: int, progress: float, success_rates: NDArray[np.float64]) -> NDArray[np.float64]:
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

    def weights(self, n_variations: int, progress: float, success_rates: NDArray[np.float64]) -> NDArray[np.float64]:
        """See :meth:`Sampler.weights`."""
        return 1 + self.floor - np.nan_to_num(success_rates, nan=0.0)


SAMPLERS: dict[str, type[Sampler]] = {
    "uniform": UniformSampler,
    "curriculum": CurriculumSampler,
    "failure": FailureSampler,
}


class TaskDistribution:
    """The distribution over tasks p(T) of algorithm 1: which variations of an environment to train on.

    .. code-block:: python

        TaskDistribution({"n_discs": [1, 2, 3, 4]})                           # every combination of the values
        TaskDistribution([{"n_discs": 1}, {"n_discs": 3}], sampler="curriculum")
        TaskDistribution({"length": lambda rng: rng.uniform(0.3, 1.0)}, apply="attributes")

    :param variations: a mapping from parameter to values (a sequence, a ``range``, or a callable that draws a value
        from a ``numpy.random.Generator``), of which all combinations are taken; or a sequence of such mappings from
        parameter to one value, the same parameters in all. Order them from the easiest for a curriculum.
    :param sampler: ``"uniform"``, ``"curriculum"``, ``"failure"`` or a :class:`Sampler`
    :param apply: how a variation is put in force: ``"options"`` by ``reset(options=...)``, which the environment must
        keep in force over the episodes that follow, as all of ``progpolicy_envs`` do; ``"attributes"`` by setting
        attributes of the environment, ``"constructor"`` by making the environment anew (see
        :class:`RemakeOnVariation`)
    :param check: whether training begins with a check that no two variations are the same, see
        :func:`~sb3_progpolicy.reptile.checks.check_variations`
    :raises ValueError: if there is no variation, a name is not known, or some variations leave a parameter out (which
        is accepted with ``apply="constructor"`` alone, where it has its default value)
    """

    #: Weight of the newest episodes in the running success rates.
    SUCCESS_SMOOTHING = 0.2
    check = True  # of those saved by release 0.1

    def __init__(
        self,
        variations: Mapping[str, Any] | Sequence[Mapping[str, Any]],
        sampler: str | Sampler = "uniform",
        apply: Apply = "options",
        check: bool = True,
    ) -> None:
        self.variations = _enumerate(variations)
        if not self.variations:
            raise ValueError(f"variations={variations!r} is not accepted; at least one variation is needed")
        if isinstance(sampler, str):
            if sampler not in SAMPLERS:
                raise ValueError(f"sampler={sampler!r} is not accepted; known samplers: {', '.join(SAMPLERS)}")
            sampler = SAMPLERS[sampler]()
        if apply not in APPLY:
            raise ValueError(f"apply={apply!r} is not accepted; known: {', '.join(APPLY)}")
        names = [set(variation) for variation in self.variations]
        if apply != "constructor" and any(given != names[0] for given in names):
            left_out = sorted(name for name in set[str]().union(*names) if any(name not in given for given in names))
            raise ValueError(
                f"variations={variations!r} is not accepted; some of them leave out {', '.join(left_out)}, which would "
                "stay what the task before made it. Give every variation a value for it"
            )
        self.sampler, self.apply, self.check = sampler, apply, check
        self.success_rates = np.full(len(self.variations), np.nan)

    def __len__(self) -> int:
        return len(self.variations)

    def split(
        self, validation: float | int = 0.2, unseen: float | int = 0.2, seed: int = 0
    ) -> tuple[TaskDistribution, tuple[Variation, ...], tuple[Variation, ...]]:
        """Split the variations by chance into those to train on, to choose by and to test on.

        :param validation: how many to choose hyperparameters by: a share, 0 to 1, or a number
        :param unseen: how many to test on, likewise
        :param seed: of the draw
        :return: the distribution of the others, in the order that they have here; the validation variations; the unseen
        :raises ValueError: if a number is not accepted, nothing is left to train on, or values are drawn (callables)
        """
        if any(callable(value) for variation in self.variations for value in variation.values()):
            raise ValueError("variations whose values are drawn cannot be split; give lists of values")
        counts = []
        for name, part in (("validation", validation), ("unseen", unseen)):
            count = round(part * len(self)) if isinstance(part, float) else part
            if isinstance(part, bool) or not count >= 0 or (isinstance(part, float) and not 0 <= part <= 1):
                raise ValueError(f"{name}={part!r} is not accepted; it is a share from 0.0 to 1.0, or a whole number")
            counts.append(count)
        if sum(counts) >= len(self):
            raise ValueError(
                f"validation={validation} and unseen={unseen} leave none of {len(self)} variations to train on"
            )
        order = np.random.default_rng(seed).permutation(len(self)).tolist()
        first, second = counts[0], sum(counts)
        held = [sorted(order[:first]), sorted(order[first:second])]
        train = [self.variations[index] for index in sorted(order[second:])]
        chosen, tested = (tuple(self.variations[index] for index in indices) for indices in held)
        return TaskDistribution(train, self.sampler, self.apply, self.check), chosen, tested

    def sample(self, rng: np.random.Generator, progress: float = 0.0, n_tasks: int = 1) -> list[tuple[int, Variation]]:
        """Draw tasks, of different variations as long as the sampler lets in enough of them.

        :param rng: source of all randomness
        :param progress: of the training, from 0 to 1
        :param n_tasks: how many, at least 1
        :return: for each task its index into :attr:`variations` and its variation, every callable in it replaced by a
            drawn value
        """
        weights = self.sampler.weights(len(self), progress, self.success_rates)
        rounds, indices = weights, list[int]()
        while len(indices) < n_tasks:
            if not rounds.any():
                rounds = weights
            index = int(rng.choice(len(self), p=rounds / rounds.sum()))
            indices.append(index)
            rounds = np.where(np.arange(len(self)) == index, 0, rounds)
        return [
            (index, {k: value(rng) if callable(value) else value for k, value in self.variations[index].items()})
            for index in indices
        ]

    def record(self, index: int, success: float) -> None:
        """Update the running success rate of a variation.

        :param index: of the variation
        :param success: share of its latest episodes that succeeded, 0 to 1
        """
        old = self.success_rates[index]
        smoothing = 1.0 if np.isnan(old) else self.SUCCESS_SMOOTHING
        self.success_rates[index] = success if smoothing == 1 else old + smoothing * (success - old)

    def label(self, index: int) -> str:
        """Return a short and unique name of a variation for logs, such as ``n_discs=3``.

        What all variations share is left out, and numbers are rounded. Where that makes a name too long for SB3's
        logger, or the name of two variations, it begins with the index.
        """
        return self._labels[index]

    @cached_property
    def _labels(self) -> list[str]:
        first = self.variations[0]
        shared = {
            name
            for name in first
            if len(self) > 1 and all(name in other and _same(other[name], first[name]) for other in self.variations)
        }
        labels = [
            ",".join(f"{name}={_short(value)}" for name, value in variation.items() if name not in shared) or "default"
            for variation in self.variations
        ]
        return [
            label if len(label) <= MAX_LABEL and labels.count(label) == 1 else f"{index}:{label}"[:MAX_LABEL]
            for index, label in enumerate(labels)
        ]

    def fit_to(self, env_id: str, env_kwargs: Mapping[str, Any] | None = None) -> TaskDistribution:
        """Return the distribution in the form that has an effect on an environment, which is this one as a rule.

        Where the environment reads none of a parameter's reset options and its constructor has all parameters, that
        is the one with ``apply="constructor"``, and a warning says so.

        :param env_id: environment id
        :param env_kwargs: constructor arguments
        """
        if self.apply != "options" or not self.variations[0] or find_domain(env_id) is not None:
            return self
        (_, drawn), *_ = self.sample(np.random.default_rng(0))
        unread = constructor_arguments(env_id, drawn, env_kwargs or {})
        if not unread or unread != set(drawn):
            return self
        warnings.warn(
            f"{env_id} does not read the reset option {', '.join(sorted(unread))}, and its constructor has such an "
            "argument: each task makes the environments anew (apply='constructor')",
            stacklevel=3,
        )
        return TaskDistribution(self.variations, self.sampler, "constructor", self.check)

    def put_in_force(self, env: VecEnv, variations: Sequence[Variation]) -> None:
        """Make the variations those that the next reset of ``env`` starts with.

        :param env: the training environments
        :param variations: one for each environment
        :raises ValueError: if the environments cannot be varied in this way
        """
        if self.apply == "options":
            env.set_options([ReadOptions(variation) for variation in variations])
            return
        for row, variation in enumerate(variations):
            if self.apply == "constructor":
                _call(env, row, "remake", variation)
                continue
            for name, value in variation.items():
                if not _call(env, row, "set_wrapper_attr", name, value, force=False):
                    raise ValueError(f"{name!r} is not accepted; the environment has no attribute of this name")

    def reset(self, env: VecEnv, variations: Sequence[Variation]) -> Any:
        """Put variations in force and reset the environments.

        :param env: the training environments
        :param variations: one for each environment
        :return: the first observations
        :raises ValueError: if the environments cannot be varied in this way, or take no notice of a reset option
        """
        self.put_in_force(env, variations)
        given: Any = env.unwrapped._options
        observations = env.reset()
        if self.apply == "options":
            self._check_noticed(env, given)
        return observations

    def _check_noticed(self, env: VecEnv, options: Sequence[Any]) -> None:
        """Raise an error if no environment has looked at an option, so that training would go on unchanged."""
        unread = unread_names(options)
        if unread:
            names = ", ".join(sorted(unread))
            raise ValueError(
                f"the reset option {names} has no effect; {_name_of(env)} does not read it. Other ways to set a "
                "variation are apply='attributes', for what the environment keeps in attributes, and "
                "apply='constructor', with each environment wrapped in RemakeOnVariation"
            )


def default_tasks(env_id: str | None) -> TaskDistribution:
    """Return the training variations of a domain, by curriculum, or the environment as it is for any other id.

    :param env_id: environment id; ``None`` where it is not known
    """
    domain = find_domain(env_id)
    return TaskDistribution([{}]) if domain is None else TaskDistribution(domain.train)


class RemakeOnVariation(gym.Wrapper[Any, Any, Any, Any]):
    """Makes its environment anew, with other constructor arguments, for :class:`TaskDistribution` to call.

    :param env_id: environment id
    :param kwargs: constructor arguments common to all variations
    """

    def __init__(self, env_id: str, **kwargs: Any) -> None:
        self._id, self._kwargs = env_id, kwargs
        super().__init__(gym.make(env_id, **kwargs))

    def remake(self, variation: Variation) -> None:
        """Replace the environment.

        :param variation: constructor arguments
        """
        remade = gym.make(self._id, **{**self._kwargs, **variation})
        self.env.close()
        self.env = remade


def _call(env: VecEnv, row: int, method: str, *args: Any, **kwargs: Any) -> Any:
    if not env.has_attr(method):
        raise ValueError(
            f"these environments are not accepted: they have no {method}(). apply='attributes' needs environments that "
            "are stepped one by one, not a batched one; apply='constructor' needs each wrapped in RemakeOnVariation; "
            "apply='options' works with all"
        )
    return env.env_method(method, *args, indices=[row], **kwargs)[0]


def _name_of(env: VecEnv) -> str:
    spec = env.get_attr("spec")[0] if env.has_attr("spec") else None
    return "the environment" if spec is None else spec.id


def _same(one: Any, other: Any) -> bool:
    return type(one) is type(other) and bool(np.all(np.asarray(one == other)))


def _short(value: Any) -> str:
    if callable(value):
        return "drawn"
    return f"{value:.4g}" if isinstance(value, (float, np.floating)) else str(value)


def _enumerate(variations: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> list[Variation]:
    if not isinstance(variations, Mapping):
        if isinstance(variations, str) or not all(isinstance(variation, Mapping) for variation in variations):
            raise ValueError(
                f"variations={variations!r} is not accepted; give a mapping from parameter to values, or a sequence of "
                "mappings from parameter to one value"
            )
        return [dict(variation) for variation in variations]
    if not variations:
        return []
    values = [_values(name, value) for name, value in variations.items()]
    return [dict(zip(variations, combination, strict=True)) for combination in product(*values)]


def _values(name: str, value: Any) -> Sequence[Any]:
    if callable(value):
        return [value]
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, range, np.ndarray)) or not len(value):
        raise ValueError(f"{name}={value!r} is not accepted; give a non-empty sequence, a range or a callable")
    return list(value)
