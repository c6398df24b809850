"""Error messages that name the nearest valid choice."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def unknown(kind: str, given: object, known: Iterable[str]) -> ValueError:
    """Return the error for a name that is not known.

    :param kind: what is named, such as ``"algorithm"``
    :param given: the name given
    :param known: the names accepted; the nearest come first in the message, all of them where none is near
    """
    names = list(known)
    near = get_close_matches(str(given), names, n=3, cutoff=0.5)
    hint = f"nearest: {', '.join(near)}" if near else f"known: {', '.join(names) or 'none'}"
    return ValueError(f"unknown {kind} {str(given)!r}; {hint}")
