"""Maps of pathways for Hiking-v0: hand-drawn ones, a seeded generator of connected random ones, and those of users."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

N_ROWS, N_COLUMNS = 8, 10
N_CELLS = N_ROWS * N_COLUMNS
N_RANDOM_LAYOUTS = 1024  # of each family
#: The families of random maps, and the number of the first of each. No map is in both, so that what has been trained on
#: the one can be tested on the other.
RANDOM_LAYOUTS = {"random": 0, "practice": N_RANDOM_LAYOUTS}
#: Row and column change of each direction, clockwise from north, so that the next index is the right-hand turn.
DIRECTIONS = {"north": (-1, 0), "east": (0, 1), "south": (1, 0), "west": (0, -1)}
PATH, ROCK, WATER, START, STAR = ".", "#", "~", "H", "*"


def _neighbours() -> NDArray[np.int64]:
    cells = np.arange(N_CELLS).reshape(N_ROWS, N_COLUMNS)
    framed = np.pad(cells, 1, constant_values=-1)
    moved = [np.roll(framed, (-down, -right), axis=(0, 1))[1:-1, 1:-1] for down, right in DIRECTIONS.values()]
    return np.stack([np.where(near < 0, cells, near).ravel() for near in moved], axis=1)


#: ``(80, 4)``: the cell next to a cell in each direction; the cell itself where the map ends.
NEIGHBOURS = _neighbours()
_ADJACENT = [sorted(set(near) - {cell}) for cell, near in enumerate(NEIGHBOURS.tolist())]


@dataclass(frozen=True, eq=False)
class Layout:
    """One map. Cells are numbered row by row from the north-west corner, 0 to 79.

    :param rows: 8 texts of 10 characters: ``.`` pathway, ``#`` rock, ``~`` water, one ``H`` where the hiker starts, and
        perhaps ``*``, pathway cells where stars lie
    """

    rows: tuple[str, ...]

    @cached_property
    def is_path(self) -> NDArray[np.bool_]:
        """``(80,)``: where one can walk."""
        return np.array([cell in (PATH, START, STAR) for cell in "".join(self.rows)])

    @cached_property
    def start(self) -> int:
        """The cell where the hiker starts."""
        return "".join(self.rows).index(START)

    @cached_property
    def star_cells(self) -> NDArray[np.int64]:
        """The cells where a star can lie: those marked as such or, without marks, every pathway cell but the start."""
        marked = [cell for cell, kind in enumerate("".join(self.rows)) if kind == STAR]
        if marked:
            return np.array(marked)
        return np.flatnonzero(self.is_path & (np.arange(N_CELLS) != self.start))

    @cached_property
    def distances(self) -> NDArray[np.int8]:
        """``(80, 80)``: steps from pathway cell to pathway cell by breadth-first search; -1 where there is no way."""
        cells = np.flatnonzero(self.is_path)
        step = (NEIGHBOURS[cells][:, :, None] == cells).any(axis=1).astype(np.float32)
        between = np.where(np.eye(len(cells), dtype=bool), 0, -1).astype(np.int8)
        reached = frontier = between == 0
        length = 0
        while frontier.any():
            length += 1
            frontier = (frontier.astype(np.float32) @ step > 0) & ~reached
            between[frontier] = length
            reached = reached | frontier
        distances = np.full((N_CELLS, N_CELLS), -1, dtype=np.int8)
        distances[np.ix_(cells, cells)] = between
        return distances


#: The hand-drawn maps. They are tree-like: between two cells there is one way.
LAYOUTS: dict[str, Layout] = {
    "valley": Layout(
        (
            "H...######",
            "###.#.....",
            "~~#.#.###.",
            "~~#...#~#.",
            "~###.##~#.",
            ".....###..",
            ".##.####.#",
            "..#....#.#",
        )
    ),
    "spiral": Layout(
        (
            "H.........",
            "#########.",
            "#.......#.",
            "#.#####.#.",
            "#.#~~...#.",
            "#.#######.",
            "#.........",
            "##########",
        )
    ),
    "comb": Layout(
        (
            "H.........",
            ".#.#.#.#.#",
            ".#.#.###.#",
            ".~.~.##~.~",
            ".~.~.#~~.~",
            ".###.#~~.#",
            ".#~#.##~##",
            ".#####~~~#",
        )
    ),
    "fork": Layout(
        (
            "####.#####",
            "#...H....#",
            "#.##.###.#",
            "#.##.###.#",
            "..~#.#~~..",
            ".~~#.#~~#.",
            ".###.###..",
            "####.####.",
        )
    ),
    "lakeside": Layout(
        (
            "~~~~......",
            "~~~~.###.#",
            "H.~..~~#..",
            "#.~.~~~~#.",
            "#...~~~##.",
            "###.~~~#.#",
            ".##...##..",
            "....#....#",
        )
    ),
}


def split_rows(drawing: str | Sequence[str]) -> tuple[str, ...]:
    """Return the rows of a map, without the blanks around them and without empty rows at both ends of a text.

    :param drawing: rows, or one text with line feeds
    """
    rows = drawing.strip().splitlines() if isinstance(drawing, str) else drawing
    return tuple(row.strip() for row in rows)


@lru_cache(maxsize=256)
def read_layout(rows: tuple[str, ...]) -> Layout:
    """Return the map that rows of text draw; beyond them there is rock.

    :param rows: up to 8 rows of equal length, up to 10: ``.`` pathway, ``#`` rock, ``~`` water, one ``H`` where the
        hiker starts; stars lie on the cells marked ``*`` or, without any, on any pathway cell
    :raises ValueError: if they draw no map, or one without stars that can be reached; the message names the cell
    """
    lengths = sorted({len(row) for row in rows})
    if not 1 <= len(rows) <= N_ROWS or len(lengths) != 1 or not 1 <= lengths[0] <= N_COLUMNS:
        raise ValueError(
            f"a map of {len(rows)} rows of lengths {lengths} is not accepted; it has up to {N_ROWS} rows of equal "
            f"length, up to {N_COLUMNS}"
        )
    for number, text in enumerate(rows):
        for place, cell in enumerate(text):
            if cell not in (PATH, ROCK, WATER, START, STAR):
                raise ValueError(
                    f"{cell!r} in row {number}, column {place} of a map is not accepted; a cell is '.' pathway, '#' "
                    "rock, '~' water, 'H' start or '*' star"
                )
    if (n_starts := "".join(rows).count(START)) != 1:
        raise ValueError(f"a map with {n_starts} starts is not accepted; it has one cell 'H'")
    wide = [row.ljust(N_COLUMNS, ROCK) for row in rows]
    layout = Layout((*wide, *[ROCK * N_COLUMNS] * (N_ROWS - len(wide))))
    if not len(layout.star_cells):
        raise ValueError("a map without a pathway cell beside the start is not accepted; there is no place for a star")
    apart = layout.star_cells[layout.distances[layout.start, layout.star_cells] < 0]
    if len(apart):
        row, column = divmod(int(apart[0]), N_COLUMNS)
        raise ValueError(
            f"a map in which no way leads from the start to row {row}, column {column} is not accepted; stars may lie "
            "there. Connect the pathways, or mark with '*' where stars may lie"
        )
    return layout


def draw_layout(family: str, generator: np.random.Generator) -> Layout:
    """Draw one of a family of random maps.

    :param family: ``"random"`` or ``"practice"``
    :param generator: one number is drawn from it
    """
    return random_layout(RANDOM_LAYOUTS[family] + int(generator.integers(N_RANDOM_LAYOUTS)))


@lru_cache(maxsize=len(RANDOM_LAYOUTS) * N_RANDOM_LAYOUTS)
def random_layout(number: int) -> Layout:
    """Return random map ``number``: connected and tree-like, 30 to 40 pathway cells, always the same for a number.

    A pathway grows cell by cell, mostly onwards from its end and sometimes from anywhere, and only into cells that
    touch it on one side; so it bends, forks and ends, and never closes a ring.

    :param number: 0 to 1023 for ``layout="random"``, 1024 to 2047 for ``"practice"``
    :raises ValueError: if the number is out of range
    """
    n_layouts = len(RANDOM_LAYOUTS) * N_RANDOM_LAYOUTS
    if not 0 <= number < n_layouts:
        raise ValueError(f"random map {number} does not exist; numbers are 0 to {n_layouts - 1}")
    generator = np.random.default_rng(number)
    path = _grow(generator, int(generator.integers(30, 41)))
    cells = np.full(N_CELLS, ROCK)
    rows, columns = np.divmod(np.arange(N_CELLS), N_COLUMNS)
    lake_row, lake_column = generator.uniform(1, N_ROWS - 2), generator.uniform(1, N_COLUMNS - 2)
    cells[(rows - lake_row) ** 2 + (columns - lake_column) ** 2 < generator.uniform(3, 10)] = WATER
    cells[path] = PATH
    cells[path[0]] = START
    return Layout(tuple("".join(row) for row in cells.reshape(N_ROWS, N_COLUMNS)))


def _grow(generator: np.random.Generator, size: int) -> list[int]:
    path = [int(generator.integers(N_CELLS))]
    while len(path) < size:
        end = path[-1] if generator.random() < 0.75 else path[generator.integers(len(path))]
        grown = _free_neighbours(path, end) or [cell for end in path for cell in _free_neighbours(path, end)]
        if not grown:
            break
        path.append(grown[generator.integers(len(grown))])
    return path


def _free_neighbours(path: list[int], end: int) -> list[int]:
    """Return the cells next to ``end`` that touch the pathway there only."""
    return [cell for cell in _ADJACENT[end] if cell not in path and sum(near in path for near in _ADJACENT[cell]) == 1]
