"""Write a file so that readers see the old content or the new, never half of it."""

from __future__ import annotations

import os
import uuid
from pathlib import Path


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write ``content`` next to ``path`` and move it into place.

    :param path: the file to create or replace; its folder must exist
    :param content: bytes, or a text, which is written as UTF-8 with the line ends it has
    :raises OSError: if it cannot be written, such as for want of space; it names the file, and an old one is left as
        it was
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with temporary.open("xb") as handle:
            handle.write(content if isinstance(content, bytes) else content.encode("utf-8"))
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(temporary, target)
    except OSError as error:
        if error.errno is not None:  # the system's error; it names the temporary file
            error.filename, error.filename2 = str(target), None
        raise
    finally:
        temporary.unlink(missing_ok=True)
