"""Where :mod:`sb3_progpolicy.reptile.tasks` was in release 0.1; models saved then name this place."""

import warnings
from typing import Any

from sb3_progpolicy.reptile import tasks


def __getattr__(name: str) -> Any:
    value = getattr(tasks, name)
    warnings.warn("sb3_progpolicy.tasks is now sb3_progpolicy.reptile.tasks", DeprecationWarning, stacklevel=2)
    return value
