"""Variations, starts and states of the hiking environments: what is accepted, and what is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progpolicy_envs.layouts import (
    LAYOUTS,
    N_COLUMNS,
    N_ROWS,
    RANDOM_LAYOUTS,
    START,
    Layout,
    draw_layout,
    read_layout,
    split_rows,
)
from progpolicy_envs.states import is_sequence, read_cell
from progpolicy_envs.variation import (
    ChoiceParameter,
    IntParameter,
    Variation,
    VariationSpace,
    check_left,
    check_n_done,
    draw_n_done,
    n_done_parameter,
)

MAX_STARS = 12


def _are_rows(value: Any) -> bool:
    return is_sequence(value) and all(isinstance(row, str) for row in value)


@dataclass(frozen=True)
class LayoutParameter(ChoiceParameter):
    """The name of a map, or a map of the user's."""

    @property
    def allowed(self) -> str:
        """The accepted values in words."""
        return f"{super().allowed}, or a map as rows of text"

    def is_drawn(self, value: Any) -> bool:
        """Return whether another map is drawn for each episode.

        :param value: an accepted one
        """
        return value in RANDOM_LAYOUTS

    def is_one_value(self, value: Any) -> bool:
        """Return whether a sequence is the rows of one map, and not one map for each environment of a batch.

        :param value: a sequence
        """
        return _are_rows(value) and not any("\n" in row or row in self.choices for row in value)

    def parse(self, value: Any) -> str:
        """Return the name, or the rows of the map joined by line feeds.

        :param value: one of ``choices``, or rows as for :func:`~progpolicy_envs.layouts.read_layout`
        :raises ValueError: if it is neither
        """
        # A text in one line is a name, unless it has a start.
        is_map = START in value or "\n" in value if isinstance(value, str) else _are_rows(value)
        if not is_map:
            return super().parse(value)
        rows = split_rows(value)
        try:
            read_layout(rows)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from None
        return "\n".join(rows)


def named_layout(value: str) -> Layout:
    """Return the map of a value of ``layout`` that is not random."""
    return LAYOUTS[value] if value in LAYOUTS else read_layout(split_rows(value))


def _check_variation(variation: Variation) -> None:
    """Raise ``ValueError`` if the map has fewer places for stars than there are stars, or none is left to collect."""
    check_n_done(variation, "n_stars")
    n_stars, layout = variation["n_stars"], variation["layout"]
    n_places = MAX_STARS if layout in RANDOM_LAYOUTS else len(named_layout(layout).star_cells)
    if n_stars > n_places:
        raise ValueError(f"n_stars={n_stars} is not accepted; on this layout n_stars is at most {n_places}")


VARIATIONS = VariationSpace(
    IntParameter("n_stars", 1, MAX_STARS, 3, "number of stars"),
    LayoutParameter(
        "layout",
        (*LAYOUTS, *RANDOM_LAYOUTS),
        "valley",
        "the map; 'random' draws another one for every episode, 'practice' one of others",
    ),
    n_done_parameter(MAX_STARS - 1, "stars that have been collected"),
    check=_check_variation,
    starts={
        "hiker": "row and column of the hiker",
        "stars": "row and column of each star that is left",
    },
)


def draw_task(
    generator: np.random.Generator, variation: Variation
) -> tuple[int, Layout, int | np.int64, NDArray[np.int64]]:
    """Draw the number of stars, the map, where it is random, the hiker's cell and the cells of the stars that are left.

    The hiker stands on the map's start or, if stars have been collected, where the last of them was.

    :param generator: the environment's generator
    :param variation: values of ``n_stars``, ``layout`` and ``n_done``
    """
    value = variation["layout"]
    layout = draw_layout(value, generator) if value in RANDOM_LAYOUTS else named_layout(value)
    stars = generator.permutation(layout.star_cells)[: variation["n_stars"]]
    n_done = draw_n_done(variation, "n_stars", generator)
    return len(stars), layout, stars[n_done - 1] if n_done else layout.start, stars[n_done:]


def completed(
    variation: Variation, drawn: dict[str, Any], start: Mapping[str, Any], generator: np.random.Generator
) -> dict[str, Any]:
    """Return the state that begins an episode. What was drawn makes room for what is given.

    :param variation: of the episode
    :param drawn: the state that was drawn
    :param start: parts of it that are given
    :param generator: the environment's generator; used where something has to make room
    :raises ValueError: if they do not fit the variation
    """
    check_left(variation, start, "n_stars", "stars")
    state = {**drawn, **start}
    hiker, stars = state["hiker"], state["stars"]
    if ("hiker" in start) == ("stars" in start) or not (is_sequence(hiker) and is_sequence(stars)):
        return state
    cells = [list(star) if is_sequence(star) else star for star in stars]
    if list(hiker) not in cells or ("stars" in start and not variation.get("n_done", 0)):
        return state  # nothing is in the way, or the hiker is where the map says
    places = [list(divmod(cell, N_COLUMNS)) for cell in named_layout(state["layout"]).star_cells]
    free = [place for place in places if place not in cells and place != list(hiker)]
    if free:
        place = free[int(len(free) * generator.random())]
        if "stars" in start:
            state["hiker"] = place
        else:
            state["stars"] = [place if cell == list(hiker) else cell for cell in cells]
    return state


def layout_value(layout: Layout) -> str:
    """Return the value of ``layout`` that stands for a map: its name, or its rows joined by line feeds."""
    names = [name for name, named in LAYOUTS.items() if named.rows == layout.rows]
    return names[0] if names else "\n".join(layout.rows)


def _reachable_cell(name: str, value: Any, layout: Layout) -> int:
    row, column = read_cell(name, value, N_ROWS, N_COLUMNS)
    cell = row * N_COLUMNS + column
    if layout.distances[layout.start, cell] < 0:
        raise ValueError(f"{name}: [{row}, {column}] is not accepted; no way leads there from the map's start")
    return cell


def read_state(state: Mapping[str, Any]) -> tuple[int, Layout, int, list[int]]:
    """Return the number of stars, the map, the hiker's cell and the cells of the stars that are left.

    :param state: values of ``n_stars``, ``layout``, ``hiker`` and ``stars``; see :attr:`PathwayEnv.state`
    :raises ValueError: if it is not a state
    """
    n_stars, layout_name, stars = state["n_stars"], state["layout"], state["stars"]
    variation = VARIATIONS.update({}, {"n_stars": n_stars, "layout": layout_name})
    if variation["layout"] in RANDOM_LAYOUTS:
        raise ValueError(f"layout={variation['layout']!r} is not accepted in a state; give the map as rows of text")
    layout = named_layout(variation["layout"])
    if not is_sequence(stars) or len(stars) > variation["n_stars"]:
        raise ValueError(
            f"stars={stars!r} is not accepted; stars are up to n_stars={n_stars} pairs of row and column, one for each "
            "star that is left"
        )
    hiker = _reachable_cell("hiker", state["hiker"], layout)
    cells = [_reachable_cell("stars", star, layout) for star in stars]
    if len({hiker, *cells}) <= len(cells):
        raise ValueError(f"stars={stars!r} is not accepted; hiker and stars have each a cell of their own")
    return variation["n_stars"], layout, hiker, cells
