"""How the episodes of a rollout went, by variation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger

from sb3_progpolicy.reptile.tasks import TaskDistribution


class EpisodeStatistics:
    """Collects successes and lengths of episodes; tells the task distribution and the log of them.

    :param tasks: whose success rates are updated
    """

    def __init__(self, tasks: TaskDistribution) -> None:
        self.tasks = tasks
        self.recorded: list[tuple[int, float | None, float | None]] = []  # as told to the tasks
        self._successes: dict[int, list[float]] = defaultdict(list)
        self._lengths: dict[int, list[float]] = defaultdict(list)
        self._returns: dict[int, list[float]] = defaultdict(list)

    def add(self, indices: Sequence[int], dones: NDArray[np.bool_], infos: Sequence[dict[str, Any]]) -> None:
        """Take in the episodes that ended with a step.

        :param indices: of the variation of each environment
        :param dones: ``(n_envs,)``
        :param infos: one for each environment
        """
        for row in np.flatnonzero(dones).tolist():
            if "is_success" in infos[row]:
                self._successes[indices[row]].append(float(infos[row]["is_success"]))
            if "episode" in infos[row]:
                self._lengths[indices[row]].append(float(infos[row]["episode"]["l"]))
                self._returns[indices[row]].append(float(infos[row]["episode"]["r"]))

    def flush(self, logger: Logger) -> None:
        """Log the means as ``success/<variation>`` and ``steps/<variation>`` and begin anew.

        :param logger: of the model
        """
        for index in dict.fromkeys((*self._successes, *self._returns)):
            success, episode_return = _mean(self._successes, index), _mean(self._returns, index)
            self.recorded.append((index, success, episode_return))
            self.tasks.record(index, success, episode_return)
            if success is not None:
                logger.record(f"success/{self.tasks.label(index)}", success)
        for index, lengths in self._lengths.items():
            logger.record(f"steps/{self.tasks.label(index)}", float(np.mean(lengths)))
        for collected in (self._successes, self._lengths, self._returns):
            collected.clear()


def _mean(collected: dict[int, list[float]], index: int) -> float | None:
    return float(np.mean(collected[index])) if index in collected else None
