"""What Hiking-v0 and HikingEgo-v0 share: a hiker who collects stars on the pathways of a map, alone or in a batch."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from progpolicy_envs.counting import subsets
from progpolicy_envs.hikes import VARIATIONS, completed, draw_task, layout_value, named_layout, read_state
from progpolicy_envs.layouts import (
    DIRECTIONS,
    LAYOUTS,
    N_CELLS,
    N_COLUMNS,
    NEIGHBOURS,
    PATH,
    RANDOM_LAYOUTS,
    STAR,
    START,
    Layout,
)
from progpolicy_envs.planners import hiking as planner
from progpolicy_envs.planning import PlanningEnv
from progpolicy_envs.rendering import hiking_frame
from progpolicy_envs.variation import RANDOM, Variation, VariationSpace
from progpolicy_envs.vector import PlanningVectorEnv

STEP_REWARD, ILLEGAL_REWARD, STAR_REWARD = -0.01, -0.05, 1.0

ACTION_NAMES = tuple(DIRECTIONS)
BLOCKED, PATHWAY = -1.0, 0.0
_OBSERVATION_SPACE = spaces.Box(-1.0, 1.0, (N_CELLS,), dtype=np.float32)


class MapView:
    """How a map is written in numbers, of which an observation shows some.

    Rock, water and what lies beyond the map are -1, a pathway is 0; a subclass says what a star and the hiker are.
    """

    #: The number of a pathway cell with a star, and of the hiker's own cell.
    star_value: ClassVar[float]
    hiker_value: ClassVar[float]
    #: How many numbers a map has, and which of them belongs to each of its 80 cells.
    n_numbers: ClassVar[int]
    places: ClassVar[NDArray[np.int64]]

    @classmethod
    def ground(cls, layout: Layout) -> NDArray[np.float32]:
        """Return the numbers of a map without stars and hiker, ``(n_numbers,)``."""
        numbers = np.full(cls.n_numbers, BLOCKED, dtype=np.float32)
        numbers[cls.places[layout.is_path]] = PATHWAY
        return numbers


class PathwayEnv(MapView, PlanningEnv):
    """A hiker on the pathways of a map; a subclass says what of it is seen."""

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "ansi"], "render_fps": 8}
    variations: ClassVar[VariationSpace] = VARIATIONS
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES

    def __init__(
        self,
        n_stars: int = 3,
        layout: str | Sequence[str] = "valley",
        render_mode: str | None = None,
        context: str = "hidden",
        n_done: int | str = 0,
    ) -> None:
        variation = {"n_stars": n_stars, "layout": layout, "n_done": n_done}
        super().__init__(variation, _OBSERVATION_SPACE, render_mode, context)
        self.action_space = spaces.Discrete(len(ACTION_NAMES))
        self.n_stars = 0
        self.hiker = 0
        self.stars: set[int] = set()

    def step(self, action: np.int64 | int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Walk one cell, if it is a pathway.

        :param action: 0 north, 1 east, 2 south, 3 west
        :return: observation, reward, terminated, truncated, info
        :raises ValueError: if the action is out of range
        """
        ahead = int(NEIGHBOURS[self.hiker, self._check_action(action)])
        reward = STEP_REWARD
        if ahead == self.hiker or not self.layout.is_path[ahead]:
            reward += ILLEGAL_REWARD
        else:
            self.hiker = ahead
        if self.hiker in self.stars:
            self.stars.remove(self.hiker)
            reward += STAR_REWARD
        solved = not self.stars
        self._show()
        return self._observation(), reward, solved, False, {"is_success": solved}

    def _draw(self, variation: Variation) -> None:
        n_stars, layout, hiker, stars = draw_task(self.np_random, variation)
        self._place(n_stars, layout, int(hiker), stars.tolist())

    def _state(self) -> dict[str, Any]:
        return {
            "n_stars": self.n_stars,
            "layout": layout_value(self.layout),
            "hiker": list(divmod(self.hiker, N_COLUMNS)),
            "stars": [list(cell) for cell in self._star_cells()],
        }

    def _completed(self, variation: Variation, start: Mapping[str, Any]) -> dict[str, Any]:
        return completed(variation, self._state(), start, self.np_random)

    def _set_state(self, state: Mapping[str, Any]) -> None:
        self._place(*read_state(state))

    def _place(self, n_stars: int, layout: Layout, hiker: int, stars: list[int]) -> None:
        self.n_stars, self.layout, self.hiker, self.stars = n_stars, layout, hiker, set(stars)
        self._ground = self.ground(layout)

    def _plan(self) -> list[int]:
        return planner.plan(self.layout, self.hiker, sorted(self.stars))

    def _optimal_steps(self) -> int:
        return planner.optimal_steps(self.layout, self.hiker, sorted(self.stars))

    def _observe(self) -> NDArray[np.float32]:
        numbers = self._ground.copy()
        numbers[self.places[list(self.stars)]] = self.star_value
        numbers[self.places[self.hiker]] = self.hiker_value
        return self._seen(numbers)

    @abstractmethod
    def _seen(self, numbers: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the part of the map that is seen.

        :param numbers: of the map with stars and hiker, ``(n_numbers,)``; an array of its own
        """

    def _frame(self) -> NDArray[np.uint8]:
        return hiking_frame(self.layout.rows, divmod(self.hiker, N_COLUMNS), self._star_cells(), self.n_stars)

    def _star_cells(self) -> list[tuple[int, int]]:
        return [divmod(star, N_COLUMNS) for star in sorted(self.stars)]

    def _text(self) -> str:
        rows = [list(row.replace(START, PATH).replace(STAR, PATH)) for row in self.layout.rows]
        for row, column in self._star_cells():
            rows[row][column] = STAR
        rows[self.hiker // N_COLUMNS][self.hiker % N_COLUMNS] = START
        return "\n".join("".join(row) for row in rows) + "\n"


class PathwayVectorEnv(MapView, PlanningVectorEnv):
    """N hikers stepped at once, equal to N :class:`PathwayEnv` step for step; a subclass says what is seen.

    The numbers of all cells are kept up to date in one array, so that what is seen is a part of its rows.

    :param num_envs: number of environments
    :param n_stars: number of stars
    :param layout: the map
    :param max_episode_steps: steps after which an episode is truncated; ``None`` for no limit
    :param context: whether observations end with the variation's numbers
    :param n_done: stars that have been collected at the start
    """

    variations: ClassVar[VariationSpace] = VARIATIONS
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES

    def __init__(
        self,
        num_envs: int = 1,
        n_stars: int = 3,
        layout: str | Sequence[str] = "valley",
        max_episode_steps: int | None = None,
        context: str = "hidden",
        n_done: int | str = 0,
    ) -> None:
        variation = self.variations.update({}, {"n_stars": n_stars, "layout": layout, "n_done": n_done})
        actions = spaces.Discrete(len(ACTION_NAMES))
        super().__init__(num_envs, _OBSERVATION_SPACE, actions, variation, max_episode_steps, context)
        self._numbers = np.full((num_envs, self.n_numbers), BLOCKED, dtype=np.float32)
        self._first_places = self._rows * self.n_numbers
        self._hikers = np.zeros(num_envs, dtype=np.int64)
        self._stars_left = np.zeros(num_envs, dtype=np.int64)
        self._layouts: list[Layout] = [LAYOUTS["valley"]] * num_envs
        self._stars: list[NDArray[np.int64]] = [np.zeros(0, dtype=np.int64)] * num_envs

    def _reset_rows(self, rows: NDArray[np.intp]) -> None:
        for row in rows:
            _, layout, hiker, stars = draw_task(self._generators[row], self.row_variations[row])
            self._place(row, layout, hiker, stars)

    @classmethod
    def count_starts(cls, variation: Mapping[str, Any], any_state: bool = False) -> int:
        """Return the number of sets of stars on a map, each with every place of a hiker who has collected some already.

        See :class:`PlanningVectorEnv`.
        """
        whole = cls.variations.update(cls.variations.defaults, variation)
        n_done = whole.get("n_done", 0)
        if any_state or whole["layout"] in RANDOM_LAYOUTS or n_done == RANDOM:
            return super().count_starts(variation, any_state)
        n_cells, n_left = len(named_layout(whole["layout"]).star_cells), whole["n_stars"] - n_done
        return math.comb(n_cells, n_left) * (n_cells - n_left if n_done else 1)

    def _put_starts(
        self, variation: Variation, given: Mapping[str, Any], numbers: NDArray[np.int64], any_state: bool
    ) -> None:
        layout = named_layout(variation["layout"])
        cells, n_done = np.array(layout.star_cells), variation.get("n_done", 0)
        n_left = variation["n_stars"] - n_done
        numbers, places = np.divmod(numbers, len(cells) - n_left) if n_done else (numbers, numbers)
        for row, chosen in enumerate(subsets(numbers, len(cells), n_left)):
            hiker = np.delete(cells, chosen)[places[row]] if n_done else layout.start
            self._place(row, layout, hiker, cells[chosen])

    def _place(self, row: int | np.intp, layout: Layout, hiker: int | np.int64, stars: NDArray[np.int64]) -> None:
        numbers, places = self._numbers[row], self.places
        numbers[:] = self.ground(layout)
        numbers[places[stars]] = self.star_value
        numbers[places[hiker]] = self.hiker_value
        self._layouts[row], self._stars[row] = layout, stars
        self._hikers[row], self._stars_left[row] = hiker, len(stars)

    def _move(self, actions: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        numbers, hikers, places = self._numbers.ravel(), self._hikers, self.places
        ahead = NEIGHBOURS[hikers, actions]
        number = numbers[self._first_places + places[ahead]]
        legal = (ahead != hikers) & (number != BLOCKED)
        found = legal & (number == self.star_value)
        numbers[self._first_places + places[hikers]] = PATHWAY
        self._hikers = np.where(legal, ahead, hikers)
        numbers[self._first_places + places[self._hikers]] = self.hiker_value
        self._stars_left -= found
        rewards = np.where(legal, STEP_REWARD, STEP_REWARD + ILLEGAL_REWARD) + STAR_REWARD * found
        return rewards, self._stars_left == 0

    def _left(self, row: int) -> list[int]:
        """Return the cells of the stars that are left in one environment."""
        stars = self._stars[row]
        return stars[self._numbers[row, self.places[stars]] == self.star_value].tolist()

    def _state_of(self, row: int) -> dict[str, Any]:
        return {
            "n_stars": self.row_variations[row]["n_stars"],
            "layout": layout_value(self._layouts[row]),
            "hiker": list(divmod(int(self._hikers[row]), N_COLUMNS)),
            "stars": [list(divmod(star, N_COLUMNS)) for star in self._left(row)],
        }

    def _completed(self, row: int, start: Mapping[str, Any]) -> dict[str, Any]:
        return completed(self.row_variations[row], self._state_of(row), start, self._generators[row])

    def _set_state_of(self, row: int, state: Mapping[str, Any]) -> None:
        _, layout, hiker, stars = read_state(state)
        self._place(row, layout, hiker, np.array(stars, dtype=np.int64))

    def _optimal_steps(self) -> NDArray[np.int64]:
        steps = np.zeros(self.num_envs, dtype=np.int64)
        left = [self._left(row) for row in range(self.num_envs)]
        n_left = np.array([len(stars) for stars in left])
        for n in np.unique(n_left):
            rows = np.flatnonzero(n_left == n)
            distances = [planner.tour_distances(self._layouts[row], int(self._hikers[row]), left[row]) for row in rows]
            steps[rows] = planner.tour_lengths(np.stack(distances))
        return steps
