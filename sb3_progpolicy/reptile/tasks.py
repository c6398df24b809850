"""Task distributions: the variations to train on, and in which order they are drawn."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import product
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from progpolicy_envs import find_domain
from sb3_progpolicy.reptile.options import ReadOptions, constructor_arguments, refuse_starts, unread_names
from sb3_progpolicy.reptile.samplers import CurriculumSampler, FailureSampler, Sampler, UniformSampler, make_sampler
from sb3_progpolicy.vec_env.repeat import repeat_options

__all__ = ["RemakeOnVariation", "TaskDistribution", "Variation", "default_tasks", "make_tasks"]
__all__ += ["CurriculumSampler", "FailureSampler", "Sampler", "UniformSampler"]  # models of release 0.1 look here

Variation = dict[str, Any]
Draw = Callable[[np.random.Generator], Any]
Apply = Literal["options", "attributes", "constructor"]
APPLY: tuple[Apply, ...] = ("options", "attributes", "constructor")
MAX_LABEL = 30  # characters that SB3's table of logs shows


class TaskDistribution:
    """The distribution over tasks p(T) of algorithm 1: which variations of an environment to train on.

    .. code-block:: python

        TaskDistribution({"n_discs": [1, 2, 3, 4]})                           # every combination of the values
        TaskDistribution([{"n_discs": 1}, {"n_discs": 3}], sampler="curriculum")
        TaskDistribution({"length": lambda rng: rng.uniform(0.3, 1.0)}, apply="attributes")

    :param variations: a mapping from parameter to values (a sequence, a ``range``, or a callable that draws a value
        from a ``numpy.random.Generator``), of which all combinations are taken; or a sequence of such mappings from
        parameter to one value, the same parameters in all. Order them from the easiest for a curriculum.
    :param sampler: ``"uniform"``, ``"curriculum"``, ``"failure"``, ``"progress"``, a mapping of ``name`` and the
        arguments of one of these, or a :class:`~sb3_progpolicy.reptile.samplers.Sampler`
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
    #: Weight of the newest episodes in the newer and the older running mean of the scores.
    SCORE_SMOOTHING = (0.2, 0.05)
    check = True  # of those saved by release 0.1

    def __init__(
        self,
        variations: Mapping[str, Any] | Sequence[Mapping[str, Any]],
        sampler: str | Mapping[str, Any] | Sampler = "uniform",
        apply: Apply = "options",
        check: bool = True,
    ) -> None:
        self.variations = _enumerate(variations)
        if not self.variations:
            raise ValueError(f"variations={variations!r} is not accepted; at least one variation is needed")
        sampler = make_sampler(sampler)
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
        #: Running means of what learning progress is measured by, the newer and the older; NaN where not tried yet.
        self.scores = np.full((2, len(self.variations)), np.nan)

    def __len__(self) -> int:
        return len(self.variations)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled distribution; those of release 0.1 have no scores."""
        self.__dict__.update({"scores": np.full((2, len(state["variations"])), np.nan), **state})

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
        statistics = getattr(self, self.sampler.reads)
        weights = self.sampler.weights(len(self), progress, statistics)
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

    def record(self, index: int, success: float | None, episode_return: float | None = None) -> None:
        """Update the running means of a variation.

        Learning progress is measured by success where the environment tells it, and else by the return.

        :param index: of the variation
        :param success: share of its latest episodes that succeeded, 0 to 1; ``None`` where that is not known
        :param episode_return: mean return of its latest episodes; ``None`` where that is not known
        """
        if success is not None:
            self.success_rates[index] = _moved(self.success_rates[index], success, self.SUCCESS_SMOOTHING)
        score = episode_return if success is None else success
        if score is not None:
            for mean, smoothing in zip(self.scores, self.SCORE_SMOOTHING, strict=True):
                mean[index] = _moved(mean[index], score, smoothing)

    @property
    def learning_progress(self) -> NDArray[np.float64]:
        """How far the newer running mean of every variation's score is from the older one; NaN where not tried yet."""
        return np.abs(self.scores[0] - self.scores[1])

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

    def with_sampler(self, sampler: str | Mapping[str, Any] | Sampler) -> TaskDistribution:
        """Return a distribution over the same variations that draws them in another way.

        :param sampler: see :class:`TaskDistribution`
        :raises ValueError: if it is not accepted
        """
        return TaskDistribution(self.variations, sampler, self.apply, self.check)

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
            if any(variations):
                repeat_options(env)
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
    """Return the training variations of a domain, all equally likely, or the environment as it is for any other id.

    :param env_id: environment id; ``None`` where it is not known
    """
    domain = find_domain(env_id)
    return TaskDistribution([{}]) if domain is None else TaskDistribution(domain.train)


def make_tasks(
    tasks: TaskDistribution | Mapping[str, Any] | Sequence[Mapping[str, Any]] | None,
    sampler: str | Mapping[str, Any] | Sampler | None,
    env_id: str | None,
    fit: bool,
    env_kwargs: Mapping[str, Any] | None,
) -> TaskDistribution:
    """Return the distribution that a training's arguments describe.

    :param tasks: a distribution or what makes one; ``None`` for :func:`default_tasks`
    :param sampler: in place of the distribution's own; ``None`` keeps that
    :param env_id: environment id, where it is known
    :param fit: whether it is to have the form that has an effect on this environment, see ``TaskDistribution.fit_to``
    :param env_kwargs: constructor arguments of the environment
    :raises ValueError: if the tasks set what the constructor's arguments set, or parts of a start
    """
    if tasks is None:
        tasks = default_tasks(env_id)
    tasks = tasks if isinstance(tasks, TaskDistribution) else TaskDistribution(tasks)
    refuse_starts(env_id, tasks.variations)
    if both := sorted(set(env_kwargs or {}) & set().union(*tasks.variations)):
        raise ValueError(
            f"env_kwargs sets {', '.join(both)}, which the tasks set, too: {tasks.variations[0]} is one of them. Give "
            "tasks the values to train on, such as tasks=[{'n_discs': 6}], and leave them out of env_kwargs"
        )
    if sampler is not None:
        tasks = tasks.with_sampler(sampler)
    return tasks.fit_to(env_id, env_kwargs) if fit and env_id is not None else tasks


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


def _moved(old: float, new: float, smoothing: float) -> float:
    """Return a running mean after a new value; the first value is the mean."""
    return new if np.isnan(old) else old + smoothing * (new - old)


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
