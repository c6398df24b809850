"""Keeping standard output for what was asked for."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console


@contextlib.contextmanager
def quiet_stdout() -> Iterator[None]:
    """Send to stderr whatever is written to stdout, also by C libraries, which greet on import."""
    with contextlib.redirect_stdout(sys.stderr):
        if sys.__stdout__ is not None:
            sys.__stdout__.flush()
        kept = os.dup(1)
        os.dup2(2, 1)
        try:
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)


def plain_console(**options: Any) -> Console:
    """Return a console that shows texts as they are: no name of a run or a file is read as markup.

    :param options: of rich's ``Console``
    """
    from rich.console import Console

    return Console(markup=False, emoji=False, **options)
