"""Who is imitated: the environment's own planner, a trained model, or a function of observations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Union, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.vector import PlanningVectorEnv
from sb3_progpolicy.analysis.situations import good_actions
from sb3_progpolicy.interaction import interaction_space
from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.spaces import ActionSpec, action_spec, encode_actions

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

Observations = NDArray[np.floating]
TeacherLike = Union[str, "BaseAlgorithm", ProgramData, Callable[[Observations], NDArray[Any]], "Teacher"]
PLANNER = "planner"
_STATES_AT_ONCE = 500


@dataclass(frozen=True)
class Situation:
    """What a teacher may look at when it says what it would do, one row for each environment.

    :param observations: ``(n_envs, n_observations)``
    :param envs: the environments themselves
    :param actions: those taken last, ``(n_envs, *action_shape)``; ``None`` before the first
    :param rewards: received last, ``(n_envs,)``
    :param dones: whether an episode has just begun, ``(n_envs,)``
    """

    observations: Observations
    envs: Sequence[Any]
    actions: NDArray[Any] | None
    rewards: NDArray[np.float32]
    dones: NDArray[np.bool_]


def join_history(
    observations: Observations,
    actions: NDArray[Any] | None,
    rewards: NDArray[np.float32],
    dones: NDArray[np.bool_],
    spec: ActionSpec,
) -> NDArray[np.float32]:
    """Return X = [observation, previous action, previous reward, previous done]; see :class:`Situation`."""
    previous = np.zeros((len(observations), spec.history_size), dtype=np.float32)
    if actions is not None:
        previous = encode_actions(actions, spec)
    return np.concatenate((observations, previous, rewards[:, None], dones[:, None]), axis=1, dtype=np.float32)


def checked_labels(labels: Any, spec: ActionSpec, n_rows: int, name: str) -> NDArray[Any]:
    """Return what a teacher said as actions: ``(n_rows,)`` whole numbers if Discrete, else ``(n_rows, n_numbers)``.

    :param labels: what it returned
    :param spec: the action space
    :param n_rows: number of observations that it was asked about
    :param name: of the teacher
    :raises ValueError: if these are not actions of the space, one for each observation
    """
    given = np.asarray(labels)
    is_box, kinds = spec.kind == "box", "fiub" if spec.kind == "box" else "iub"
    width = len(spec.low) if is_box else 1
    if given.dtype.kind in kinds and given.ndim and len(given) == n_rows and given.size == n_rows * width:
        if is_box:
            actions = given.reshape(n_rows, width).astype(given.dtype if given.dtype.kind == "f" else np.float32)
            if np.isfinite(actions).all():
                return actions
        else:
            numbers = given.reshape(n_rows).astype(np.int64)
            if n_rows == 0 or (numbers.min() >= spec.start and numbers.max() < spec.start + spec.sizes[0]):
                return numbers
    last = spec.start + spec.sizes[0] - 1
    accepted = f"{width} finite numbers" if is_box else f"a whole number from {spec.start} to {last}"
    shown = " ".join(str(given).split())
    raise ValueError(
        f"the teacher {name} returned {shown if len(shown) < 100 else shown[:100] + ' ...'} of shape {given.shape} and "
        f"type {given.dtype} for {n_rows} observations; accepted are arrays of {n_rows} actions, each {accepted}"
    )


class Teacher(Protocol):
    """Labels states with actions."""

    name: str

    def begin(self) -> None:
        """Forget everything: other environments are looked at from now on."""

    def label(self, situation: Situation) -> NDArray[Any]:
        """Return the teacher's actions ``(n_envs, *action_shape)``."""

    def label_alone(self, observations: Observations, env: Any) -> NDArray[Any]:
        """Return actions for observations that no environment is in, ``(n, *action_shape)``.

        :raises ValueError: if this teacher cannot tell
        """


class PlannerTeacher:
    """The first action of ``env.unwrapped.plan()``: a shortest solution, or the scripted controller of a Panda task.

    :param env: an environment of the domain
    """

    name = PLANNER

    def __init__(self, env: Any) -> None:
        self._batch: PlanningVectorEnv | None = None
        if env.spec is not None and env.spec.vector_entry_point is not None:
            batch = gym.make_vec(env.spec.id, num_envs=1, vectorization_mode="vector_entry_point").unwrapped
            self._batch = batch if isinstance(batch, PlanningVectorEnv) else None

    def begin(self) -> None:
        """See :meth:`Teacher.begin`."""

    def label(self, situation: Situation) -> NDArray[Any]:
        """See :meth:`Teacher.label`."""
        return np.array([next(iter(env.unwrapped.plan())) for env in situation.envs])

    def good_actions(self, states: Sequence[Mapping[str, Any]]) -> NDArray[np.bool_]:
        """Return all actions that begin a shortest solution, ``(n_states, n_actions)``.

        :param states: of a planning domain
        """
        assert self._batch is not None
        parts = range(0, len(states), _STATES_AT_ONCE)
        return np.concatenate([good_actions(states[at : at + _STATES_AT_ONCE], self._batch) for at in parts])

    @property
    def knows_all(self) -> bool:
        """Whether :meth:`good_actions` is known: in a planning domain."""
        return self._batch is not None

    def label_alone(self, observations: Observations, env: Any) -> NDArray[Any]:
        """Ask the scripted controller, where there is one. See :meth:`Teacher.label_alone`."""
        controller = getattr(type(env.unwrapped), "controller", None)
        if controller is None:
            raise _needs_states(self.name)
        return np.array([controller(observation) for observation in observations])


class FunctionTeacher:
    """A function from observations to actions.

    :param function: from ``(n_envs, n_observations)`` to ``(n_envs, *action_shape)``
    """

    def __init__(self, function: Callable[[Observations], NDArray[Any]]) -> None:
        self.function = function
        self.name = getattr(function, "__name__", type(function).__name__)

    def begin(self) -> None:
        """See :meth:`Teacher.begin`."""

    def label(self, situation: Situation) -> NDArray[Any]:
        """See :meth:`Teacher.label`."""
        return np.asarray(self.function(situation.observations))

    def label_alone(self, observations: Observations, env: Any) -> NDArray[Any]:
        """See :meth:`Teacher.label_alone`."""
        return np.asarray(self.function(observations))


class ProgramTeacher:
    """A program, crisp, with its memory and its interaction history.

    :param program: the program
    """

    def __init__(self, program: ProgramData) -> None:
        self.program, self.name = program, "program"
        self._runner: ProgramRunner | None = None

    def begin(self) -> None:
        """See :meth:`Teacher.begin`."""
        self._runner = None

    def label(self, situation: Situation) -> NDArray[Any]:
        """See :meth:`Teacher.label`."""
        if self._runner is None:
            self._runner = ProgramRunner(self.program, len(situation.observations))
        inputs = join_inputs(
            self.program, situation.observations, situation.actions, situation.rewards, situation.dones
        )
        return self._runner.act(inputs)

    def label_alone(self, observations: Observations, env: Any) -> NDArray[Any]:
        """See :meth:`Teacher.label_alone`."""
        raise _needs_states(self.name)


class ModelTeacher:
    """A model of SB3 or sb3-contrib with its most likely actions.

    It sees what it saw in training: observations normalised by its ``VecNormalize``, the interaction history where its
    observation space has room for it, and its recurrent state.

    :param model: the model
    :param observation_space: of one environment
    :param spec: the action space
    :raises ValueError: if the model reads something else or acts in another space
    """

    def __init__(self, model: BaseAlgorithm, observation_space: Any, spec: ActionSpec) -> None:
        from sb3_progpolicy.extraction import wrappers_of
        from sb3_progpolicy.surroundings import refuse_wrappers

        env = model.get_env()
        refuse_wrappers("the teacher", getattr(model, "wrappers", ()) if env is None else wrappers_of(env))
        self.model, self.spec, self.name = model, spec, type(model).__name__
        self.normalizer = model.get_vec_normalize_env()
        assert model.observation_space is not None
        assert model.action_space is not None
        if action_spec(model.action_space) != spec:
            raise ValueError(f"the teacher acts in {model.action_space}; the environment's actions are {spec}")
        joined = interaction_space(observation_space, spec)
        self.joins_history = model.observation_space.shape == joined.shape
        if not self.joins_history and model.observation_space.shape != observation_space.shape:
            raise ValueError(
                f"the teacher reads observations {model.observation_space.shape}; the environment has "
                f"{observation_space.shape}, or {joined.shape} with the interaction history"
            )
        self._state: Any = None

    def begin(self) -> None:
        """See :meth:`Teacher.begin`."""
        self._state = None

    def label(self, situation: Situation) -> NDArray[Any]:
        """See :meth:`Teacher.label`."""
        observations, rewards = np.asarray(situation.observations), situation.rewards
        if self.normalizer is not None:
            observations = cast(NDArray[Any], self.normalizer.normalize_obs(observations))
            rewards = self.normalizer.normalize_reward(rewards)
        if self.joins_history:
            observations = join_history(observations, situation.actions, rewards, situation.dones, self.spec)
        actions, self._state = self.model.predict(observations, self._state, situation.dones, deterministic=True)
        return actions

    def label_alone(self, observations: Observations, env: Any) -> NDArray[Any]:
        """See :meth:`Teacher.label_alone`."""
        raise _needs_states(self.name)


def make_teacher(teacher: TeacherLike, env: Any) -> Teacher:
    """Return what labels states.

    :param teacher: ``"planner"``, a model of SB3 or sb3-contrib, a program, or a function from observations to actions
    :param env: an environment in which it acts
    :raises ValueError: if it is none of these or does not fit the environment
    """
    if hasattr(teacher, "label"):
        return cast(Teacher, teacher)
    if isinstance(teacher, ProgramData):
        return ProgramTeacher(teacher)
    if isinstance(teacher, str):
        if teacher != PLANNER:
            raise _not_a_teacher(teacher)
        if not hasattr(env.unwrapped, "plan"):
            from progpolicy_envs import DOMAINS

            name = env.spec.id if env.spec else env
            raise ValueError(f"{name} has no planner; these have: {', '.join(DOMAINS)}")
        return PlannerTeacher(env)
    if hasattr(teacher, "predict") and hasattr(teacher, "get_vec_normalize_env"):
        return ModelTeacher(cast(Any, teacher), env.observation_space, action_spec(env.action_space))
    if callable(teacher):
        return FunctionTeacher(teacher)
    raise _not_a_teacher(teacher)


def _needs_states(name: str) -> ValueError:
    return ValueError(
        f"augment is not accepted for the teacher {name}, which is asked about states of an episode; functions and "
        "scripted controllers are asked about any observation"
    )


def _not_a_teacher(given: object) -> ValueError:
    accepted = "it is 'planner', a model of Stable-Baselines3, a program, or a function from observations to actions"
    return ValueError(f"teacher={given!r} is not accepted; {accepted}")
