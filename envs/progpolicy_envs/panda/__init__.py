"""Four manipulation tasks for a Franka Panda in PyBullet, on any number of objects behind one observation."""

from __future__ import annotations

from typing import Any, ClassVar

from progpolicy_envs.panda.env import PandaEnv
from progpolicy_envs.panda.scene import MAX_OBJECTS, PANDA_GYM_PHYSICS, Physics
from progpolicy_envs.panda.tasks import Push, Reach, Slide, Stack, Task
from progpolicy_envs.variation import IntParameter, VariationSpace

_OBJECTS = VariationSpace(IntParameter("n_objects", 1, MAX_OBJECTS, "number of objects"))


class PandaReachEnv(PandaEnv):
    """TODO"""
    task_class: ClassVar[type[Task]] = Reach
    variations: ClassVar[VariationSpace] = VariationSpace(IntParameter("n_targets", 1, MAX_OBJECTS, "number of targets"))

    def __init__(self, n_targets: int = 1, *, observation: str = "flat", reward_type: str = "dense", render_mode: str | None = None, physics: Physics | None = None) -> None:
        super().__init__({"n_targets": n_targets}, observation=observation, reward_type=reward_type, render_mode=render_mode, physics=physics)


class _ObjectsEnv(PandaEnv):
    variations: ClassVar[VariationSpace] = _OBJECTS

    def __init__(self, n_objects: int = 1, *, observation: str = "flat", reward_type: str = "dense", render_mode: str | None = None, physics: Physics | None = None) -> None:
        super().__init__({"n_objects": n_objects}, observation=observation, reward_type=reward_type, render_mode=render_mode, physics=physics)


class PandaPushEnv(_ObjectsEnv):
    """TODO"""
    task_class: ClassVar[type[Task]] = Push


class PandaSlideEnv(_ObjectsEnv):
    """TODO"""
    task_class: ClassVar[type[Task]] = Slide


class PandaStackEnv(_ObjectsEnv):
    """TODO"""
    task_class: ClassVar[type[Task]] = Stack
