"""The program as its users know it: plain data that can be printed, saved and loaded."""

from __future__ import annotations

import os
from dataclasses import dataclass

from sb3_progpolicy.programs.export.text import export_text
from sb3_progpolicy.programs.io import read_program, save_program
from sb3_progpolicy.programs.syntax import ProgramData

#: The ways in which a program is learned.
LEARNED_BY = ("reinforcement", "imitation", "imitation+reinforcement")


@dataclass(frozen=True)
class Program(ProgramData):
    """A whole program, ready to be read, exported, saved or run.

    The input vector X is the observation (``n_observations`` numbers) and, where ``interaction`` is set, the previous
    action (``action.history_size`` numbers), the previous reward and the previous done flag (section 2.4).

    :param body: the tree
    :param n_observations: length of the observation
    :param action: the action space
    :param interaction: whether X goes on with the previous action, reward and done flag
    :param input_names: one readable name per number of X
    :param output_names: one readable name per controller output
    :param temperature: temperature of the sigmoid in the soft semantics, above 0
    :param metadata: where the program comes from (environment id, seed, steps ...); JSON values only
    :param semantics: what the soft program does with Box actions: ``"means"`` mixes the controllers' outputs,
        ``"branches"`` runs the likeliest controller
    """

    @property
    def learned_by(self) -> str:
        """How it was learned: one of :data:`LEARNED_BY`, or ``"unknown"`` if its metadata name something else.

        Programs that say nothing are of releases in which there was reinforcement learning only.
        """
        named = self.metadata.get("learned_by", LEARNED_BY[0])
        return named if named in LEARNED_BY else "unknown"

    def __str__(self) -> str:
        """The program as :func:`~sb3_progpolicy.programs.export_text` prints it."""
        return export_text(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the program to a JSON file, see :func:`~sb3_progpolicy.programs.save_program`."""
        save_program(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Program:
        """Read a program from a JSON file, see :func:`~sb3_progpolicy.programs.load_program`."""
        return load_program(path)


def load_program(path: str | os.PathLike[str]) -> Program:
    """Read a program written by :func:`save_program`, equal to the one saved.

    The file may come from anyone: it is size-limited, parsed as plain JSON and checked field by field. Nothing in it
    is run.

    :param path: the file
    :return: the program
    :raises ProgramFormatError: naming the file and the fault, if it is not a well-formed program
    :raises OSError: if the file cannot be read
    """
    return Program(**vars(read_program(path)))
