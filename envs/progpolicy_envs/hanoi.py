"""Hanoi-v0: the Tower of Hanoi with any number of discs behind an observation of fixed size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from progpolicy_envs.planners import hanoi as planner
from progpolicy_envs.planning import PlanningEnv
from progpolicy_envs.rendering import hanoi_frame
from progpolicy_envs.states import is_sequence
from progpolicy_envs.symmetry import Permutation, Symmetry
from progpolicy_envs.variation import RANDOM, IntParameter, Variation, VariationSpace
from progpolicy_envs.vector import PlanningVectorEnv

MAX_DISCS = 12
N_PEGS = 3
MOVES: tuple[tuple[int, int], ...] = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
_N_TOPS = MAX_DISCS + 1  # a peg's top disc, or none
STEP_REWARD, ILLEGAL_REWARD, GOAL_REWARD = -0.01, -0.05, 1.0

OBSERVATION_NAMES = tuple(f"{feature}[{peg}]" for peg in range(N_PEGS) for feature in ("rank", "colour", "empty"))
ACTION_NAMES = tuple(f"move {source}->{target}" for source, target in MOVES)
_OBSERVATION_SPACE = spaces.Box(
    np.tile(np.array([-1, -1, 0], np.float32), N_PEGS), np.ones(3 * N_PEGS, np.float32), dtype=np.float32
)


def _renamed(pegs: tuple[int, ...]) -> Symmetry:
    """Return the symmetry that gives peg ``i`` the name ``pegs[i]``."""
    old = {new: peg for peg, new in enumerate(pegs)}
    observation = [3 * old[peg] + feature for peg in range(N_PEGS) for feature in range(3)]
    action = [MOVES.index((old[source], old[target])) for source, target in MOVES]
    return Symmetry("pegs", Permutation.of(observation), Permutation.of(action))


#: The pegs may be renamed.
SYMMETRIES = (_renamed((1, 0, 2)), _renamed((1, 2, 0)))


def _check_variation(variation: Variation) -> None:
    """Raise ``ValueError`` if source and target are the same peg."""
    if variation["source"] == variation["target"] != RANDOM:
        raise ValueError(
            f"source={variation['source']} and target={variation['target']} are not accepted together; "
            "they are two different pegs from 0 to 2, or 'random'"
        )


VARIATIONS = VariationSpace(
    IntParameter("n_discs", 1, MAX_DISCS, 3, "number of discs"),
    IntParameter("source", 0, N_PEGS - 1, 0, "peg on which all discs start", (RANDOM,)),
    IntParameter("target", 0, N_PEGS - 1, 2, "peg to which all discs go; not the source", (RANDOM,)),
    check=_check_variation,
    starts={"discs": "the peg of each disc, the smallest first"},
)


def _peg_pairs(variation: Variation) -> list[tuple[int, int]]:
    """Return the pairs of source and target that a variation allows."""
    return [
        pair for pair in MOVES if variation["source"] in (pair[0], RANDOM) and variation["target"] in (pair[1], RANDOM)
    ]


def _draw_pegs(pairs: list[tuple[int, int]], rng: np.random.Generator) -> tuple[int, int]:
    """Draw source and target of an episode."""
    return pairs[int(len(pairs) * rng.random())] if len(pairs) > 1 else pairs[0]


def read_state(state: Mapping[str, Any]) -> tuple[list[int], int, int]:
    """Return discs, source and target of a state.

    :param state: values of ``n_discs``, ``source``, ``target`` and ``discs``; see :attr:`HanoiEnv.state`
    :raises ValueError: if it is not a state
    """
    discs = state["discs"]
    variation = VARIATIONS.update({}, {name: state[name] for name in VARIATIONS})
    if RANDOM in (variation["source"], variation["target"]):
        raise ValueError(f"{RANDOM!r} is not accepted in a state; its source and target are pegs from 0 to 2")
    pegs = VARIATIONS["source"]
    if not is_sequence(discs) or len(discs) != variation["n_discs"]:
        raise ValueError(
            f"discs={discs!r} is not accepted; discs are {variation['n_discs']} pegs, one for each of the n_discs discs"
        )
    if RANDOM in discs:
        raise ValueError(f"discs={discs!r} is not accepted; each is a peg from 0 to 2")
    return [int(pegs.parse(peg)) for peg in discs], int(variation["source"]), int(variation["target"])


class HanoiEnv(PlanningEnv):
    """Move a tower of discs from one peg to another, one disc at a time, never a larger disc on a smaller one.

    ## Description
    ``n_discs`` discs of different sizes lie on the source peg, the largest at the bottom. The task is done when all
    of them lie on the target peg. The least number of moves is ``2**n_discs - 1``.

    ## Action Space
    ``Discrete(6)``: move the top disc of one peg onto another.

    | Num | Move   | Num | Move   | Num | Move   |
    |-----|--------|-----|--------|-----|--------|
    | 0   | 0 -> 1 | 2   | 1 -> 0 | 4   | 2 -> 0 |
    | 1   | 0 -> 2 | 3   | 1 -> 2 | 5   | 2 -> 1 |

    ## Observation Space
    ``Box(9,)``, three numbers for each peg, the same for any number of discs. The rules depend on the top discs alone,
    so only these are shown.

    | Num     | Observation | Min | Max | Meaning                                                                  |
    |---------|-------------|-----|-----|--------------------------------------------------------------------------|
    | 0, 3, 6 | rank[peg]   | -1  | 1   | size of the top disc among the three tops: -1 smallest, 0 middle,        |
    |         |             |     |     | 1 largest; an empty peg counts as largest, two empty pegs share 0.5      |
    | 1, 4, 7 | colour[peg] | -1  | 1   | colour of what is on top; colours alternate with size, the smallest disc |
    |         |             |     |     | is -1; where the peg is empty, the colour of its base: those of source   |
    |         |             |     |     | and target continue the alternation, the third base has the other colour |
    | 2, 5, 8 | empty[peg]  | 0   | 1   | 1 where the peg holds no disc                                            |

    Classical solutions by hand rest on such colours: in a shortest solution from a whole tower a disc is never put onto
    one of its own colour. Which disc has just been moved cannot be seen; a policy has to remember it.

    ## Rewards
    -0.01 a step, a further -0.05 for an illegal move, +1 when the last disc reaches the target.

    ## Starting State
    All discs on the source peg. Source and target are fixed or, where they are ``"random"``, drawn for each episode,
    which shows a policy the same puzzle from all sides. ``env.reset(options={"discs": [1, 0, 0]})`` starts from any
    legal state: the peg of each disc, the smallest first. Other domains have ``n_done``; a tower has not: its discs are
    not done one after another, and a tower whose largest discs are in place is one of fewer discs.

    ## Episode End
    Terminated when all discs lie on the target peg; truncated after 500 steps (``max_episode_steps``). From nine discs
    on a shortest solution is longer, 511 moves and more: give ``gym.make`` a larger ``max_episode_steps``.

    ## Information
    ``info["is_success"]`` at every step; at reset also ``info["variation"]`` and ``info["optimal_steps"]``, the
    length of a shortest solution, whose actions ``env.unwrapped.plan()`` returns.

    ## Arguments
    ``gym.make("Hanoi-v0", n_discs=5)`` or ``env.reset(options={"n_discs": 5})``; an option stays in force until it
    is changed. Values that are not accepted raise ``ValueError``.
    ``context="observed"``, for ``gym.make``, adds the variation's numbers, from 0 to 1, to the end of observations.

    | Parameter  | Values             | Default | Meaning                                   |
    |------------|--------------------|---------|-------------------------------------------|
    | n_discs    | 1 to 12            | 3       | number of discs                           |
    | source     | 0 to 2, `"random"` | 0       | peg on which all discs start              |
    | target     | 0 to 2, `"random"` | 2       | peg to which all discs go; not the source |

    ## References
    The domain `hanoi` of PDDLGym (Silver and Chitnis, 2020); E. Lucas, *Récréations mathématiques* III (1893).

    ## Version History
    * v0: initial version
    """

    variations: ClassVar[VariationSpace] = VARIATIONS
    observation_names: tuple[str, ...] = OBSERVATION_NAMES
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES
    symmetries: ClassVar[tuple[Symmetry, ...]] = SYMMETRIES

    def __init__(
        self,
        n_discs: int = 3,
        source: int | str = 0,
        target: int | str = 2,
        render_mode: str | None = None,
        context: str = "hidden",
    ) -> None:
        super().__init__(
            {"n_discs": n_discs, "source": source, "target": target}, _OBSERVATION_SPACE, render_mode, context
        )
        self.action_space = spaces.Discrete(len(MOVES))
        self.source, self.target = 0, 0
        self.discs: list[int] = []

    def step(self, action: np.int64 | int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move a disc, if the rules allow it.

        :param action: 0 to 5, see the table above
        :return: observation, reward, terminated, truncated, info
        :raises ValueError: if the action is out of range
        """
        source, target = MOVES[self._check_action(action)]
        tops = self._tops()
        reward = STEP_REWARD
        if tops[source] < tops[target]:
            self.discs[tops[source]] = target
        else:
            reward += ILLEGAL_REWARD
        solved = all(peg == self.target for peg in self.discs)
        reward += GOAL_REWARD * solved
        self._show()
        return self._observation(), reward, solved, False, {"is_success": solved}

    def _draw(self, variation: Variation) -> None:
        self.source, self.target = _draw_pegs(_peg_pairs(variation), self.np_random)
        self.discs = [self.source] * variation["n_discs"]

    def _state(self) -> dict[str, Any]:
        return {"n_discs": len(self.discs), "source": self.source, "target": self.target, "discs": list(self.discs)}

    def _set_state(self, state: Mapping[str, Any]) -> None:
        self.discs, self.source, self.target = read_state(state)

    def _plan(self) -> list[int]:
        return [MOVES.index(move) for move in planner.plan(self.discs, self.target)]

    def _optimal_steps(self) -> int:
        return planner.optimal_steps(self.discs, self.target)

    def _tops(self) -> list[int]:
        """Index of the top disc of each peg, 0 the smallest; ``n_discs`` for an empty peg."""
        n_discs = len(self.discs)
        tops = [n_discs] * N_PEGS
        for disc in reversed(range(n_discs)):
            tops[self.discs[disc]] = disc
        return tops

    def _observe(self) -> NDArray[np.float32]:
        tops, n_discs = self._tops(), len(self.discs)
        observation = np.empty((N_PEGS, 3), dtype=np.float32)
        for peg, top in enumerate(tops):
            empty = top == n_discs
            continues = peg in (self.source, self.target)
            shade = top + (empty and not continues)
            observation[peg] = (sum((top > other) - (top < other) for other in tops) / 2, 2 * (shade % 2) - 1, empty)
        return observation.reshape(-1)

    def _frame(self) -> NDArray[np.uint8]:
        return hanoi_frame(self.discs, self.source, self.target)

    def _text(self) -> str:
        n_discs = len(self.discs)
        width = 2 * n_discs + 1
        stacks = [[disc for disc in range(n_discs) if self.discs[disc] == peg] for peg in range(N_PEGS)]
        rows = []
        for level in reversed(range(n_discs)):
            cells = []
            for stack in stacks:
                disc = stack[len(stack) - 1 - level] if level < len(stack) else None
                cells.append(("|" if disc is None else "=" * (2 * disc + 3)).center(width))
            rows.append(" ".join(cells).rstrip())
        names = {self.source: "source", self.target: "target"}
        base = " ".join(f"{peg} {names.get(peg, '')}".strip().center(width, "-") for peg in range(N_PEGS))
        return "\n".join([*rows, base]) + "\n"


def _all_observations() -> NDArray[np.float32]:
    """Return the observation of every triple of top discs and of base colours, in the order in which they are coded.

    A look-up is several times faster than comparing the pegs at every step, and the table is small.

    :return: ``(13**3 * 2**3, 9)``; the first peg counts most, the colours of the three bases are the last three bits
    """
    tops = np.stack(np.meshgrid(*[np.arange(_N_TOPS)] * N_PEGS, indexing="ij"), axis=-1).reshape(-1, 1, N_PEGS)
    bases = (np.arange(2**N_PEGS)[:, None] >> np.arange(N_PEGS)) & 1
    observations = np.empty((_N_TOPS**N_PEGS, 2**N_PEGS, N_PEGS, 3), dtype=np.float32)
    observations[..., 0] = np.sign(tops[..., None] - tops[..., None, :]).sum(axis=-1) / 2
    observations[..., 1] = 2 * np.where(tops == MAX_DISCS, bases, tops % 2) - 1
    observations[..., 2] = tops == MAX_DISCS
    return observations.reshape(-1, 3 * N_PEGS)


class HanoiVectorEnv(PlanningVectorEnv):
    """N towers stepped at once, equal to N :class:`HanoiEnv` step for step.

    The discs of a peg are the bits of an integer, so that the top disc is the lowest bit set.

    :param num_envs: number of environments
    :param n_discs: see :class:`HanoiEnv`
    :param source: see :class:`HanoiEnv`
    :param target: see :class:`HanoiEnv`
    :param max_episode_steps: steps after which an episode is truncated; ``None`` for no limit
    """

    variations: ClassVar[VariationSpace] = VARIATIONS
    observation_names: tuple[str, ...] = OBSERVATION_NAMES
    action_names: ClassVar[tuple[str, ...]] = ACTION_NAMES

    _FROM, _TO = (np.array(column) for column in zip(*MOVES, strict=True))
    # Lowest bit set of every set of discs; an empty peg reads MAX_DISCS, larger than any disc.
    _TOP = np.array([(bits & -bits).bit_length() - 1 if bits else MAX_DISCS for bits in range(2**MAX_DISCS)])
    _OBSERVATIONS = _all_observations()

    def __init__(
        self,
        num_envs: int = 1,
        n_discs: int = 3,
        source: int | str = 0,
        target: int | str = 2,
        max_episode_steps: int | None = None,
        context: str = "hidden",
    ) -> None:
        variation = self.variations.update({}, {"n_discs": n_discs, "source": source, "target": target})
        actions = spaces.Discrete(len(MOVES))
        super().__init__(num_envs, _OBSERVATION_SPACE, actions, variation, max_episode_steps, context)
        self._bits = np.zeros((num_envs, N_PEGS), dtype=np.int64)
        self._tops = np.zeros((num_envs, N_PEGS), dtype=np.int64)
        self._n_discs = np.zeros(num_envs, dtype=np.int64)
        self._full = np.zeros(num_envs, dtype=np.int64)
        self._source = np.zeros(num_envs, dtype=np.int64)
        self._target = np.zeros(num_envs, dtype=np.int64)
        self._bases = np.zeros(num_envs, dtype=np.int64)
        self._random = np.zeros(num_envs, dtype=bool)
        self._read_variations()

    def _read_variations(self) -> None:
        self._n_discs = np.array([variation["n_discs"] for variation in self.row_variations])
        self._full = (1 << self._n_discs) - 1
        self._pairs = [_peg_pairs(variation) for variation in self.row_variations]
        self._random = np.array([len(pairs) > 1 for pairs in self._pairs])
        self._place_pegs(np.flatnonzero(~self._random))

    def _place_pegs(self, rows: NDArray[np.intp]) -> None:
        """Read or draw source and target, and colour the bases with them."""
        for row in rows:
            source, target = _draw_pegs(self._pairs[row], self._generators[row])
            self._source[row], self._target[row] = source, target
        self._colour_bases(rows)

    def _colour_bases(self, rows: NDArray[np.intp]) -> None:
        # Bit per peg: source and target continue the alternation of n discs, the third base does not.
        continued = (1 << self._source[rows]) | (1 << self._target[rows])
        self._bases[rows] = np.where(self._n_discs[rows] % 2, continued, 2**N_PEGS - 1 - continued)

    def _reset_rows(self, rows: NDArray[np.intp]) -> None:
        self._place_pegs(rows[self._random[rows]])
        self._bits[rows] = 0
        self._bits[rows, self._source[rows]] = self._full[rows]
        self._tops[rows] = self._TOP[self._bits[rows]]

    @classmethod
    def count_starts(cls, variation: Mapping[str, Any], any_state: bool = False) -> int:
        """Return the number of pairs of pegs, times that of legal states, see :class:`PlanningVectorEnv`."""
        n_discs = cls._counted(variation)["n_discs"]
        return len(cls._pairs_of(variation)) * (N_PEGS**n_discs if any_state else 1)

    @classmethod
    def _counted(cls, variation: Mapping[str, Any]) -> Variation:
        known = {**cls.variations.defaults, **cls.variations.parse(variation)}
        # A peg that is not given is another one than the peg that is.
        for name, other in (("source", "target"), ("target", "source")):
            if name not in variation and known[name] == known[other]:
                known[name] = RANDOM
        return cls.variations.update({}, known)

    @classmethod
    def _pairs_of(cls, given: Mapping[str, Any]) -> list[tuple[int, int]]:
        return _peg_pairs({"source": RANDOM, "target": RANDOM, **cls.variations.parse(given)})

    def _put_starts(
        self, variation: Variation, given: Mapping[str, Any], numbers: NDArray[np.int64], any_state: bool
    ) -> None:
        pairs = np.array(self._pairs_of(given))
        rest, pair = np.divmod(numbers, len(pairs))
        self._source, self._target = pairs[pair].T.copy()
        self._colour_bases(self._rows)
        self._bits[:] = 0
        for disc in range(variation["n_discs"]):
            rest, peg = np.divmod(rest, N_PEGS) if any_state else (rest, self._source)
            self._bits[self._rows, peg] |= 1 << disc
        self._tops = self._TOP[self._bits]

    def _move(self, actions: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        pegs = N_PEGS * self._rows
        source, target = pegs + self._FROM[actions], pegs + self._TO[actions]
        bits, tops = self._bits.reshape(-1), self._tops.reshape(-1)  # views
        moved, under = tops[source], tops[target]
        legal = moved < under
        disc = np.where(legal, 1 << moved, 0)
        left, grown = bits[source] ^ disc, bits[target] ^ disc
        bits[source], bits[target] = left, grown
        tops[source], tops[target] = self._TOP[left], self._TOP[grown]
        solved = bits[pegs + self._target] == self._full
        rewards = np.where(legal, STEP_REWARD, STEP_REWARD + ILLEGAL_REWARD) + GOAL_REWARD * solved
        return rewards, solved

    def _observe(self) -> NDArray[np.float32]:
        tops = self._tops
        return self._OBSERVATIONS.take(
            ((tops[:, 0] * _N_TOPS + tops[:, 1]) * _N_TOPS + tops[:, 2]) * 2**N_PEGS + self._bases, axis=0
        )

    def _state_of(self, row: int) -> dict[str, Any]:
        discs = [
            next(peg for peg in range(N_PEGS) if int(self._bits[row, peg]) >> disc & 1)
            for disc in range(int(self._n_discs[row]))
        ]
        pegs = {"source": int(self._source[row]), "target": int(self._target[row])}
        return {"n_discs": len(discs), **pegs, "discs": discs}

    def _set_state_of(self, row: int, state: Mapping[str, Any]) -> None:
        discs, _, _ = read_state(state)
        self._bits[row] = [sum(1 << disc for disc, on in enumerate(discs) if on == peg) for peg in range(N_PEGS)]
        self._tops[row] = self._TOP[self._bits[row]]

    def _optimal_steps(self) -> NDArray[np.int64]:
        steps, target = np.zeros(self.num_envs, dtype=np.int64), self._target
        for disc in reversed(range(MAX_DISCS)):
            # As in the planner: what is misplaced goes to the target once, after all smaller discs to the third peg.
            on = (self._bits >> disc & 1).argmax(axis=1)
            misplaced = (disc < self._n_discs) & (on != target)
            steps += misplaced * 2**disc
            target = np.where(misplaced, 3 - on - target, target)
        return steps
