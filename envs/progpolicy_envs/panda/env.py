"""Robot, scene and task joined in an environment: what the four Panda environments have in common."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium_robotics.core import GoalEnv
from numpy.typing import NDArray

from progpolicy_envs.panda.camera import Camera
from progpolicy_envs.panda.focus import (
    ACHIEVED_NAMES,
    ACTION_NAMES,
    BOUND,
    DESIRED_NAMES,
    FEATURE_NAMES,
    OBSERVATION_NAMES,
    focus_observation,
)
from progpolicy_envs.panda.scene import CONTROL_STEP, ObjectState, Physics, Scene
from progpolicy_envs.panda.tasks import Task
from progpolicy_envs.rendering import Display
from progpolicy_envs.variation import VariationSpace

Observation = NDArray[np.float32] | dict[str, NDArray[np.float32]]

#: Terms of the dense reward, see the class docstrings.
PROGRESS, APPROACH, FINISHED, STEP, FAILURE = 10.0, 5.0, 1.0, -0.01, -5.0

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_STILL = (0.0, 0.0, 0.0)
_PARTS = (len(FEATURE_NAMES), len(FEATURE_NAMES) + len(ACHIEVED_NAMES))


def _box(size: int) -> spaces.Box:
    return spaces.Box(-BOUND, BOUND, (size,), np.float32)


class PandaEnv(gym.Env[Any, NDArray[np.float32]]):
    """What the Panda environments have in common; see :class:`~progpolicy_envs.panda.PandaPushEnv` and the others.

    A subclass names its :attr:`task_class` and its one variation parameter.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": round(1 / CONTROL_STEP)}
    task_class: ClassVar[type[Task]]
    variations: ClassVar[VariationSpace]
    observation_names: ClassVar[tuple[str, ...]] = OBSERVATION_NAMES
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES

    def __new__(cls, *args: Any, **kwargs: Any) -> PandaEnv:
        """Return an instance of the class's goal form for ``observation="goal"``.

        Two classes because SB3 takes whatever has a ``compute_reward`` for a goal environment.
        """
        if kwargs.get("observation") == "goal" and not issubclass(cls, GoalForm):
            cls = _goal_form(cls)  # type: ignore[arg-type]
        return super().__new__(cls)

    def __init__(
        self,
        variation: Mapping[str, Any],
        *,
        observation: str = "flat",
        reward_type: str = "dense",
        render_mode: str | None = None,
        physics: Physics | None = None,
    ) -> None:
        _check_choice("observation", observation, ("flat", "goal"))
        _check_choice("reward_type", reward_type, ("dense", "sparse"))
        _check_choice("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        self.variation = self.variations.update({}, variation)
        self.observation = observation
        self.reward_type = reward_type
        self.render_mode = render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (len(ACTION_NAMES),), np.float32)
        goal_space = spaces.Dict(
            OrderedDict(
                observation=_box(len(FEATURE_NAMES)),
                achieved_goal=_box(len(ACHIEVED_NAMES)),
                desired_goal=_box(len(DESIRED_NAMES)),
            )
        )
        self.observation_space: spaces.Space[Any] = (
            goal_space if observation == "goal" else _box(len(OBSERVATION_NAMES))
        )
        self.task = self.task_class()
        self.scene = Scene(self.task.table, self.task.kind, physics, visual=render_mode is not None)
        self._camera = Camera(self.scene, self.task) if render_mode is not None else None
        self._display = Display(self.metadata["render_fps"])
        self._reach = 0.0

    @property
    def size(self) -> int:
        """Number of objects, or of targets in Reach."""
        return int(next(iter(self.variation.values())))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Put the robot into its neutral pose and draw new starts and targets.

        :param seed: seeds the generator from which all positions come; ``None`` goes on with it
        :param options: new values of variation parameters; they stay in force
        :return: observation and info
        :raises ValueError: if a variation is not accepted; the variation in force is then unchanged
        """
        variation = self.variations.update(self.variation, options)
        super().reset(seed=seed)
        self.variation = variation
        self.task.reset(self.scene, self.np_random, self.size)
        self._look()
        self._show()
        return self._observe(), {"is_success": False, "variation": dict(self.variation)}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 1/30 s.

        :param action: ``(4,)`` numbers; those beyond [-1, 1] are clipped
        :return: observation, reward, terminated, truncated, info
        :raises ValueError: if the action has another shape or a number that is not finite
        """
        action = np.asarray(action, dtype=np.float32)
        numbers = action.tolist()
        if action.shape != (len(ACTION_NAMES),) or not all(map(math.isfinite, numbers)):
            raise ValueError(f"action={action!r} is not accepted; an action is 4 finite numbers from -1 to 1")
        self.scene.robot.act(numbers)
        self.scene.simulate()
        observation, reward, info = self.conclude()
        self._show()
        return observation, reward, info["is_success"] or info["is_failure"], False, info

    def conclude(self) -> tuple[Observation, float, dict[str, Any]]:
        """Take over what came of the physics of a step; the last of a step's three parts.

        :return: observation, reward, info
        """
        task, index, achieved, n_left = self.task, self._focus, self._achieved, self._n_left
        reach = self._reach
        self.scene.take_over()
        task.update(self.scene)
        failure = task.failed
        self._reach = self._handle_distance(index)
        shaping = STEP + APPROACH * (reach - self._reach) + FAILURE * failure
        self._look(index)
        shaping += FINISHED * (n_left - self._n_left)
        if self._focus != index:
            # The new object has made no progress yet; that of the old one goes into the shaping.
            target = task.targets[index]
            shaping += PROGRESS * (math.dist(achieved, target) - math.dist(task.positions[index], target))
            achieved = self._achieved
        info = {
            "is_success": self._n_left == 0,
            "is_failure": failure,
            "settled": task.settled(self.scene, self._focus),
            "previous_achieved_goal": achieved,
            "shaping": shaping,
        }
        observation = self._observe()
        return observation, self._reward(observation, info), info

    def render(self) -> Any:
        """Return a picture ``(360, 480, 3)`` of bytes, or show a window, as ``render_mode`` says."""
        if self._camera is not None and self.render_mode == "rgb_array":
            return self._camera.frame(self._focus)
        self._show()
        return None

    def close(self) -> None:
        """Leave PyBullet and close the window, if there is one."""
        self.scene.close()
        self._display.close()

    def _reward(self, observation: Observation, info: Mapping[str, Any]) -> float:
        """Return the reward of the present step; :meth:`GoalForm.compute_reward` is the same for many goals."""
        if isinstance(observation, dict):
            # To the last bit what a replay buffer will compute from the rounded goals.
            return float(self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info))  # type: ignore[attr-defined]
        distance = math.dist(self._achieved, self._desired)
        if self.reward_type == "sparse":
            return 0.0 if distance < self.task.tolerance and info["settled"] else -1.0
        return PROGRESS * (math.dist(info["previous_achieved_goal"], self._desired) - distance) + info["shaping"]

    def _look(self, before: int | None = None) -> None:
        """Turn to the object in focus and remember its state, from which progress is measured.

        :param before: the object in focus before, to which the gripper's distance is known
        """
        self._focus = self.task.focus
        self._n_left = self.task.finished.count(False)
        self._achieved = self.task.positions[self._focus]
        self._desired = self.task.targets[self._focus]
        if self._focus != before:
            self._reach = self._handle_distance(self._focus)

    def _handle_distance(self, index: int) -> float:
        handle = self.task.handle(index)
        return 0.0 if handle is None else math.dist(handle, self.scene.robot.position)

    def _focus_state(self) -> ObjectState:
        """Return the object in focus; in Reach the gripper itself, in Slide a delivered puck where it was delivered."""
        if self.task.kind is None:
            return ObjectState(self._achieved, _UPRIGHT, self.scene.robot.velocity, _STILL)
        return self.scene.object_state(self._focus, self._achieved)

    def _observe(self) -> Observation:
        observation = focus_observation(self.scene.robot, self._focus_state(), self._desired, self._n_left)
        if self.observation == "goal":
            features, achieved, desired = np.split(observation, _PARTS)
            return {"observation": features, "achieved_goal": achieved, "desired_goal": desired}
        return observation

    def _show(self) -> None:
        if self.render_mode == "human" and self._camera is not None:
            self._display.show(self._camera.frame(self._focus))


class GoalForm(GoalEnv):
    """The goal-environment form of a Panda environment, with rewards for goals other than the one pursued."""

    def compute_reward(
        self, achieved_goal: NDArray[Any], desired_goal: NDArray[Any], info: Mapping[str, Any] | Sequence[Any]
    ) -> NDArray[np.float64] | np.float64:
        """Return the reward of one step or of many.

        :param achieved_goal: ``(3,)`` or ``(n, 3)``
        :param desired_goal: like ``achieved_goal``
        :param info: the step's info, or a sequence of ``n``
        :return: one number or ``(n,)``
        :raises ValueError: for the dense reward, if an info lacks ``"previous_achieved_goal"`` or ``"shaping"``
        """
        one = isinstance(info, Mapping)
        infos: Sequence[Mapping[str, Any]] = [info] if one else info  # type: ignore[list-item, assignment]
        achieved, desired = np.atleast_2d(achieved_goal), np.atleast_2d(desired_goal)
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


@cache
def _goal_form(env_class: type[PandaEnv]) -> type[PandaEnv]:
    return type(env_class.__name__, (env_class, GoalForm), {"__doc__": env_class.__doc__})


def _check_choice(name: str, value: Any, choices: Sequence[Any]) -> None:
    if value not in choices:
        allowed = ", ".join(repr(choice) for choice in choices)
        raise ValueError(f"{name}={value!r} is not accepted; {name} is one of {allowed}")
