"""What has been done in a scene, so that a copy of it can be computed."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from progpolicy_envs.panda.physics import Hand, Point

if TYPE_CHECKING:
    from progpolicy_envs.panda.scene import Scene

_NO_ACTION = (math.nan,) * 4


@dataclass
class History:
    """What has been done in a scene since objects were placed.

    :param placed: the positions at which they were placed
    :param hand: where the gripper was, ``None`` in the neutral pose
    :param actions: four numbers for each control step, NaN where no action was given
    :param parked: for each object taken off the table, the number of control steps before, and which object
    :param pending: the action of the next control step, if it has been given
    """

    placed: tuple[Point, ...]
    hand: Hand | None = None
    actions: array[float] = field(default_factory=lambda: array("d"))
    parked: list[tuple[int, int]] = field(default_factory=list)
    pending: Sequence[float] = _NO_ACTION

    def end_step(self) -> None:
        """Note that a control step is made with the pending action."""
        self.actions.extend(self.pending)
        self.pending = _NO_ACTION

    def park(self, index: int) -> None:
        """Note that an object is taken off the table."""
        self.parked.append((len(self.actions) // len(_NO_ACTION), index))

    def repeat(self, scene: Scene) -> None:
        """Do all of it again in another scene."""
        scene.place(self.placed, self.hand)
        steps, parked = np.reshape(self.actions, (-1, len(_NO_ACTION))).tolist(), list(self.parked)
        for number, action in enumerate([*steps, self.pending]):
            while parked and parked[0][0] == number:
                scene.park(parked.pop(0)[1])
            if not math.isnan(action[0]):
                scene.act(action)
            if number < len(steps):
                scene.simulate()
                scene.sync_state()
