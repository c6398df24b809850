"""Hiking-v0: collect the stars on the pathways of a map."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from progpolicy_envs.layouts import (
    DIRECTIONS,
    LAYOUTS,
    N_CELLS,
    N_COLUMNS,
    N_RANDOM_LAYOUTS,
    N_ROWS,
    NEIGHBOURS,
    Layout,
    random_layout,
)
from progpolicy_envs.planners import hiking as planner
from progpolicy_envs.planning import PlanningEnv
from progpolicy_envs.rendering import hiking_frame
from progpolicy_envs.variation import ChoiceParameter, IntParameter, Variation, VariationSpace
from progpolicy_envs.vector import PlanningVectorEnv

Observation = Literal["map", "egocentric"]

MAX_STARS = 12
RANDOM = "random"
VARIATIONS = VariationSpace(
    IntParameter("n_stars", 1, MAX_STARS, "number of stars"),
    ChoiceParameter("layout", (*LAYOUTS, RANDOM), "the map; 'random' draws another one for every episode"),
)
STEP_REWARD, ILLEGAL_REWARD, STAR_REWARD = -0.01, -0.05, 1.0

ACTION_NAMES = tuple(DIRECTIONS)
REACH = 4  # cells that the egocentric window shows to each side
_WINDOW = 2 * REACH + 1
_WIDTH = N_COLUMNS + 2 * REACH
BLOCKED = -1.0
#: What a star and the hiker add to the 0 of their pathway cell. The egocentric window leaves out the hiker's own cell.
STAR: dict[Observation, float] = {"map": 0.0625, "egocentric": 1.0}
HIKER: dict[Observation, float] = {"map": 1.0, "egocentric": 0.0}
OBSERVATION_NAMES: dict[Observation, tuple[str, ...]] = {
    "map": tuple(f"map[{row},{column}]" for row in range(N_ROWS) for column in range(N_COLUMNS)),
    "egocentric": tuple(
        f"window[{down:+d},{right:+d}]"
        for down in range(-REACH, REACH + 1)
        for right in range(-REACH, REACH + 1)
        if (down, right) != (0, 0)
    ),
}
_OBSERVATION_SPACE = spaces.Box(-1.0, 1.0, (N_CELLS,), dtype=np.float32)
# Where the cells of the map lie in a frame as wide as the egocentric window reaches.
_FRAMED = (np.arange(N_CELLS) // N_COLUMNS + REACH) * _WIDTH + np.arange(N_CELLS) % N_COLUMNS + REACH
_OWN_CELL = _WINDOW**2 // 2
_FRAME_CELLS = (N_ROWS + 2 * REACH) * _WIDTH


def check_observation(observation: str) -> Observation:
    """Return ``observation``.

    :raises ValueError: if it is neither ``"map"`` nor ``"egocentric"``
    """
    if observation == "map":
        return "map"
    if observation == "egocentric":
        return "egocentric"
    raise ValueError(f"observation={observation!r} is not accepted; observation is one of 'map', 'egocentric'")


def draw_task(generator: np.random.Generator, variation: Variation) -> tuple[Layout, NDArray[np.int64]]:
    """Draw the map, where it is random, and the cells of the stars.

    :param generator: the environment's generator
    :param variation: values of ``n_stars`` and ``layout``
    """
    name = variation["layout"]
    layout = random_layout(int(generator.integers(N_RANDOM_LAYOUTS))) if name == RANDOM else LAYOUTS[name]
    return layout, generator.permutation(layout.star_cells)[: variation["n_stars"]]


class HikingEnv(PlanningEnv):
    """Walk the pathways of a map and collect every star.

    ## Description
    A map of 8 x 10 cells holds pathways, rocks and water. The hiker walks on pathways only, one cell a step. The task
    is done when the last of ``n_stars`` stars has been collected; a star is collected by stepping onto it. The
    pathways of every map offered are tree-like: they bend, fork and end, and never close a ring.

    ## Action Space
    ``Discrete(4)``: 0 north, 1 east, 2 south, 3 west.

    ## Observation Space
    ``Box(-1, 1, (80,))``, one number per cell, row by row from the north-west corner. The constructor chooses which
    cells are shown, ``observation="map"`` or ``"egocentric"``.

    | Cell                                   | map   | egocentric                    |
    |----------------------------------------|-------|-------------------------------|
    | rock, water, beyond the map's border   | -1    | -1                            |
    | pathway                                | 0     | 0                             |
    | pathway with a star                    | 1/16  | 1                             |
    | pathway with the hiker                 | 1     | 0 (seen again from elsewhere) |

    * ``"map"``: all 8 x 10 cells. ``map[row,column]`` is number ``10 * row + column``.
    * ``"egocentric"``: the 9 x 9 cells around the hiker, without the hiker's own. ``window[down,right]`` is the cell
      ``down`` rows south and ``right`` columns east of the hiker; ``window[-1,+0]`` is the cell to the north.

    ### What a short program can do with it
    *Egocentric.* Whoever walks tree-like pathways with the right hand on the edge comes along every cell. The rule is
    one affine controller: the score of direction d is K times the cell in direction d, plus a preference for the
    right-hand turn over straight on, over left, over back, which is a weight on the previous action. With preferences
    3, 2, 1, 0 and K above 3 a blocked cell is never chosen. A star next to the hiker adds K to its direction and is
    taken first; that moves the hiker to another place of the same round trip, at most once for each star. Nothing in
    it depends on the map or on the number of stars.

    *Map.* A weighted sum over the cells sees the hiker and the stars through the same weights: with the hiker at p
    and stars at q, the sum of w is ``w[p] + 1/16 * sum of w[q]`` plus a constant of the map. So on a known map a
    controller is a table "what to do where", disturbed by the stars that lie on cells with another entry. A star
    counts little beside the hiker so that many stars do not outweigh where the hiker is. With a branch for each
    previous action (four controllers, three conditions) entries are needed only where the right-hand rule does not go
    straight on: bends, forks and ends, at most six for each heading and turn on the hand-drawn maps. With the constant
    1 for straight on and entries of 2, a star disturbs by 1/8, and up to seven are outweighed. A table is good for
    one map; for maps never seen, use the egocentric form.

    Both observations describe cells. Which star is nearest, and where to go, is not in them.

    ## Rewards
    -0.01 a step, a further -0.05 for a step into a blocked cell (nothing moves then), +1 for each star.

    ## Starting State
    The hiker stands on the map's start, the stars lie on different pathway cells drawn with the environment's
    generator. With ``layout="random"`` each episode also draws one of 1024 generated maps.

    ## Episode End
    Terminated when the last star is collected; truncated after 500 steps (``max_episode_steps``).

    ## Information
    ``info["is_success"]`` at every step; at reset also ``info["variation"]`` and ``info["optimal_steps"]``, the length
    of a shortest tour.

    ## Arguments
    ``gym.make("Hiking-v0", n_stars=5, layout="fork")`` or ``env.reset(options={"n_stars": 5})``; an option stays in
    force until it is changed. Values that are not accepted raise ``ValueError``.

    | Parameter   | Values                                         | Default | Meaning                            |
    |-------------|------------------------------------------------|---------|------------------------------------|
    | n_stars     | 1 to 12                                        | 3       | number of stars                    |
    | layout      | valley, spiral, comb, fork, lakeside or random | valley  | the map                            |
    | observation | map or egocentric                              | map     | what is shown; constructor only    |

    ## References
    The domain `hiking` of PDDLGym (Silver and Chitnis, 2020).

    ## Version History
    * v0: initial version
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "ansi"], "render_fps": 8}
    variations: ClassVar[VariationSpace] = VARIATIONS
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES

    def __init__(
        self,
        n_stars: int = 3,
        layout: str = "valley",
        observation: Observation = "map",
        render_mode: str | None = None,
    ) -> None:
        super().__init__(render_mode)
        self.variation = self.variations.update({}, {"n_stars": n_stars, "layout": layout})
        self.observation = check_observation(observation)
        self.observation_names = OBSERVATION_NAMES[self.observation]
        self.observation_space = _OBSERVATION_SPACE
        self.action_space = spaces.Discrete(len(ACTION_NAMES))
        self.layout = LAYOUTS["valley"]
        self.hiker = self.layout.start
        self.stars: set[int] = set()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Put the hiker onto the start and lay out the stars.

        :param seed: seeds the generator that draws stars and random maps
        :param options: new values of variation parameters; they stay in force
        :return: observation ``(80,)`` and info
        :raises ValueError: if a variation is not accepted; the variation in force is then unchanged
        """
        super().reset(seed=seed)
        self.variation = self.variations.update(self.variation, options)
        self.layout, stars = draw_task(self.np_random, self.variation)
        self.hiker, self.stars = self.layout.start, set(stars.tolist())
        info = {
            "is_success": False,
            "variation": dict(self.variation),
            "optimal_steps": planner.optimal_steps(self.layout, self.hiker, stars.tolist()),
        }
        self._show()
        return self._observe(), info

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
        return self._observe(), reward, solved, False, {"is_success": solved}

    def _observe(self) -> NDArray[np.float32]:
        cells = np.where(self.layout.is_path, 0, BLOCKED).astype(np.float32)
        cells[list(self.stars)] = STAR[self.observation]
        cells[self.hiker] = HIKER[self.observation]
        if self.observation == "map":
            return cells
        framed = np.full(_FRAME_CELLS, BLOCKED, dtype=np.float32)
        framed[_FRAMED] = cells
        row, column = divmod(self.hiker, N_COLUMNS)
        window = framed.reshape(-1, _WIDTH)[row : row + _WINDOW, column : column + _WINDOW]
        return np.delete(window, _OWN_CELL)

    def _frame(self) -> NDArray[np.uint8]:
        return hiking_frame(self.layout.rows, divmod(self.hiker, N_COLUMNS), self._places(), self.variation["n_stars"])

    def _places(self) -> list[tuple[int, int]]:
        return [divmod(star, N_COLUMNS) for star in sorted(self.stars)]

    def _text(self) -> str:
        rows = [list(row.replace("H", ".")) for row in self.layout.rows]
        for row, column in self._places():
            rows[row][column] = "*"
        rows[self.hiker // N_COLUMNS][self.hiker % N_COLUMNS] = "H"
        return "\n".join("".join(row) for row in rows) + "\n"


class HikingVectorEnv(PlanningVectorEnv):
    """N hikers stepped at once, equal to N :class:`HikingEnv` step for step.

    The cells as they are shown are kept up to date in one array, so that an observation is a copy of its rows, or
    of the windows around the hikers in maps framed by blocked cells.

    :param num_envs: number of environments
    :param n_stars: see :class:`HikingEnv`
    :param layout: see :class:`HikingEnv`
    :param observation: see :class:`HikingEnv`
    :param max_episode_steps: steps after which an episode is truncated; ``None`` for no limit
    """

    variations: ClassVar[VariationSpace] = VARIATIONS
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES

    def __init__(
        self,
        num_envs: int = 1,
        n_stars: int = 3,
        layout: str = "valley",
        observation: Observation = "map",
        max_episode_steps: int | None = None,
    ) -> None:
        variation = self.variations.update({}, {"n_stars": n_stars, "layout": layout})
        super().__init__(num_envs, _OBSERVATION_SPACE, spaces.Discrete(len(ACTION_NAMES)), variation, max_episode_steps)
        self.observation = check_observation(observation)
        self.observation_names = OBSERVATION_NAMES[self.observation]
        framed = self.observation == "egocentric"
        # Where cell c is found in a row of self._cells.
        self._places = _FRAMED if framed else np.arange(N_CELLS)
        self._cells = np.full((num_envs, _FRAME_CELLS if framed else N_CELLS), BLOCKED, dtype=np.float32)
        if framed:
            frames = self._cells.reshape(num_envs, -1, _WIDTH)
            self._windows = np.lib.stride_tricks.sliding_window_view(frames, (_WINDOW, _WINDOW), axis=(1, 2))
        self._hikers = np.zeros(num_envs, dtype=np.int64)
        self._stars_left = np.zeros(num_envs, dtype=np.int64)
        self._layouts: list[Layout] = [LAYOUTS["valley"]] * num_envs
        self._stars: list[NDArray[np.int64]] = [np.zeros(0, dtype=np.int64)] * num_envs

    def _reset_rows(self, rows: NDArray[np.intp]) -> None:
        for row in rows:
            layout, stars = draw_task(self._generators[row], self.row_variations[row])
            cells = self._cells[row]
            cells[self._places] = np.where(layout.is_path, 0, BLOCKED)
            cells[self._places[stars]] = STAR[self.observation]
            cells[self._places[layout.start]] = HIKER[self.observation]
            self._layouts[row], self._stars[row] = layout, stars
            self._hikers[row], self._stars_left[row] = layout.start, len(stars)

    def _move(self, actions: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        rows, hikers = self._rows, self._hikers
        ahead = NEIGHBOURS[hikers, actions]
        shown = self._cells[rows, self._places[ahead]]
        legal = (ahead != hikers) & (shown != BLOCKED)
        found = legal & (shown == STAR[self.observation])
        self._cells[rows, self._places[hikers]] = 0
        self._hikers = np.where(legal, ahead, hikers)
        self._cells[rows, self._places[self._hikers]] = HIKER[self.observation]
        self._stars_left -= found
        rewards = np.where(legal, STEP_REWARD, STEP_REWARD + ILLEGAL_REWARD) + STAR_REWARD * found
        return rewards, self._stars_left == 0

    def _observe(self) -> NDArray[np.float32]:
        if self.observation == "map":
            return self._cells.copy()
        row, column = np.divmod(self._hikers, N_COLUMNS)
        windows = self._windows[self._rows, row, column].reshape(self.num_envs, _WINDOW**2)
        observations = np.empty((self.num_envs, N_CELLS), dtype=np.float32)
        observations[:, :_OWN_CELL], observations[:, _OWN_CELL:] = windows[:, :_OWN_CELL], windows[:, _OWN_CELL + 1 :]
        return observations

    def _optimal_steps(self) -> NDArray[np.int64]:
        steps = np.zeros(self.num_envs, dtype=np.int64)
        n_stars = np.array([len(stars) for stars in self._stars])
        for n in np.unique(n_stars):
            rows = np.flatnonzero(n_stars == n)
            distances = [
                planner.tour_distances(self._layouts[row], self._layouts[row].start, self._stars[row].tolist())
                for row in rows
            ]
            steps[rows] = planner.tour_lengths(np.stack(distances))
        return steps
