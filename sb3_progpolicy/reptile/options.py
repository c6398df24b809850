"""Reset options that know whether they have been read, and what to do where an environment reads none."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from typing import Any

import gymnasium as gym

from progpolicy_envs import find_domain


class ReadOptions(dict[str, Any]):
    """Reset options that know which of them have been read.

    :param variation: the options
    """

    def __init__(self, variation: Mapping[str, Any]) -> None:
        super().__init__(variation)
        self.read: set[str] = set()
        self.sent = False  # copied to another process, where nobody can look

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """See ``dict.get``."""
        self.read.add(name)
        return super().get(name, default)

    def pop(self, name: str, *default: Any) -> Any:
        """See ``dict.pop``."""
        self.read.add(name)
        return super().pop(name, *default)

    def keys(self) -> Any:
        """See ``dict.keys``; who asks for all names is taken to read all."""
        self.read.update(super().keys())
        return super().keys()

    def items(self) -> Any:
        """See ``dict.items``; who asks for all is taken to read all."""
        self.read.update(super().keys())
        return super().items()

    def __iter__(self) -> Iterator[str]:
        self.read.update(super().keys())
        return super().__iter__()

    def __deepcopy__(self, memo: dict[int, Any]) -> ReadOptions:  # SB3 copies options
        return self

    def __reduce__(self) -> tuple[Any, ...]:  # for another process
        self.sent = True
        return dict, (dict(super().items()),)


def unread_names(options: Iterable[Any]) -> set[str]:
    """Return the names that no environment has read; none where that cannot be known.

    :param options: what each environment was given, after its reset
    """
    given = list(options)
    if not given or not all(isinstance(one, ReadOptions) and not one.sent for one in given):
        return set()
    return set(dict.keys(given[0])).difference(*(one.read for one in given))


def refuse_unread(options: Iterable[Any], env: str) -> None:
    """Raise an error if no environment has looked at an option.

    :param options: what each environment was given, after its reset
    :param env: what does not read it, for the message
    :raises ValueError: naming the options
    """
    if unread := unread_names(options):
        raise ValueError(f"the reset option {', '.join(sorted(unread))} has no effect; {env} does not read it")


def refuse_starts(env_id: str | None, variations: Iterable[Mapping[str, Any]]) -> None:
    """Raise an error if a variation of a domain gives a part of a start, which holds for one episode alone.

    :param env_id: environment id, where it is known
    :param variations: that are to hold for several episodes
    :raises ValueError: naming the parts and the parameters that a variation can have
    """
    domain = find_domain(env_id)
    space = None if domain is None else domain.space
    if space is None:
        return
    for variation in variations:
        if given := sorted(set(variation) & set(space.starts)):
            raise ValueError(
                f"{dict(variation)} is not accepted for several episodes; {', '.join(given)} is part of a start, which "
                f"holds for one. A variation has values for {', '.join(space)}"
            )


def split_variation(
    env_id: str, variation: Mapping[str, Any], env_kwargs: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the parts of a variation that are for the constructor and for resets.

    :param env_id: a registered id; resets of this package's domains read all
    :param variation: parameters and values
    :param env_kwargs: constructor arguments of the environment that is tried
    """
    fixed = set() if find_domain(env_id) else constructor_arguments(env_id, variation, env_kwargs)
    made = {name: value for name, value in variation.items() if name in fixed}
    return made, {name: value for name, value in variation.items() if name not in fixed}


def constructor_arguments(env_id: str, variation: Mapping[str, Any], env_kwargs: Mapping[str, Any]) -> set[str]:
    """Return which parameters of a variation the constructor takes and no reset reads.

    :param env_id: a registered id, with or without a module prefix
    :param variation: parameters and values
    :param env_kwargs: constructor arguments of the environment that is tried
    """
    if not variation:
        return set()
    taken = set(variation) & _constructor_parameters(env_id)
    if not taken:
        return set()
    env = gym.make(env_id, **env_kwargs)
    try:
        options = ReadOptions(variation)
        env.reset(seed=0, options=options)
    finally:
        env.close()
    return taken & unread_names([options])


def _constructor_parameters(env_id: str) -> set[str]:
    """Return the names of the constructor's parameters; none where it cannot be asked."""
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)
    entry_point: Any = gym.spec(name).entry_point
    if isinstance(entry_point, str):
        try:
            entry_point = gym.envs.registration.load_env_creator(entry_point)
        except (ImportError, AttributeError):
            return set()
    try:
        return set(inspect.signature(entry_point).parameters)
    except (TypeError, ValueError):
        return set()
