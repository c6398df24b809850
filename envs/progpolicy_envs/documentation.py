"""Docstrings of environments that share sections: each text is written once, and every class has all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from inspect import cleandoc
from string import Template
from typing import TypeVar

_Class = TypeVar("_Class", bound=type)


def with_sections(sections: Mapping[str, str], **words: str) -> Callable[[_Class], _Class]:
    """Return a class decorator that replaces every ``$name`` in the class's docstring.

    :param sections: longer texts by name, which may contain ``$name`` of words
    :param words: short texts by name
    :raises KeyError: if the docstring, or a section, has a ``$name`` that is not given
    """
    texts = {name: Template(cleandoc(text)).substitute(words) for name, text in sections.items()}

    def fill(cls: _Class) -> _Class:
        if cls.__doc__:  # there is none under `python -OO`
            cls.__doc__ = Template(cleandoc(cls.__doc__)).substitute(texts, **words)
        return cls

    return fill
