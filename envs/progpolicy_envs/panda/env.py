"""Robot, scene and task joined in an environment: what the four Panda environments have in common."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from progpolicy_envs.panda.camera import Camera
from progpolicy_envs.panda.focus import ACTION_NAMES, BOUND, OBSERVATION_NAMES, focus_observation
from progpolicy_envs.panda.physics import CONTROL_STEP, ObjectState, Physics
from progpolicy_envs.panda.placement import Points
from progpolicy_envs.panda.scene import Scene
from progpolicy_envs.panda.tasks import Task
from progpolicy_envs.rendering import Frame
from progpolicy_envs.single import DomainEnv, require_reset
from progpolicy_envs.states import check_choice
from progpolicy_envs.symmetry import Permutation, Symmetry
from progpolicy_envs.variation import Variation, VariationSpace, draw_n_done

FlatObservation = NDArray[np.float32]
Observation = FlatObservation | dict[str, NDArray[np.float32]]
Action = NDArray[np.float32]

#: Terms of the dense reward, see the class docstrings.
PROGRESS, APPROACH, FINISHED, STEP, FAILURE = 10.0, 5.0, 1.0, -0.01, -5.0

#: Left and right may be exchanged.
MIRROR = Symmetry(
    "mirror",
    Permutation.flips(
        OBSERVATION_NAMES,
        (
            *("gripper_y", "gripper_vy", "object_y", "object_dy", "object_vy", "target_y", "target_dy"),
            *("line_y", "across", "turn_sin", "spin"),
        ),
    ),
    Permutation.flips(ACTION_NAMES, ("move_y",)),
)

REWARD_TYPES = ("dense", "potential", "sparse")

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_STILL = (0.0, 0.0, 0.0)


def bounded_box(size: int) -> spaces.Box:
    """Return the space of so many numbers of an observation."""
    return spaces.Box(-BOUND, BOUND, (size,), np.float32)


class PandaEnv(DomainEnv):
    """What the Panda environments have in common; see :class:`~progpolicy_envs.panda.PandaPushEnv` and the others.

    A subclass names its :attr:`task_class`, its variation parameters, the number of objects first, and its
    :attr:`controller`.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": round(1 / CONTROL_STEP)}
    task_class: ClassVar[type[Task]]
    variations: ClassVar[VariationSpace]
    #: A scripted controller that solves the task: from an observation ``(32,)`` to an action ``(4,)``, without memory.
    controller: ClassVar[Callable[[FlatObservation], Action]]
    observation_names: tuple[str, ...] = OBSERVATION_NAMES
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES
    symmetries: ClassVar[tuple[Symmetry, ...]] = (MIRROR,)

    def __init__(
        self,
        variation: Mapping[str, Any],
        *,
        reward_type: str = "dense",
        render_mode: str | None = None,
        physics: Physics | None = None,
        context: str = "hidden",
    ) -> None:
        check_choice("reward_type", reward_type, REWARD_TYPES)
        if not isinstance(physics, Physics | None):
            raise ValueError(f"physics={physics!r} is not accepted; it is a Physics, or None for the default")
        # Frames are shown in the time that they last.
        self.metadata = {**self.metadata, "render_fps": round(1 / (physics or Physics()).control_step)}
        super().__init__(variation, self._observed_space(), render_mode, context)
        self.reward_type = reward_type
        self.action_space = spaces.Box(-1.0, 1.0, (len(ACTION_NAMES),), np.float32)
        self.task = self.task_class()
        self.scene = Scene(self.task.table, self.task.kind, physics, visual=render_mode is not None)
        self._camera = Camera(self.scene, self.task) if render_mode is not None else None
        self._approach_distance = self._potential = 0.0
        self._failed = False

    def _observed_space(self) -> spaces.Space[Any]:
        """Return the space of observations, without the variation's numbers."""
        return bounded_box(len(OBSERVATION_NAMES))

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply one action for 1/30 s.

        :param action: ``(4,)`` numbers; those beyond [-1, 1] are clipped
        :return: observation, reward, terminated, truncated, info
        :raises ValueError: if the action has another shape or a number that is not finite
        """
        require_reset(self._started, "step()")
        action = np.asarray(action, dtype=np.float32)
        numbers = action.tolist()
        if action.shape != (len(ACTION_NAMES),) or not all(map(math.isfinite, numbers)):
            raise ValueError(f"action={action!r} is not accepted; an action is 4 finite numbers from -1 to 1")
        self.scene.act(numbers)
        self.scene.simulate()
        observation, reward, info = self.post_physics_step()
        self._show()
        return observation, reward, info["is_success"] or info["is_failure"], False, info

    def post_physics_step(self) -> tuple[Observation, float, dict[str, Any]]:
        """Read the world after the physics of a step; the last of a step's three parts.

        :return: observation, reward, info
        """
        task, index, achieved = self.task, self._focus, self._achieved
        self.scene.sync_state()
        task.update(self.scene)
        by_potential = self.reward_type == "potential"
        failure = self._failed = task.failed or (by_potential and task.out_of_reach)
        shaping = self._potential_shaping(failure) if by_potential else self._dense_shaping(failure)
        if self._focus != index:
            achieved = self._achieved  # the new object has made no progress yet
        info = {
            "is_success": self._n_left == 0,
            "is_failure": failure,
            "settled": task.settled(self.scene, self._focus),
            "previous_achieved_goal": achieved,
            "shaping": shaping,
        }
        observation = self._observation()
        return observation, self._reward(observation, info), info

    def _dense_shaping(self, failure: bool) -> float:
        """Return what the dense reward has besides the progress of the object in focus, and find the new focus."""
        index, achieved, n_left, before = self._focus, self._achieved, self._n_left, self._approach_distance
        self._approach_distance = self._distance_to_approach_point(index)
        shaping = STEP + APPROACH * (before - self._approach_distance) + FAILURE * failure
        self._update_focus(index)
        shaping += FINISHED * (n_left - self._n_left)
        if self._focus != index:
            # That of the old one, which is not in focus any more.
            target = self.task.targets[index]
            shaping += PROGRESS * (math.dist(achieved, target) - math.dist(self.task.positions[index], target))
        return shaping

    def _potential_shaping(self, failure: bool) -> float:
        """Return the reward by potential less the progress of the object in focus, and find the new focus."""
        index, achieved, before = self._focus, self._achieved, self._potential
        self._update_focus(index)
        shaping = STEP + self._potential - before + FAILURE * failure
        if self._focus == index:
            shaping -= PROGRESS * (math.dist(achieved, self._desired) - math.dist(self._achieved, self._desired))
        return shaping

    def potential(self) -> float:
        """Return the potential of the present state, whose gains are the reward of ``reward_type="potential"``."""
        require_reset(self._started, "potential()")
        return self._find_potential()

    def plan(self) -> Iterator[Action]:
        """Return an iterator of the scripted controller's actions, each for the state in which the environment then is.

        ``for action in env.unwrapped.plan(): env.step(action)`` solves the task, as in every environment of this
        package. It ends when the task is done or has failed; where the number of steps is limited, stop at
        ``truncated``.
        """
        require_reset(self._started, "plan()")
        return self._planned()

    @property
    def start(self) -> dict[str, Any]:
        """How the episode started, as data that JSON can hold; ``reset(options=...)`` takes it to start another so."""
        require_reset(self._started, "start")
        start = {"starts": self.task.starts, "targets": self.task.targets}
        places = {name: [list(place) for place in start[name]] for name in self.variations.starts}
        return {self._size: len(self.task.targets), "n_done": self.task.n_done, **places}

    def replace_start(self, start: Mapping[str, Any]) -> Observation:
        """Begin the episode once more with other starts or targets.

        :param start: ``starts``, ``targets`` or both; see the class
        :return: the observation
        :raises ValueError: if they are not accepted
        """
        require_reset(self._started, "replace_start()")
        if unknown := sorted(set(start) - set(self.variations.starts)):
            raise ValueError(f"{unknown} are not parts of a start; its parts are {', '.join(self.variations.starts)}")
        return self._replace_start(start)

    def _replace_start(self, start: Mapping[str, Any]) -> Observation:
        task = self.task
        given = {"starts": task.starts, "targets": task.targets, **start}
        read = task.read_start(len(task.targets), given["starts"], given["targets"], task.n_done)
        return self._place(*read, task.n_done)

    def render(self) -> Any:
        """Return a picture ``(360, 480, 3)`` of bytes, or show a window, as ``render_mode`` says."""
        require_reset(self._started, "render()")
        if self.render_mode == "rgb_array":
            return self._frame()
        self._show()
        return None

    def close(self) -> None:
        """Leave PyBullet and close the window, if there is one."""
        self.scene.close()
        super().close()

    def _planned(self) -> Iterator[Action]:
        while self._n_left and not self._failed:
            yield type(self).controller(self._flat_observation())

    def _start(self, variation: Variation, start: Mapping[str, Any]) -> None:
        starts, targets = self.task.sample(self.np_random, variation[self._size])
        self._place(starts, targets, draw_n_done(variation, self._size, self.np_random))
        if start:
            self._replace_start(start)

    def _place(self, starts: Points, targets: Points, n_done: int, neutral: bool = False) -> Observation:
        """Begin an episode; see :meth:`Task.place`. Return its observation."""
        self._failed = False
        self.task.place(self.scene, starts, targets, n_done, neutral)
        self._update_focus()
        return self._observation()

    @property
    def _size(self) -> str:
        """Name of the parameter that says how many objects there are."""
        return next(iter(self.variations))

    def _reward(self, observation: Any, info: Mapping[str, Any]) -> float:
        """Return the reward of the present step."""
        distance = math.dist(self._achieved, self._desired)
        if self.reward_type == "sparse":
            return 0.0 if distance < self.task.tolerance and info["settled"] else -1.0
        return PROGRESS * (math.dist(info["previous_achieved_goal"], self._desired) - distance) + info["shaping"]

    def _update_focus(self, before: int | None = None) -> None:
        """Find the object in focus and keep its state, from which progress is measured.

        :param before: the object that was in focus, whose distance to the gripper is up to date
        """
        self._focus = self.task.focus
        self._n_left = self.task.finished.count(False)
        self._achieved = self.task.positions[self._focus]
        self._desired = self.task.targets[self._focus]
        if self._focus != before:
            self._approach_distance = self._distance_to_approach_point(self._focus)
        if self.reward_type == "potential":
            self._potential = self._find_potential()

    def _find_potential(self) -> float:
        task = self.task
        left = PROGRESS * task.distance_left() + APPROACH * task.way_left(self.scene)
        return FINISHED * task.finished.count(True) - left

    def _distance_to_approach_point(self, index: int) -> float:
        point = self.task.approach_point(index)
        return 0.0 if point is None else math.dist(point, self.scene.robot.position)

    def _focus_state(self) -> ObjectState:
        """Return the object in focus; in Reach the gripper itself, in Slide a delivered puck where it was delivered."""
        if self.task.kind is None:
            return ObjectState(self._achieved, _UPRIGHT, self.scene.robot.velocity, _STILL)
        return self.scene.object_state(self._focus, self._achieved)

    def _flat_observation(self) -> FlatObservation:
        return focus_observation(self.scene.robot, self._focus_state(), self._desired, self._n_left)

    def _observe(self) -> Observation:
        return self._flat_observation()

    def _frame(self) -> Frame | None:
        return self._camera.frame(self._focus) if self._camera is not None else None
