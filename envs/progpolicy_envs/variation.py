"""Variations: the named parameters that tell the tasks of one domain apart, validated in one place."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from numbers import Integral
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from progpolicy_envs.states import is_sequence

Variation = dict[str, Any]
#: Whether the variation's numbers are part of the observation.
CONTEXTS = ("hidden", "observed")


@dataclass(frozen=True)
class IntParameter:
    """A whole number between ``low`` and ``high``, both included, or one of the ``names``.

    :param name: as in the constructor and in ``reset(options=...)``
    :param low: smallest number
    :param high: largest number
    :param default: of the constructor
    :param description: in a few words
    :param names: accepted in place of a number
    :param of_start: whether it is of an episode's start and not of the task: then it is left out of a variation while
        it has its default, and is not among the numbers that ``context="observed"`` shows
    """

    name: str
    low: int
    high: int
    default: int | str
    description: str
    names: tuple[str, ...] = ()
    of_start: bool = False

    kind: ClassVar[str] = "integer"

    @property
    def allowed(self) -> str:
        """The accepted values in words."""
        return " or ".join((f"an integer from {self.low} to {self.high}", *map(repr, self.names)))

    @property
    def context_names(self) -> tuple[str, ...]:
        """Names of the numbers that :meth:`encode` returns."""
        return () if self.of_start else (self.name, *(f"{self.name}={name}" for name in self.names))

    def is_drawn(self, value: Any) -> bool:
        """Return whether a value stands for one that is drawn for each episode.

        :param value: an accepted one
        """
        return value in self.names

    def is_one_value(self, value: Any) -> bool:
        """Return whether a sequence is one value, and not one value for each environment of a batch; here none is.

        :param value: a sequence
        """
        return False

    def encode(self, value: int | str) -> list[float]:
        """Return a value as numbers from 0 to 1: where it lies between the bounds, then one for each of the names.

        :param value: an accepted one
        """
        place = 0.0 if isinstance(value, str) else (value - self.low) / max(1, self.high - self.low)
        return [place, *(float(value == name) for name in self.names)]

    def parse(self, value: Any) -> int | str:
        """Return ``value`` as an ``int``, or the name.

        :param value: any integral number (NumPy integers included, booleans not), or one of ``names``
        :raises ValueError: if it is of another type or out of range
        """
        if isinstance(value, str) and value in self.names:
            return str(value)
        if isinstance(value, bool) or not isinstance(value, Integral) or not self.low <= int(value) <= self.high:
            raise ValueError(f"{self.name}={value!r} is not accepted; {self.name} is {self.allowed}")
        return int(value)


#: Value of a parameter that is drawn anew for each episode.
RANDOM = "random"


def n_done_parameter(most: int, things: str) -> IntParameter:
    """Return the parameter that says how many things are done with when an episode begins; 0 where it is left out.

    :param most: one less than the largest number of things
    :param things: what they are and when they are done, such as ``"plates on the stack"``
    """
    description = f"{things} at the start, fewer than there are; 'random' draws a number for every episode"
    return IntParameter("n_done", 0, most, 0, description, (RANDOM,), of_start=True)


def check_n_done(variation: Mapping[str, Any], size: str) -> None:
    """Raise ``ValueError`` unless something is left to be done.

    :param variation: with the size
    :param size: name of the number of things
    """
    n_done = variation.get("n_done", 0)
    if n_done != RANDOM and n_done >= variation[size]:
        raise ValueError(f"n_done={n_done} is not accepted with {size}={variation[size]}; n_done is less than {size}")


def check_left(variation: Mapping[str, Any], start: Mapping[str, Any], size: str, things: str) -> None:
    """Raise ``ValueError`` if a start gives other things than ``n_done`` leaves.

    :param variation: with the size
    :param start: parts of a start that are given
    :param size: name of the number of things
    :param things: name of the part of the start that holds those that are left
    """
    n_done = variation.get("n_done", 0)
    if n_done in (0, RANDOM) or not is_sequence(start.get(things)):
        return
    left, given = variation[size] - n_done, len(start[things])
    if given != left:
        raise ValueError(
            f"{given} {things} are not accepted with n_done={n_done} and {size}={variation[size]}, which leave {left}; "
            "give so many, or n_done=0"
        )


def draw_n_done(variation: Mapping[str, Any], size: str, rng: np.random.Generator) -> int:
    """Return how many things are done with when an episode begins; nothing is drawn for a number.

    :param variation: with the size
    :param size: name of the number of things
    :param rng: source of randomness
    """
    n_done = variation.get("n_done", 0)
    return int(variation[size] * rng.random()) if n_done == RANDOM else int(n_done)


@dataclass(frozen=True)
class ChoiceParameter:
    """One of a fixed set of names.

    :param name: as in the constructor and in ``reset(options=...)``
    :param choices: the names
    :param default: of the constructor
    :param description: in a few words
    """

    name: str
    choices: tuple[str, ...]
    default: str
    description: str

    kind: ClassVar[str] = "choice"

    @property
    def allowed(self) -> str:
        """The accepted values in words."""
        return "one of " + ", ".join(repr(choice) for choice in self.choices)

    @property
    def context_names(self) -> tuple[str, ...]:
        """Names of the numbers that :meth:`encode` returns."""
        return tuple(f"{self.name}={choice}" for choice in self.choices)

    def is_drawn(self, value: Any) -> bool:
        """Return whether a value stands for one that is drawn for each episode; here none does.

        :param value: an accepted one
        """
        return False

    def is_one_value(self, value: Any) -> bool:
        """Return whether a sequence is one value, and not one value for each environment of a batch; here none is.

        :param value: a sequence
        """
        return False

    def encode(self, value: str) -> list[float]:
        """Return a value as one number for each of the choices, 1 where it is this one.

        :param value: an accepted one
        """
        return [float(value == choice) for choice in self.choices]

    def parse(self, value: Any) -> str:
        """Return ``value`` unchanged.

        :param value: one of ``choices``
        :raises ValueError: if it is anything else
        """
        if not isinstance(value, str) or value not in self.choices:
            raise ValueError(f"{self.name}={value!r} is not accepted; {self.name} is {self.allowed}")
        return value


Parameter = IntParameter | ChoiceParameter


class VariationSpace(Mapping[str, Parameter]):
    """The parameters of a domain, by name, in the order in which they are documented.

    :param parameters: the parameters
    :param check: raises ``ValueError`` where the values of a whole variation do not fit together
    :param starts: for each part of an episode's start that ``reset`` takes besides the parameters, its name and what it
        is
    """

    def __init__(
        self,
        *parameters: Parameter,
        check: Callable[[Variation], None] | None = None,
        starts: Mapping[str, str] | None = None,
    ) -> None:
        self._parameters = {parameter.name: parameter for parameter in parameters}
        self._check = check
        self.starts = dict(starts or {})

    def __getitem__(self, name: str) -> Parameter:
        return self._parameters[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    def split(self, options: Mapping[str, Any] | None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return those of the options of a reset that change the variation, and those that are parts of a start.

        :param options: as given to ``reset(options=...)``
        :raises ValueError: if they are not a mapping
        """
        if options is None:
            return {}, {}
        if not isinstance(options, Mapping):
            example = {next(iter(self)): 2}
            raise ValueError(f"options={options!r} is not accepted; they are a mapping from names, such as {example}")
        start = {name: value for name, value in options.items() if name in self.starts and value is not None}
        return {name: value for name, value in options.items() if name not in self.starts}, start

    def update(self, variation: Mapping[str, Any], changes: Mapping[str, Any] | None) -> Variation:
        """Return ``variation`` with the values of ``changes`` put in.

        :param variation: the variation in force
        :param changes: new values by parameter name; ``None`` changes nothing
        :raises ValueError: if a name is unknown, a value is not accepted, or the values do not fit together; the
            message names the parameter, the value and what is allowed
        """
        updated = self._without_defaults({**variation, **self.parse(changes or {})})
        if self._check:
            self._check(updated)
        return updated

    def parse(self, values: Mapping[str, Any]) -> Variation:
        """Return values as the types they have to be of; not all parameters need one.

        :param values: by parameter name
        :raises ValueError: if a name is unknown or a value is not accepted
        """
        return {name: self._named(name).parse(value) for name, value in values.items()}

    def whole(self, variation: Mapping[str, Any]) -> Variation:
        """Return a variation with the parameters of the start that were left out, which have their defaults.

        :param variation: with a value for every other parameter
        """
        left_out = [known for known in self.values() if isinstance(known, IntParameter) and known.of_start]
        return {**{known.name: known.default for known in left_out}, **variation}

    def shown(self, variation: Mapping[str, Any], state: Mapping[str, Any]) -> Variation:
        """Return a variation with the values that a state has, except those that are drawn for each episode.

        :param variation: in force
        :param state: parts of it are named like parameters
        """
        known = {name: state[name] for name in self if name in state and not self[name].is_drawn(variation[name])}
        return {**variation, **known}

    @property
    def defaults(self) -> Variation:
        """The variation of an environment that is made without arguments."""
        return self._without_defaults({name: parameter.default for name, parameter in self.items()})

    @property
    def context_names(self) -> tuple[str, ...]:
        """Names of the numbers that :meth:`encode` returns."""
        return tuple(name for parameter in self.values() for name in parameter.context_names)

    def encode(self, variation: Mapping[str, Any]) -> NDArray[np.float32]:
        """Return a variation as numbers from 0 to 1, which a policy may be shown.

        :param variation: a value for every parameter that has such numbers
        :return: ``(len(context_names),)``
        """
        shown = {name: parameter for name, parameter in self.items() if parameter.context_names}
        numbers = [number for name, parameter in shown.items() for number in parameter.encode(variation[name])]
        return np.array(numbers, dtype=np.float32)

    def _without_defaults(self, variation: Variation) -> Variation:
        """Return a variation without parameters of the start that have their defaults."""
        left_out = [name for name, known in self.items() if isinstance(known, IntParameter) and known.of_start]
        return {name: value for name, value in variation.items() if name not in left_out or value != self[name].default}

    def _named(self, name: str) -> Parameter:
        if name not in self._parameters:
            near = get_close_matches(str(name), [*self._parameters, *self.starts], n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            known = "; ".join(f"{known.name}: {known.allowed}" for known in self._parameters.values())
            once = "; ".join(f"{start}: {meaning}" for start, meaning in self.starts.items())
            known += f"; for one episode: {once}" if once else ""
            raise ValueError(f"unknown variation parameter {name!r}{hint}; known: {known}")
        return self._parameters[name]


def with_context(space: spaces.Space[Any], names: tuple[str, ...], context: str) -> spaces.Space[Any]:
    """Return an observation space with room for the numbers of a variation, if they are observed.

    :param space: without them
    :param names: of the numbers
    :param context: ``"hidden"`` or ``"observed"``
    :raises ValueError: if it is neither, or the observation is not one array
    """
    if context not in CONTEXTS:
        raise ValueError(f"context={context!r} is not accepted; it is one of {', '.join(map(repr, CONTEXTS))}")
    if context == "hidden":
        return space
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"context={context!r} is not accepted with this observation; it is for one array of numbers")
    zeros, ones = np.zeros(len(names), np.float32), np.ones(len(names), np.float32)
    return spaces.Box(np.concatenate([space.low, zeros]), np.concatenate([space.high, ones]), dtype=np.float32)
