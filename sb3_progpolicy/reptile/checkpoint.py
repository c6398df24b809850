"""Checkpoints of ReptilePPO from which training goes on as if it had never stopped."""

from __future__ import annotations

import io
import os
import shutil
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_progpolicy.programs.files import write_atomically


def previous_of(path: str | os.PathLike[str]) -> Path:
    """Return where the checkpoint before the one at ``path`` is kept: ``model.previous.zip`` beside ``model.zip``."""
    path = Path(path)
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def load_last_good(path: str | os.PathLike[str], load: Callable[..., Any], **kwargs: Any) -> Any:
    """Load a checkpoint, or the one before it if it is damaged or missing, which is said by a warning.

    :param path: as given to :class:`ReptileCheckpoint`
    :param load: what loads a file, such as ``ReptilePPO.load``
    :param kwargs: its further arguments
    :raises ValueError: if neither can be loaded
    """
    path, previous = Path(path), previous_of(path)
    if _is_intact(path) or not _is_intact(previous):
        return load(path, **kwargs)
    model = load(previous, **kwargs)
    reason = "damaged" if path.exists() else "missing"
    warnings.warn(f"{path} is {reason}; going on from {previous}, step {model.num_timesteps}", stacklevel=2)
    return model


def _is_intact(path: Path) -> bool:
    """Whether a zip is there, whole and with the right check sums."""
    try:
        with zipfile.ZipFile(path) as archive:
            return archive.testzip() is None
    except (OSError, zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError):
        return False


class ReptileCheckpoint(BaseCallback):
    """Saves a :class:`~sb3_progpolicy.reptile_ppo.ReptilePPO` model at meta-iteration boundaries.

    Between two tasks the parameters are theta, and everything random in the next task follows from the seed and its
    number. So a model loaded from there and trained on with ``reset_num_timesteps=False`` ends with the parameters, to
    the last bit, of a model that was never stopped; it needs a ``seed`` for that.

    :param path: the file to write, replaced only when the new one is complete; the one before is kept beside it as
        ``<name>.previous.zip``, see :func:`load_last_good`
    :param save_freq: environment steps between two checkpoints, at least; 0 for every boundary
    :param verbose: 0 or 1
    :param allow_pickle: see ``ReptilePPO.save``
    :raises ValueError: if ``save_freq`` is negative
    """

    model: Any  # a ReptilePPO

    def __init__(
        self, path: str | os.PathLike[str], save_freq: int = 0, verbose: int = 0, allow_pickle: bool = False
    ) -> None:
        super().__init__(verbose)
        if save_freq < 0:
            raise ValueError(f"save_freq={save_freq} is not accepted; it is at least 0")
        self.path, self.save_freq, self.allow_pickle = Path(path), save_freq, allow_pickle
        self._boundary: bytes | None = None
        self._boundary_iteration = -1
        self._next_save = save_freq

    def save(self) -> bool:
        """Write the last boundary, also when training was interrupted in the middle of a task.

        :return: whether there was one to write
        """
        if self._boundary is None:
            return False
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if _is_intact(self.path):
            _link(self.path, previous_of(self.path))
        write_atomically(self.path, self._boundary)
        return True

    def _on_training_start(self) -> None:
        self._next_save = self.num_timesteps + self.save_freq
        self._boundary_iteration = -1

    def _on_rollout_start(self) -> None:
        if self.model.meta_iteration == self._boundary_iteration:
            return  # in the middle of a task
        self._boundary_iteration = self.model.meta_iteration
        buffer = io.BytesIO()
        self.model.save(buffer, allow_pickle=self.allow_pickle)
        self._boundary = buffer.getvalue()
        if self.num_timesteps >= self._next_save:
            self.save()
            self._next_save = self.num_timesteps + self.save_freq
            if self.verbose:
                print(f"Checkpoint of meta-iteration {self.model.meta_iteration}: {self.path}")

    def _on_step(self) -> bool:
        return True


def _link(path: Path, previous: Path) -> None:
    """Give a file a second name, or copy it where a file system has no links."""
    previous.unlink(missing_ok=True)
    try:
        os.link(path, previous)
    except OSError:
        shutil.copyfile(path, previous)
