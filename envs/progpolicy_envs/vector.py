"""What the batched environments share: variations and seeds by row, and the reset in the step that ends an episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, SupportsIndex, cast

import numpy as np
from gymnasium.spaces import Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from progpolicy_envs.planning import refuse_solved
from progpolicy_envs.single import require_reset
from progpolicy_envs.states import is_sequence
from progpolicy_envs.variation import Variation, VariationSpace, with_context

Infos = dict[str, Any]


class DomainVectorEnv(VectorEnv, ABC):
    """N environments of one task domain, reset within the step in which their episode ends.

    Autoreset is ``SAME_STEP``: where an episode ends, the returned observation opens the next one, and ``infos`` have
    the ended one in Gymnasium's form: ``infos["final_obs"][i]`` is its last observation and
    ``infos["final_info"]["is_success"][i]`` says whether it reached the goal, where ``infos["_final_obs"][i]`` and
    ``infos["_final_info"][i]`` are true. The other infos, such as ``infos["is_success"]``, are of the step itself, and
    not of the reset as in Gymnasium's own batches: what a planner needs from each new start is asked for, by
    ``optimal_steps()``, and not computed at each end. A variation is one value for all environments or a sequence of
    ``num_envs`` values.

    :param num_envs: number of environments
    :param observation_space: of one environment
    :param action_space: of one environment
    :param variation: the variation in force in every environment
    :param max_episode_steps: steps after which an episode is truncated; ``None`` or -1 for no limit
    :param context: ``"observed"`` if observations end with the variation's numbers, ``"hidden"`` if not
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
    variations: ClassVar[VariationSpace]
    #: Names of the numbers of an observation.
    observation_names: tuple[str, ...] = ()

    def __init__(
        self,
        num_envs: int,
        observation_space: Space[Any],
        action_space: Space[Any],
        variation: Variation,
        max_episode_steps: int | None,
        context: str = "hidden",
    ) -> None:
        check_num_envs(num_envs)
        observation_space = with_context(observation_space, self.variations.context_names, context)
        self.context = context
        if context == "observed":
            self.observation_names = (*type(self).observation_names, *self.variations.context_names)
        self.num_envs = num_envs
        self.single_observation_space = observation_space
        self.single_action_space = action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        if max_episode_steps is None or max_episode_steps == -1:
            max_episode_steps = np.iinfo(np.int64).max
        if max_episode_steps < 1:
            raise ValueError(
                f"max_episode_steps={max_episode_steps} is not accepted; it is at least 1, or None or -1 for no limit"
            )
        self.max_episode_steps = max_episode_steps
        self.row_variations: list[Variation] = [dict(variation) for _ in range(num_envs)]
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._rows = np.arange(num_envs)
        self._context = np.stack([self.variations.encode(variation)] * num_envs)
        self._generators: list[np.random.Generator] = [np.random.default_rng() for _ in range(num_envs)]
        self._started = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, Infos]:
        """Start a new episode in every environment.

        :param seed: environment ``i`` gets ``seed + i``, or ``seed[i]`` of a sequence; ``None`` keeps its generator
        :param options: new variation values by name, each one value or a sequence of ``num_envs`` values; and parts of
            the start of these episodes, in place of drawn ones, each a sequence with ``None`` where it is drawn
        :return: observations ``(num_envs, *observation)`` and infos of arrays with ``num_envs`` entries
        :raises ValueError: if an option is not accepted; the variations in force are then unchanged, and if it was part
            of a start, another reset is needed
        """
        variations, starts = self._read_options(options)
        self._seed_rows(seed)
        self._started = False
        before, self.row_variations = self.row_variations, variations
        if options:
            self._changed_variations()
        self._elapsed[:] = 0
        try:
            self._reset_rows(self._rows)
            for row, start in enumerate(starts):
                if start:
                    self._set_start(row, start)
            self._check_starts(starts)
        except ValueError:
            self.row_variations = before
            self._changed_variations()
            raise
        self._started = True
        return self._observation(), self._reset_infos()

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Infos]:
        """Apply one action in every environment.

        :param actions: ``(num_envs, *action)``, each in the single action space
        :return: observations, rewards, terminated, truncated, infos
        :raises ValueError: if ``actions`` has the wrong shape or holds an action that is not accepted
        """
        require_reset(self._started, "step()")
        rewards, terminated, infos = self._apply(self._checked(np.asarray(actions)))
        self._elapsed += 1
        truncated = self._elapsed >= self.max_episode_steps
        observations = self._observation()
        done = terminated | truncated
        (ended,) = done.nonzero()
        if len(ended):
            infos.update(_final(observations, infos, done, ended))
            self._elapsed[ended] = 0
            self._reset_rows(ended)
            observations = self._observation()
        return observations, rewards, terminated, truncated, infos

    def _changed_variations(self) -> None:
        self._read_variations()
        if self.context == "observed":
            self._context = np.stack([self.variations.encode(variation) for variation in self.row_variations])

    def _observation(self) -> Any:
        """Return the observations, with the variations' numbers if they are observed."""
        observations = self._observe()
        if self.context == "hidden":
            return observations
        return np.concatenate([observations, self._context], axis=1, dtype=np.float32)

    @abstractmethod
    def _checked(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return the actions, or raise ``ValueError``."""

    @abstractmethod
    def _reset_rows(self, rows: NDArray[np.intp]) -> None:
        """Put the given environments into a starting state of their variation."""

    def _read_variations(self) -> None:
        """Read changed :attr:`row_variations`; for a subclass that keeps something that follows from them."""

    @abstractmethod
    def _set_start(self, row: int, start: Mapping[str, Any]) -> None:
        """Replace parts of the start of one environment, which has just been reset."""

    def _check_starts(self, starts: Sequence[Mapping[str, Any]]) -> None:
        """Raise ``ValueError`` for a start in which nothing is left to be done.

        :param starts: the given parts of each
        """

    @abstractmethod
    def _apply(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_], Infos]:
        """Change the state by one action each; return rewards, whether an end is reached, and infos."""

    @abstractmethod
    def _observe(self) -> Any:
        """Return the observations ``(num_envs, *observation)`` in arrays of their own."""

    def _reset_infos(self) -> Infos:
        return {
            "variation": np.array([dict(variation) for variation in self.row_variations], dtype=object),
            "is_success": np.zeros(self.num_envs, dtype=bool),
        }

    def _seed_rows(self, seed: int | Sequence[int | None] | None) -> None:
        if seed is None:
            return
        seeds: list[int | None]
        if isinstance(seed, SupportsIndex) and not is_sequence(seed):  # an array can be an index, too
            seeds = [int(seed) + row for row in range(self.num_envs)]
        else:
            given = cast("Sequence[int | None]", seed)
            seeds = [None if row_seed is None else int(row_seed) for row_seed in given]
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds given for {self.num_envs} environments")
        for row, row_seed in enumerate(seeds):
            if row_seed is not None:
                self._generators[row] = np.random.Generator(np.random.PCG64(np.random.SeedSequence(row_seed)))

    def _read_options(self, options: Mapping[str, Any] | None) -> tuple[list[Variation], list[dict[str, Any]]]:
        """Return the new variation of each environment, and the parts of its start that are given."""
        changes, given = self.variations.split(options)
        rows = [dict[str, Any]() for _ in range(self.num_envs)]
        starts = [dict[str, Any]() for _ in range(self.num_envs)]
        for name, value in changes.items():
            for row, row_value in zip(rows, self._per_row(name, value), strict=True):
                row[name] = row_value
        for name, value in given.items():
            if not is_sequence(value):
                raise ValueError(f"{name}={value!r} is not accepted; a batch needs one for each environment, or None")
            for start, row_value in zip(starts, self._per_row(name, value), strict=True):
                if row_value is not None:
                    start[name] = row_value
        variations = [self.variations.update(old, new) for old, new in zip(self.row_variations, rows, strict=True)]
        return variations, starts

    def _per_row(self, name: str, value: Any) -> list[Any]:
        """Return the values of an option that are given for all environments at once, or one for each."""
        parameter = self.variations.get(name)
        one = not is_sequence(value) or (parameter is not None and parameter.is_one_value(value))
        values = [value] * self.num_envs if one else list(value)
        if len(values) != self.num_envs:
            raise ValueError(f"{name}: {len(values)} values given for {self.num_envs} environments")
        return values


class PlanningVectorEnv(DomainVectorEnv):
    """N environments of a planning domain, stepped by array operations.

    A subclass keeps its state in arrays whose first axis is the environment and implements :meth:`_reset_rows`,
    :meth:`_move`, :meth:`_observe`, :meth:`_state_of`, :meth:`_set_state_of` and :meth:`_optimal_steps`; and
    :meth:`count_starts` and :meth:`_put_starts` where its starts can be counted.
    """

    @classmethod
    def count_starts(cls, variation: Mapping[str, Any], any_state: bool = False) -> int:
        """Return in how many states an episode of a variation can begin.

        A parameter that is not given has its default, or all its values where it may be ``"random"``.

        :param variation: values of parameters
        :param any_state: count all legal states instead
        :raises ValueError: if they cannot be counted
        """
        raise ValueError(f"the {'states' if any_state else 'starts'} of {dict(variation)} cannot be counted")

    @classmethod
    def _counted(cls, variation: Mapping[str, Any]) -> Variation:
        """Return the whole variation whose starts are counted."""
        return cls.variations.update(cls.variations.defaults, variation)

    def reset_to(self, variation: Mapping[str, Any], numbers: NDArray[np.int64], any_state: bool = False) -> Any:
        """Begin an episode in every environment in the start of a number.

        :param variation: see :meth:`count_starts`
        :param numbers: ``(num_envs,)``, from 0 to ``count_starts(...) - 1``
        :param any_state: see :meth:`count_starts`
        :return: observations
        :raises ValueError: if a value is not accepted
        """
        count = self.count_starts(variation, any_state)
        if numbers.shape != (self.num_envs,) or numbers.min() < 0 or numbers.max() >= count:
            raise ValueError(f"numbers={numbers!r} are not accepted; {self.num_envs} from 0 to {count - 1} are")
        row_variation = self._counted(variation)
        self.row_variations = [row_variation] * self.num_envs
        self._changed_variations()
        self._elapsed[:] = 0
        self._put_starts(row_variation, variation, numbers, any_state)
        self._started = True
        return self._observation()

    def advance(
        self, actions: NDArray[np.integer]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]:
        """Apply one action in every environment, and begin no new episode where one ends.

        :param actions: ``(num_envs,)``
        :return: observations, rewards, and where the goal is reached
        """
        require_reset(self._started, "advance()")
        rewards, solved = self._move(self._checked(actions))
        return self._observation(), rewards, solved

    def state_of(self, row: int) -> dict[str, Any]:
        """Return the present state of one environment, which ``reset(options=...)`` of the single form takes."""
        require_reset(self._started, "state_of()")
        return self._state_of(row)

    @abstractmethod
    def _put_starts(
        self, variation: Variation, given: Mapping[str, Any], numbers: NDArray[np.int64], any_state: bool
    ) -> None:
        """Put every environment into the start of a number.

        :param variation: the whole variation
        :param given: those of its values that were given
        :param numbers: ``(num_envs,)``, each below :meth:`count_starts`
        :param any_state: whether they number all legal states
        """

    def optimal_steps(self) -> NDArray[np.int64]:
        """Return how many steps the planner needs from each environment's present state, ``(num_envs,)``."""
        require_reset(self._started, "optimal_steps()")
        return self._optimal_steps()

    def _set_start(self, row: int, start: Mapping[str, Any]) -> None:
        self._set_state_of(row, self._completed(row, start))

    def _completed(self, row: int, start: Mapping[str, Any]) -> dict[str, Any]:
        """Return the state that begins an episode in one environment, as the single form does."""
        return {**self._state_of(row), **start}

    def _check_starts(self, starts: Sequence[Mapping[str, Any]]) -> None:
        if any(starts):
            for start, steps in zip(starts, self._optimal_steps().tolist(), strict=True):
                if start:
                    refuse_solved(start, steps)

    @abstractmethod
    def _state_of(self, row: int) -> dict[str, Any]:
        """Return the state of one environment, as the single form does."""

    @abstractmethod
    def _set_state_of(self, row: int, state: Mapping[str, Any]) -> None:
        """Check a whole state and put one environment into it."""

    @abstractmethod
    def _move(self, actions: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Change the state by one action each; return rewards and whether the goal is reached."""

    @abstractmethod
    def _optimal_steps(self) -> NDArray[np.int64]:
        """Return the planner's number of steps from each environment's present state."""

    def _checked(self, actions: NDArray[Any]) -> NDArray[Any]:
        n_actions = self.single_action_space.n  # type: ignore[attr-defined]
        whole = np.issubdtype(actions.dtype, np.integer)
        if not whole or actions.shape != (self.num_envs,) or actions.min() < 0 or actions.max() >= n_actions:
            raise ValueError(
                f"actions of shape {actions.shape}, type {actions.dtype} and values {actions!r} are not accepted; "
                f"needed: shape ({self.num_envs},), integers from 0 to {n_actions - 1}"
            )
        return actions

    def _apply(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.bool_], Infos]:
        rewards, solved = self._move(actions)
        return rewards, solved, {"is_success": solved}

    def _reset_infos(self) -> Infos:
        return {**super()._reset_infos(), "optimal_steps": self._optimal_steps()}


def check_num_envs(num_envs: int) -> None:
    """Raise ``ValueError`` for a number of environments below 1."""
    if num_envs < 1:
        raise ValueError(f"num_envs={num_envs} is not accepted; it is at least 1")


def _final(observations: Any, infos: Infos, done: NDArray[np.bool_], ended: NDArray[np.intp]) -> Infos:
    """Return the last observations and infos of the episodes that have ended; masks ``_name`` say which have."""
    final_obs = np.full(len(done), None, dtype=object)
    if isinstance(observations, dict):
        last = {key: values[ended] for key, values in observations.items()}
        for i, row in enumerate(ended.tolist()):
            final_obs[row] = {key: values[i] for key, values in last.items()}
    else:
        for row, observation in zip(ended.tolist(), observations[ended], strict=True):
            final_obs[row] = observation
    final_info = {**infos, **{f"_{name}": done for name in infos}}
    return {"final_obs": final_obs, "_final_obs": done, "final_info": final_info, "_final_info": done}
