"""Stacking-v0: pick plates up from a table, the largest first."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from progpolicy_envs.counting import arrangements
from progpolicy_envs.layouts import DIRECTIONS
from progpolicy_envs.planners import stacking as planner
from progpolicy_envs.planning import PlanningEnv
from progpolicy_envs.rendering import stacking_frame
from progpolicy_envs.states import Cell, is_sequence, read_cell
from progpolicy_envs.symmetry import Grid, Permutation, Symmetry
from progpolicy_envs.variation import (
    RANDOM,
    IntParameter,
    Variation,
    VariationSpace,
    check_left,
    check_n_done,
    draw_n_done,
    n_done_parameter,
)
from progpolicy_envs.vector import PlanningVectorEnv

MAX_PLATES = 8
N_SIDE = 5
N_CELLS = N_SIDE**2
PICK = planner.PICK
VARIATIONS = VariationSpace(
    IntParameter("n_plates", 1, MAX_PLATES, 3, "number of plates"),
    n_done_parameter(MAX_PLATES - 1, "plates that are on the stack"),
    check=partial(check_n_done, size="n_plates"),
    starts={
        "plates": "row and column of each plate on the table, the largest first",
        "gripper": "row and column of the gripper",
    },
)
STEP_REWARD, ILLEGAL_REWARD, PLATE_REWARD = -0.01, -0.05, 1.0
#: How many times a plate's number on the table is that of the next smaller one. A power of 2, so that all are exact.
DOMINANCE = 8.0

ACTION_NAMES = (*DIRECTIONS, "pick")
OBSERVATION_NAMES = (
    *(f"table[{row},{column}]" for row in range(N_SIDE) for column in range(N_SIDE)),
    *(f"stack[{slot}]" for slot in range(MAX_PLATES)),
    "gripper[row]",
    "gripper[column]",
)
_STACK, _GRIPPER = N_CELLS, N_CELLS + MAX_PLATES  # where the stack and the gripper begin in the observation
_OBSERVATION_SPACE = spaces.Box(
    np.array([0] * _GRIPPER + [-1] * 2, np.float32), np.ones(len(OBSERVATION_NAMES), np.float32), dtype=np.float32
)


def _turned(name: str, of_cell: Callable[[int, int], Cell], gripper: Permutation) -> Symmetry:
    """Return a symmetry of the square table.

    :param name: of the symmetry
    :param of_cell: row and column, from -2 to 2, of the cell whose plate is seen on a row and column
    :param gripper: of the gripper's row and column
    """
    half = N_SIDE // 2

    def cell(row: int, column: int) -> int:
        source = of_cell(row - half, column - half)
        return (source[0] + half) * N_SIDE + source[1] + half

    table = [cell(row, column) for row in range(N_SIDE) for column in range(N_SIDE)]
    places = [_GRIPPER + index for index in gripper.source]
    directions = list(DIRECTIONS.values())
    actions = [directions.index(of_cell(*direction)) for direction in directions]
    signs = [1] * _GRIPPER + list(gripper.signs)
    observation = Permutation.of([*table, *range(_STACK, _GRIPPER), *places], signs)
    return Symmetry(name, observation, Permutation.of([*actions, len(directions)]))


#: The table may be turned by a quarter and looked at in a mirror.
SYMMETRIES = (
    _turned("table", lambda row, column: (-column, row), Permutation((1, 0), (1, -1))),
    _turned("table", lambda row, column: (row, -column), Permutation((0, 1), (1, -1))),
)
GRIDS = (Grid.whole("table", 0, N_SIDE, N_SIDE),)


def draw_task(generator: np.random.Generator, variation: Variation) -> tuple[NDArray[np.int64], int, int]:
    """Draw the cells of the plates, the largest first, the cell of the gripper, and how many are on the stack.

    :param generator: the environment's generator
    :param variation: the values of ``n_plates`` and ``n_done``
    """
    plates, gripper = generator.permutation(N_CELLS)[: variation["n_plates"]], int(generator.integers(N_CELLS))
    return plates, gripper, draw_n_done(variation, "n_plates", generator)


def read_state(state: Mapping[str, Any]) -> tuple[int, list[Cell], Cell]:
    """Return the number of plates, the cells of those on the table and the gripper's cell.

    :param state: values of ``n_plates``, ``plates`` and ``gripper``; see :attr:`StackingEnv.state`
    :raises ValueError: if it is not a state
    """
    n_plates = VARIATIONS.parse({"n_plates": state["n_plates"]})["n_plates"]
    plates, gripper = state["plates"], state["gripper"]
    if not is_sequence(plates) or len(plates) > n_plates:
        raise ValueError(
            f"plates={plates!r} is not accepted; plates are up to n_plates={n_plates} pairs of row and column, one for "
            "each plate on the table"
        )
    cells = [read_cell("plates", plate, N_SIDE, N_SIDE) for plate in plates]
    if len(set(cells)) < len(cells):
        raise ValueError(f"plates={plates!r} is not accepted; each plate has a cell of its own")
    return n_plates, cells, read_cell("gripper", gripper, N_SIDE, N_SIDE)


class StackingEnv(PlanningEnv):
    """Move a gripper over a table and pick plates up one by one, the largest first, onto one stack.

    ## Description
    ``n_plates`` plates of different sizes lie on different cells of a 5 x 5 table. The gripper hovers over one cell.
    It can pick up the largest plate on the table only, when it is right above it; the plate then lies on top of the
    stack. The task is done when the last plate is on the stack.

    ## Action Space
    ``Discrete(5)``: 0 north, 1 east, 2 south, 3 west, 4 pick.

    ## Observation Space
    ``Box(35,)``, the same for any number of plates.

    | Num     | Observation       | Min | Max | Meaning                                                              |
    |---------|-------------------|-----|-----|----------------------------------------------------------------------|
    | 0 - 24  | table[row,column] | 0   | 1   | the plate on the cell, by its place among the plates still on the    |
    |         |                   |     |     | table: 1 the largest, 1/8 the next, 1/64 the third ...; 0 for none   |
    | 25 - 32 | stack[slot]       | 0   | 1   | the plate in the slot, from the bottom upwards: its size divided by  |
    |         |                   |     |     | that of the largest (sizes are 1 to n_plates); 0 for none            |
    | 33      | gripper[row]      | -1  | 1   | -1 the northernmost row, 0 the middle, 1 the southernmost            |
    | 34      | gripper[column]   | -1  | 1   | -1 the westernmost column, 0 the middle, 1 the easternmost           |

    ### What a short program can do with it
    Let column(c) be -2 to 2. The sum over all cells of ``table[c] * column(c)`` is the column of the largest plate,
    give or take at most ``2 * (1/8 + 1/64 + ...) < 2/7``, since each plate outweighs all smaller ones together. Columns
    are whole numbers, so ``sum - 2 * gripper[column] >= 1/2`` says exactly "the largest plate lies further east", for
    any number of plates. Four such affine conditions (east, west, south, north) and five constant controllers, the
    last of which picks, are an optimal program. With plates numbered by absolute size the weight of the largest would
    shrink from pick to pick, and one affine condition could not compare it with the gripper's place; that is why the
    numbers are relative to the plates still on the table, as the ranks of Hanoi are to the tops.

    The observation says where things are and which plate is larger than which. In which direction to go is not in it.

    ## Rewards
    -0.01 a step, a further -0.05 for an illegal action (a move off the table, or a pick where the largest plate of
    the table is not; nothing changes then), +1 for each plate picked up.

    ## Starting State
    Plates and gripper on cells drawn with the environment's generator; the gripper may start above a plate. The
    ``n_done`` largest plates are on the stack already.
    ``env.reset(options={"n_plates": 2, "plates": [[0, 0], [3, 4]], "gripper": [2, 2]})`` gives them instead, as rows
    and columns, the largest plate first; of ``n_plates`` plates those that are left out are on the stack, as many as
    ``n_done`` says unless it is 0.

    ## Episode End
    Terminated when all plates are on the stack; truncated after 500 steps (``max_episode_steps``).

    ## Information
    ``info["is_success"]`` at every step; at reset also ``info["variation"]`` and ``info["optimal_steps"]``, the
    length of a shortest solution, whose actions ``env.unwrapped.plan()`` returns.

    ## Arguments
    ``gym.make("Stacking-v0", n_plates=5)`` or ``env.reset(options={"n_plates": 5})``; an option stays in force until
    it is changed. Values that are not accepted raise ``ValueError``.
    ``context="observed"``, for ``gym.make``, adds the variation's numbers, from 0 to 1, to the end of observations.

    | Parameter | Values             | Default | Meaning                                                              |
    |-----------|--------------------|---------|----------------------------------------------------------------------|
    | n_plates  | 1 to 8             | 3       | number of plates                                                     |
    | n_done    | 0 to 7, "random"   | 0       | plates that are on the stack at the start, fewer than n_plates;      |
    |           |                    |         | "random" draws a number for every episode. Not in ``context``        |

    ## References
    Compare the domain `blocks` of PDDLGym (Silver and Chitnis, 2020).

    ## Version History
    * v0: initial version
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array", "ansi"], "render_fps": 6}
    variations: ClassVar[VariationSpace] = VARIATIONS
    observation_names: tuple[str, ...] = OBSERVATION_NAMES
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES
    symmetries: ClassVar[tuple[Symmetry, ...]] = SYMMETRIES
    grids: ClassVar[tuple[Grid, ...]] = GRIDS

    def __init__(
        self, n_plates: int = 3, render_mode: str | None = None, context: str = "hidden", n_done: int | str = 0
    ) -> None:
        super().__init__({"n_plates": n_plates, "n_done": n_done}, _OBSERVATION_SPACE, render_mode, context)
        self.action_space = spaces.Discrete(len(ACTION_NAMES))
        self.n_plates = 0
        self.plates: list[Cell] = []
        self.gripper: Cell = (0, 0)

    def step(self, action: np.int64 | int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move the gripper or pick a plate up, if that is possible.

        :param action: 0 to 4, see the class
        :return: observation, reward, terminated, truncated, info
        :raises ValueError: if the action is out of range
        """
        action = self._check_action(action)
        reward = STEP_REWARD
        if action == PICK:
            if self.gripper == next(iter(self.plates), None):
                del self.plates[0]
                reward += PLATE_REWARD
            else:
                reward += ILLEGAL_REWARD
        else:
            down, right = DIRECTIONS[ACTION_NAMES[action]]
            row, column = self.gripper[0] + down, self.gripper[1] + right
            if 0 <= row < N_SIDE and 0 <= column < N_SIDE:
                self.gripper = (row, column)
            else:
                reward += ILLEGAL_REWARD
        solved = not self.plates
        self._show()
        return self._observation(), reward, solved, False, {"is_success": solved}

    def _draw(self, variation: Variation) -> None:
        cells, gripper, n_done = draw_task(self.np_random, variation)
        self.n_plates = len(cells)
        self.plates = [divmod(cell, N_SIDE) for cell in cells[n_done:].tolist()]
        self.gripper = divmod(gripper, N_SIDE)

    def _completed(self, variation: Variation, start: Mapping[str, Any]) -> dict[str, Any]:
        check_left(variation, start, "n_plates", "plates")
        return super()._completed(variation, start)

    def _state(self) -> dict[str, Any]:
        plates = [list(plate) for plate in self.plates]
        return {"n_plates": self.n_plates, "plates": plates, "gripper": list(self.gripper)}

    def _set_state(self, state: Mapping[str, Any]) -> None:
        self.n_plates, self.plates, self.gripper = read_state(state)

    def _plan(self) -> list[int]:
        return planner.plan(self.gripper, self.plates)

    def _optimal_steps(self) -> int:
        return planner.optimal_steps(self.gripper, self.plates)

    def _observe(self) -> NDArray[np.float32]:
        n_plates = self.n_plates
        observation = np.zeros(len(OBSERVATION_NAMES), dtype=np.float32)
        for rank, (row, column) in enumerate(self.plates):
            observation[row * N_SIDE + column] = DOMINANCE**-rank
        for slot in range(n_plates - len(self.plates)):
            observation[_STACK + slot] = (n_plates - slot) / n_plates
        observation[_GRIPPER:] = [2 * place / (N_SIDE - 1) - 1 for place in self.gripper]
        return observation

    def _frame(self) -> NDArray[np.uint8]:
        return stacking_frame(N_SIDE, self.plates, self.n_plates, self.gripper)

    def _text(self) -> str:
        sizes = {plate: len(self.plates) - rank for rank, plate in enumerate(self.plates)}
        rows = []
        for row in range(N_SIDE):
            cells = [str(sizes.get((row, column), ".")) for column in range(N_SIDE)]
            marked = [f"[{cell}]" if (row, c) == self.gripper else f" {cell} " for c, cell in enumerate(cells)]
            rows.append("".join(marked).rstrip())
        stack = " ".join(str(size) for size in range(self.n_plates, len(self.plates), -1))
        return "\n".join([*rows, f"stack: {stack}".strip()]) + "\n"


class StackingVectorEnv(PlanningVectorEnv):
    """N tables stepped at once, equal to N :class:`StackingEnv` step for step.

    The observations are the state and are kept up to date: a pick multiplies what is left on the table.

    :param num_envs: number of environments
    :param n_plates: see :class:`StackingEnv`
    :param max_episode_steps: steps after which an episode is truncated; ``None`` for no limit
    :param context: see :class:`StackingEnv`
    :param n_done: see :class:`StackingEnv`
    """

    variations: ClassVar[VariationSpace] = VARIATIONS
    observation_names: tuple[str, ...] = OBSERVATION_NAMES
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES

    _MOVES = np.array([*DIRECTIONS.values(), (0, 0)])

    def __init__(
        self,
        num_envs: int = 1,
        n_plates: int = 3,
        max_episode_steps: int | None = None,
        context: str = "hidden",
        n_done: int | str = 0,
    ) -> None:
        variation = self.variations.update({}, {"n_plates": n_plates, "n_done": n_done})
        actions = spaces.Discrete(len(ACTION_NAMES))
        super().__init__(num_envs, _OBSERVATION_SPACE, actions, variation, max_episode_steps, context)
        self._numbers = np.zeros((num_envs, len(OBSERVATION_NAMES)), dtype=np.float32)
        self._grippers = np.zeros((num_envs, 2), dtype=np.int64)
        self._n_plates = np.full(num_envs, n_plates)
        self._n_picked = np.zeros(num_envs, dtype=np.int64)
        self._plates: list[NDArray[np.int64]] = [np.zeros(0, dtype=np.int64)] * num_envs

    def _reset_rows(self, rows: NDArray[np.intp]) -> None:
        for row in rows:
            plates, gripper, n_done = draw_task(self._generators[row], self.row_variations[row])
            self._put(row, plates, n_done)
            self._grippers[row] = divmod(gripper, N_SIDE)
        self._show_grippers()

    def _put(self, row: int | np.intp, plates: NDArray[np.int64], n_picked: int) -> None:
        """Put the plates of one environment onto their cells, the first of them onto the stack."""
        numbers, n_plates = self._numbers[row], len(plates)
        numbers[:] = 0
        numbers[plates[n_picked:]] = DOMINANCE ** -np.arange(n_plates - n_picked)
        if n_picked:
            numbers[_STACK : _STACK + n_picked] = (n_plates - np.arange(n_picked)) / n_plates
        self._plates[row], self._n_plates[row], self._n_picked[row] = plates, n_plates, n_picked

    @classmethod
    def count_starts(cls, variation: Mapping[str, Any], any_state: bool = False) -> int:
        """Return the number of places for plates and gripper, see :class:`PlanningVectorEnv`."""
        if any_state:
            return super().count_starts(variation, any_state)
        whole = cls.variations.update(cls.variations.defaults, variation)
        n_done = whole.get("n_done", 0)
        if n_done == RANDOM:
            return super().count_starts(variation, any_state)
        return math.perm(N_CELLS, whole["n_plates"] - n_done) * N_CELLS

    def _put_starts(
        self, variation: Variation, given: Mapping[str, Any], numbers: NDArray[np.int64], any_state: bool
    ) -> None:
        arrangement, gripper = np.divmod(numbers, N_CELLS)
        n_plates, n_done = variation["n_plates"], variation.get("n_done", 0)
        plates = arrangements(arrangement, N_CELLS, n_plates - n_done)
        self._numbers[:] = 0
        self._numbers[self._rows[:, None], plates] = DOMINANCE ** -np.arange(n_plates - n_done)
        self._numbers[:, _STACK : _STACK + n_done] = (n_plates - np.arange(n_done)) / n_plates
        self._grippers = np.stack(np.divmod(gripper, N_SIDE), axis=1)
        # Where the plates lay that are on the stack already does not matter.
        self._plates = list(np.concatenate([np.full((len(plates), n_done), -1), plates], axis=1))
        self._n_plates[:], self._n_picked[:] = n_plates, n_done
        self._show_grippers()

    def _move(self, actions: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        moved = self._grippers + self._MOVES[actions]
        self._grippers = np.clip(moved, 0, N_SIDE - 1)
        self._show_grippers()
        above = self._grippers[:, 0] * N_SIDE + self._grippers[:, 1]
        picking = actions == PICK
        picked = picking & (self._numbers[self._rows, above] == 1)
        illegal = np.where(picking, ~picked, (self._grippers != moved).any(axis=1))
        rows = np.flatnonzero(picked)
        self._numbers[rows, above[rows]] = 0
        self._numbers[rows, :_STACK] *= DOMINANCE
        slots, n_plates = self._n_picked[rows], self._n_plates[rows]
        self._numbers[rows, _STACK + slots] = (n_plates - slots) / n_plates
        self._n_picked[rows] += 1
        rewards = np.where(illegal, STEP_REWARD + ILLEGAL_REWARD, STEP_REWARD) + PLATE_REWARD * picked
        return rewards, self._n_picked == self._n_plates

    def _show_grippers(self) -> None:
        self._numbers[:, _GRIPPER:] = 2 * self._grippers / (N_SIDE - 1) - 1

    def _observe(self) -> NDArray[np.float32]:
        return self._numbers.copy()

    def _state_of(self, row: int) -> dict[str, Any]:
        left = self._plates[row][self._n_picked[row] :]
        plates = [list(divmod(cell, N_SIDE)) for cell in left.tolist()]
        return {"n_plates": int(self._n_plates[row]), "plates": plates, "gripper": self._grippers[row].tolist()}

    def _completed(self, row: int, start: Mapping[str, Any]) -> dict[str, Any]:
        check_left(self.row_variations[row], start, "n_plates", "plates")
        return super()._completed(row, start)

    def _set_state_of(self, row: int, state: Mapping[str, Any]) -> None:
        n_plates, plates, gripper = read_state(state)
        n_picked, cells = n_plates - len(plates), [row * N_SIDE + column for row, column in plates]
        self._put(row, np.array([-1] * n_picked + cells), n_picked)
        self._grippers[row] = gripper
        self._show_grippers()

    def _optimal_steps(self) -> NDArray[np.int64]:
        steps = np.zeros(self.num_envs, dtype=np.int64)
        counts = np.stack([self._n_plates, self._n_picked], axis=1)
        for n_plates, n_picked in np.unique(counts, axis=0).tolist():
            rows = np.flatnonzero((counts == (n_plates, n_picked)).all(axis=1))
            plates = np.stack([self._plates[row] for row in rows])[:, n_picked:]
            places = np.concatenate([self._grippers[rows, None], np.stack(np.divmod(plates, N_SIDE), axis=2)], axis=1)
            # As in the planner: from plate to plate, and a pick for each.
            steps[rows] = np.abs(np.diff(places, axis=1)).sum(axis=(1, 2)) + n_plates - n_picked
        return steps
