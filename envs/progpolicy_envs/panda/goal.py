"""The goal-environment form of the Panda environments, and the entry points that choose between the two forms."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from progpolicy_envs.panda.env import PROGRESS, Observation, PandaEnv, bounded_box, check_choice
from progpolicy_envs.panda.focus import ACHIEVED_NAMES, DESIRED_NAMES, FEATURE_NAMES
from progpolicy_envs.panda.libraries import GoalEnv

_PARTS = (len(FEATURE_NAMES), len(FEATURE_NAMES) + len(ACHIEVED_NAMES))


class PandaGoalEnv(PandaEnv, GoalEnv):
    """A Panda environment whose observation is a dictionary, with rewards for goals other than the one pursued.

    It is a class of its own because SB3 takes everything that has a ``compute_reward`` for a goal environment.
    """

    def _observed_space(self) -> spaces.Space[Any]:
        return spaces.Dict(
            OrderedDict(
                observation=bounded_box(len(FEATURE_NAMES)),
                achieved_goal=bounded_box(len(ACHIEVED_NAMES)),
                desired_goal=bounded_box(len(DESIRED_NAMES)),
            )
        )

    def compute_reward(
        self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Mapping[str, Any] | Sequence[Any]
    ) -> NDArray[np.float64] | np.float64:
        """Return the reward of one step or of many.

        :param achieved_goal: ``(3,)`` or ``(n, 3)``
        :param desired_goal: like ``achieved_goal``
        :param info: the step's info, or a sequence of ``n``
        :return: one number or ``(n,)``
        :raises ValueError: if the numbers of goals and infos differ; for other rewards than the sparse one, if an info
            lacks ``"previous_achieved_goal"`` or ``"shaping"``
        """
        one = np.ndim(achieved_goal) < 2
        achieved, desired = np.atleast_2d(achieved_goal), np.atleast_2d(desired_goal)
        infos: Sequence[Mapping[str, Any]] = [info] if isinstance(info, Mapping) else info
        if np.shape(achieved_goal) != np.shape(desired_goal) or len(infos) != len(achieved):
            raise ValueError(
                f"achieved_goal of shape {np.shape(achieved_goal)}, desired_goal of shape {np.shape(desired_goal)} and "
                f"{len(infos)} infos are not accepted; they are (3,) and one info, or (n, 3) and n infos"
            )
        distance = np.linalg.norm(achieved - desired, axis=-1)
        if self.reward_type == "sparse":
            settled = np.array([entry.get("settled", True) for entry in infos], dtype=bool)
            reward = np.where((distance < self.task.tolerance) & settled, 0.0, -1.0)
        else:
            try:
                previous = np.array([entry["previous_achieved_goal"] for entry in infos])
                shaping = np.array([entry["shaping"] for entry in infos])
            except KeyError as error:
                raise ValueError(
                    f"info lacks {error}, which the dense reward needs; HerReplayBuffer keeps it with "
                    'copy_info_dict=True, or use reward_type="sparse"'
                ) from error
            reward = PROGRESS * (np.linalg.norm(previous - desired, axis=-1) - distance) + shaping
        return reward[0] if one else reward

    def compute_terminated(
        self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Mapping[str, Any]
    ) -> bool:
        """Return whether the step with this info ended the episode; that depends on all objects, not on one goal."""
        return bool(info["is_success"] or info["is_failure"])

    def compute_truncated(
        self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Mapping[str, Any]
    ) -> bool:
        """Return ``False``: only the step limit truncates."""
        return False

    def _observe(self) -> Observation:
        features, achieved, desired = np.split(self._flat_observation(), _PARTS)
        return {"observation": features, "achieved_goal": achieved, "desired_goal": desired}

    def _reward(self, observation: Any, info: Mapping[str, Any]) -> float:
        # From the goals as they are observed, so that a replay buffer computes the same to the last bit.
        return float(self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info))


class EntryPoint:
    """Makes an environment in the form that ``observation`` names; Gymnasium takes it for the environment's class.

    :param flat: class whose observation is one array
    :param goal: class whose observation is the dictionary of a goal environment
    """

    def __init__(self, flat: type[PandaEnv], goal: type[PandaGoalEnv]) -> None:
        self.forms: dict[str, type[PandaEnv]] = {"flat": flat, "goal": goal}
        self.metadata, self.variations, self.__doc__ = flat.metadata, flat.variations, flat.__doc__
        self.symmetries = flat.symmetries

    def __call__(self, *args: Any, observation: str = "flat", **arguments: Any) -> PandaEnv:
        """Return the environment.

        :param args: of the class
        :param observation: ``"flat"`` or ``"goal"``
        :param arguments: of the class
        :raises ValueError: if an argument is not accepted
        """
        check_choice("observation", observation, tuple(self.forms))
        return self.forms[observation](*args, **arguments)
