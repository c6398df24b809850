"""Hiking-v1 and HikingEgo-v0: collect the stars of a map that is seen as a whole, or from the hiker's own place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.documentation import with_sections
from progpolicy_envs.hikes import MAX_STARS
from progpolicy_envs.layouts import DIRECTIONS, N_CELLS, N_COLUMNS, N_ROWS
from progpolicy_envs.pathways import MapView, PathwayEnv, PathwayVectorEnv
from progpolicy_envs.symmetry import Grid, Permutation, Symmetry

REACH = 4  # cells that the window around the hiker shows to each side
# A map with a frame of blocked cells around it, as wide as the window reaches.
_FRAME_WIDTH = N_COLUMNS + 2 * REACH
#: What the window shows: changes of row and column from the hiker's cell, which is left out.
_WINDOW = [
    (down, right) for down in range(-REACH, REACH + 1) for right in range(-REACH, REACH + 1) if (down, right) != (0, 0)
]
_DIRECTIONS = list(DIRECTIONS.values())
#: The hiker may turn by a quarter: what was north is west then.
_QUARTER = Symmetry(
    "compass",
    Permutation.of(_WINDOW.index((right, -down)) for down, right in _WINDOW),
    Permutation.of(_DIRECTIONS.index((right, -down)) for down, right in _DIRECTIONS),
)
_WINDOW_OFFSETS = np.array([down * _FRAME_WIDTH + right for down, right in _WINDOW])


class _WholeMap(MapView):
    """The map as Hiking-v1 shows it: all stars that are left count together what one alone does."""

    star_value: ClassVar[float] = 0.25
    hiker_value: ClassVar[float] = 1.0
    n_numbers: ClassVar[int] = N_CELLS
    places: ClassVar[NDArray[np.int64]] = np.arange(N_CELLS)
    observation_names: tuple[str, ...] = tuple(
        f"map[{row},{column}]" for row in range(N_ROWS) for column in range(N_COLUMNS)
    )
    #: The number of a star by how many are left.
    shares: ClassVar[NDArray[np.float32]] = np.array(
        [0.0, *(0.25 / n_left for n_left in range(1, MAX_STARS + 1))], np.float32
    )


class _FirstWholeMap(_WholeMap):
    """The map as Hiking-v0 shows it: every star counts the same."""

    star_value: ClassVar[float] = 0.0625
    shares: ClassVar[NDArray[np.float32]] = np.full(MAX_STARS + 1, star_value, np.float32)


class _FramedMap(MapView):
    """The map of which HikingEgo-v0 shows a window, with a frame so that there is a window around every cell."""

    star_value: ClassVar[float] = 1.0
    hiker_value: ClassVar[float] = 0.0
    n_numbers: ClassVar[int] = (N_ROWS + 2 * REACH) * _FRAME_WIDTH
    places: ClassVar[NDArray[np.int64]] = (
        (np.arange(N_CELLS) // N_COLUMNS + REACH) * _FRAME_WIDTH + np.arange(N_CELLS) % N_COLUMNS + REACH
    )
    observation_names: tuple[str, ...] = tuple(f"window[{down:+d},{right:+d}]" for down, right in _WINDOW)


_SECTIONS = {
    "task": """
        ## Description
        A map of 8 x 10 cells holds pathways, rocks and water. The hiker walks on pathways only, one cell a step. The
        task is done when the last of ``n_stars`` stars has been collected; a star is collected by stepping onto it.
        The pathways of the named and the random maps are tree-like: they bend, fork and end, and never close a ring.

        ## Action Space
        ``Discrete(4)``: 0 north, 1 east, 2 south, 3 west.
        """,
    "rules": """
        The observation shows cells. Which star is nearest, and where to go, is not in it.

        ## Rewards
        -0.01 a step, a further -0.05 for a step into a blocked cell (nothing moves then), +1 for each star.

        ## Starting State
        The hiker stands on the map's start, the stars lie on different pathway cells drawn with the environment's
        generator. With ``layout="random"`` each episode also draws one of 1024 generated maps; with
        ``layout="practice"`` one of 1024 others, to train on.
        With ``n_done`` above 0 so many stars have been collected, and the hiker stands where the last of them was.
        ``env.reset(options={"hiker": [0, 1], "stars": [[0, 3], [2, 2]]})`` gives the places instead, as rows and
        columns; of ``n_stars`` stars those that are left out have been collected.

        ## Episode End
        Terminated when the last star is collected; truncated after 500 steps (``max_episode_steps``).

        ## Information
        ``info["is_success"]`` at every step; at reset also ``info["variation"]`` and ``info["optimal_steps"]``, the
        length of a shortest tour, whose actions ``env.unwrapped.plan()`` returns.

        ## Arguments
        ``gym.make("$id", n_stars=5, layout="fork")`` or ``env.reset(options={"n_stars": 5})``; an option stays in
        force until it is changed. Values that are not accepted raise ``ValueError``.
        ``context="observed"``, for ``gym.make``, adds the variation's numbers, from 0 to 1, to the end of observations.

        | Parameter   | Values                                                          | Default | Meaning            |
        |-------------|-----------------------------------------------------------------|---------|--------------------|
        | n_stars     | 1 to 12                                                         | 3       | number of stars    |
        | layout      | valley, spiral, comb, fork, lakeside, random, practice, or a    | valley  | the map            |
        |             | map as a text                                                   |         |                    |
        | n_done      | 0 to 11, fewer than n_stars, or "random": drawn for every       | 0       | stars that have    |
        |             | episode. Not in ``context``                                     |         | been collected     |

        A map of your own is a text with line feeds, or a sequence of rows: up to 8 rows of equal length, up to 10
        characters. ``.`` is a pathway, ``#`` rock, ``~`` water, and ``H`` the start, of which there is one; beyond the
        rows there is rock. Stars lie on cells marked ``*`` if there are any, else on any pathway cell.

            gym.make("$id", n_stars=2, layout=\"\"\"
                H...#
                .##*#
                *#~~~
            \"\"\")

        ## References
        The domain `hiking` of PDDLGym (Silver and Chitnis, 2020).
        """,
}


def _refuse_observation(observation: object) -> None:
    """Raise ``ValueError`` for an argument that Hiking-v0 had before HikingEgo-v0 was an id of its own."""
    if observation is not None:
        raise ValueError(
            f"observation={observation!r} is not accepted; Hiking-v0 shows the whole map, and HikingEgo-v0 the window "
            "around the hiker"
        )


@with_sections(_SECTIONS, id="Hiking-v1")
class HikingEnv(_WholeMap, PathwayEnv):
    """Walk the pathways of a map, seen as a whole, and collect every star.

    $task

    ## Observation Space
    ``Box(-1, 1, (80,))``, one number for each cell of the map, row by row from the north-west corner:
    ``map[row,column]`` is number ``10 * row + column``. The window around the hiker is another environment,
    ``HikingEgo-v0``.

    | Cell                   | Number                                        |
    |------------------------|-----------------------------------------------|
    | rock, water            | -1                                            |
    | pathway                | 0                                             |
    | pathway with a star    | 1/4 divided by the number of stars left       |
    | pathway with the hiker | 1                                             |

    ### What a short program can do with it
    A weighted sum over the cells sees the hiker and the stars through the same weights: with the hiker at p and n stars
    left at q, the sum of w is ``w[p] + 1/4 * mean of w[q]`` plus a constant of the map. So on a known map a controller
    is a table "what to do where", disturbed by the mean over the stars' cells, as much by ten stars as by one. In
    ``Hiking-v0`` each star counted 1/16, so that more stars than in training disturbed more.

    With a branch for each previous action (four controllers, three conditions) entries are needed only where the
    right-hand rule does not go straight on: bends, forks and ends, at most six for each heading and turn on the
    hand-drawn maps. With the constant 1 for straight on and entries of 2, the stars disturb by at most 1/2. A table is
    good for one map; for maps never seen, use ``HikingEgo-v0``.

    $rules

    ## Version History
    * v1: the stars that are left share 1/4; each was 1/16
    * v0: initial version; the egocentric observation has become ``HikingEgo-v0``
    """

    grids: ClassVar[tuple[Grid, ...]] = (Grid.whole("map", 0, N_ROWS, N_COLUMNS),)

    def __init__(
        self,
        n_stars: int = 3,
        layout: str | Sequence[str] = "valley",
        render_mode: str | None = None,
        context: str = "hidden",
        observation: None = None,
        n_done: int | str = 0,
    ) -> None:
        _refuse_observation(observation)
        super().__init__(n_stars, layout, render_mode, context, n_done)

    def _seen(self, numbers: NDArray[np.float32]) -> NDArray[np.float32]:
        numbers[self.places[list(self.stars)]] = self.shares[len(self.stars)]
        return numbers


@with_sections(_SECTIONS, id="Hiking-v0")
class HikingV0Env(_FirstWholeMap, HikingEnv):
    """Walk the pathways of a map, seen as a whole, and collect every star; ``Hiking-v1`` shows the stars better.

    $task

    ## Observation Space
    ``Box(-1, 1, (80,))``, as in ``Hiking-v1``, but for the stars:

    | Cell                   | Number |
    |------------------------|--------|
    | rock, water            | -1     |
    | pathway                | 0      |
    | pathway with a star    | 1/16   |
    | pathway with the hiker | 1      |

    ### What a short program can do with it
    With the hiker at p and stars at q, a sum with the weights w is ``w[p] + 1/16 * sum of w[q]`` plus a constant of the
    map: more stars disturb more. The program that ``Hiking-v1`` describes is disturbed by 1/8 for each, and up to seven
    are outweighed.

    $rules

    ## Version History
    * v0: initial version; the egocentric observation has become ``HikingEgo-v0``
    """


@with_sections(_SECTIONS, id="HikingEgo-v0")
class HikingEgoEnv(_FramedMap, PathwayEnv):
    """Walk the pathways of a map, seen as the cells around the hiker, and collect every star.

    $task

    ## Observation Space
    ``Box(-1, 1, (80,))``, one number for each of the 9 x 9 cells around the hiker without the hiker's own, row by row:
    ``window[down,right]`` is the cell ``down`` rows south and ``right`` columns east of the hiker, so
    ``window[-1,+0]`` is the cell to the north. The whole map is another environment, ``Hiking-v0``.

    | Cell                                 | Number |
    |--------------------------------------|--------|
    | rock, water, beyond the map's border | -1     |
    | pathway                              | 0      |
    | pathway with a star                  | 1      |

    ### What a short program can do with it
    Walking tree-like pathways with the right hand on the edge leads to every cell. The rule is one affine controller:
    the score of direction d is K times the cell in direction d, plus a weight on the previous action that prefers the
    right-hand turn over straight on, over left, over back. With the weights 3, 2, 1, 0 and K above 3 a blocked cell is
    never chosen. A star next to the hiker adds K to its direction and is taken first; that moves the hiker to another
    place of the same round trip, at most once for each star. Nothing in it depends on the map or on the number of
    stars.

    $rules

    ## Version History
    * v0: initial version; until then ``gym.make("Hiking-v0", observation="egocentric")``
    """

    symmetries: ClassVar[tuple[Symmetry, ...]] = (_QUARTER,)
    grids: ClassVar[tuple[Grid, ...]] = (Grid("window", 0, *zip(*_WINDOW, strict=True)),)

    def _seen(self, numbers: NDArray[np.float32]) -> NDArray[np.float32]:
        return numbers[self.places[self.hiker] + _WINDOW_OFFSETS]


class HikingVectorEnv(_WholeMap, PathwayVectorEnv):
    """N :class:`HikingEnv`; see :class:`PathwayVectorEnv`."""

    def __init__(
        self,
        num_envs: int = 1,
        n_stars: int = 3,
        layout: str | Sequence[str] = "valley",
        max_episode_steps: int | None = None,
        context: str = "hidden",
        observation: None = None,
        n_done: int | str = 0,
    ) -> None:
        _refuse_observation(observation)
        super().__init__(num_envs, n_stars, layout, max_episode_steps, context, n_done)

    def _observe(self) -> NDArray[np.float32]:
        share = self.shares[self._stars_left][:, None]
        return np.where(self._numbers == self.star_value, share, self._numbers)


class HikingV0VectorEnv(_FirstWholeMap, HikingVectorEnv):
    """N :class:`HikingV0Env`; see :class:`PathwayVectorEnv`."""


class HikingEgoVectorEnv(_FramedMap, PathwayVectorEnv):
    """N :class:`HikingEgoEnv`; see :class:`PathwayVectorEnv`."""

    #: Where the window of a cell begins in its map.
    _corners: ClassVar[NDArray[np.int64]] = _FramedMap.places - REACH * _FRAME_WIDTH - REACH

    def _observe(self) -> NDArray[np.float32]:
        numbers, side, step = self._numbers, 2 * REACH + 1, self._numbers.itemsize
        # A view of every window by the place of its first cell: rows of it are copied at once.
        n_windows = numbers.size - (side - 1) * (_FRAME_WIDTH + 1)
        windows = np.ndarray((n_windows, side, side), np.float32, numbers, 0, (step, _FRAME_WIDTH * step, step))
        seen = windows[self._first_places + self._corners[self._hikers]].reshape(self.num_envs, side**2)
        observations = np.empty((self.num_envs, len(_WINDOW)), dtype=np.float32)
        own = len(_WINDOW) // 2
        observations[:, :own], observations[:, own:] = seen[:, :own], seen[:, own + 1 :]
        return observations
