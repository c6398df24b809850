"""Variations: the named parameters that tell the tasks of one domain apart, validated in one place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from numbers import Integral
from typing import Any

Variation = dict[str, Any]


@dataclass(frozen=True)
class IntParameter:
    """A whole number between ``low`` and ``high``, both included, or one of the ``names``."""

    name: str
    low: int
    high: int
    description: str
    names: tuple[str, ...] = ()

    @property
    def allowed(self) -> str:
        """The accepted values in words."""
        return " or ".join((f"an integer from {self.low} to {self.high}", *map(repr, self.names)))

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


@dataclass(frozen=True)
class ChoiceParameter:
    """One of a fixed set of names."""

    name: str
    choices: tuple[str, ...]
    description: str

    @property
    def allowed(self) -> str:
        """The accepted values in words."""
        return "one of " + ", ".join(repr(choice) for choice in self.choices)

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
    """

    def __init__(self, *parameters: Parameter) -> None:
        self._parameters = {parameter.name: parameter for parameter in parameters}

    def __getitem__(self, name: str) -> Parameter:
        return self._parameters[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parameters)

    def __len__(self) -> int:
        return len(self._parameters)

    def update(self, variation: Mapping[str, Any], options: Mapping[str, Any] | None) -> Variation:
        """Return ``variation`` with the values of ``options`` put in.

        :param variation: the variation in force
        :param options: new values by parameter name, as given to ``reset(options=...)``; ``None`` changes nothing
        :raises ValueError: if a name is unknown or a value is not accepted; the message names the parameter, the
            value and what is allowed
        """
        parsed = {name: self._named(name).parse(value) for name, value in (options or {}).items()}
        return {**variation, **parsed}

    def _named(self, name: str) -> Parameter:
        if name not in self._parameters:
            near = get_close_matches(str(name), self._parameters, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            known = "; ".join(f"{known.name}: {known.allowed}" for known in self._parameters.values())
            raise ValueError(f"unknown variation parameter {name!r}{hint}; known: {known}")
        return self._parameters[name]
