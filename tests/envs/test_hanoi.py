"""Hanoi-v0, held against the puzzle's rules rather than against its own code."""

from collections import deque
from itertools import pairwise, permutations, product
from pathlib import Path

import gymnasium as gym
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from progpolicy_envs.hanoi import ACTION_NAMES, MOVES, OBSERVATION_NAMES, HanoiEnv
from progpolicy_envs.planners import hanoi as planner
from tests.envs.helpers import (
    assert_checkers_are_silent,
    assert_long_run_stays_sound,
    assert_picture_shows_the_state,
    assert_window_opens_shows_and_closes,
    run_python,
)
from tests.handwritten.evaluate import Player, play, play_batch, size_of
from tests.handwritten.hanoi import hanoi_program


class Referee:
    """The puzzle as Lucas describes it: three piles, only a top disc is moved, never onto a smaller one."""

    def __init__(self, n_discs: int, source: int) -> None:
        self.piles: list[list[int]] = [[], [], []]
        self.piles[source] = list(range(n_discs, 0, -1))

    def move(self, source: int, target: int) -> None:
        assert self.piles[source], f"no disc on peg {source}"
        disc = self.piles[source].pop()
        assert all(disc < other for other in self.piles[target]), f"disc {disc} onto a smaller one"
        self.piles[target].append(disc)


@pytest.mark.parametrize("n_discs", range(1, 11))
@pytest.mark.parametrize(("source", "target"), list(permutations(range(3), 2)))
def test_plan_obeys_the_rules_of_the_puzzle_and_is_shortest(n_discs: int, source: int, target: int) -> None:
    referee = Referee(n_discs, source)
    moves = list(planner.plan([source] * n_discs, target))
    for move in moves:
        referee.move(*move)
    assert referee.piles[target] == list(range(n_discs, 0, -1))
    assert len(moves) == 2**n_discs - 1 == planner.optimal_steps([source] * n_discs, target)


@pytest.mark.parametrize("n_discs", range(1, 6))
@pytest.mark.parametrize("target", range(3))
def test_planner_is_as_short_as_breadth_first_search_from_every_state(n_discs: int, target: int) -> None:
    goal = (target,) * n_discs
    distance, queue = {goal: 0}, deque([goal])
    while queue:
        discs = queue.popleft()
        for source, to in MOVES:
            at_source = [disc for disc in range(n_discs) if discs[disc] == source]
            if at_source and all(disc > at_source[0] for disc in range(n_discs) if discs[disc] == to):
                moved = (*discs[: at_source[0]], to, *discs[at_source[0] + 1 :])
                if moved not in distance:
                    distance[moved] = distance[discs] + 1
                    queue.append(moved)
    assert len(distance) == 3**n_discs
    for discs in product(range(3), repeat=n_discs):
        assert planner.optimal_steps(discs, target) == distance[discs] == len(list(planner.plan(discs, target)))


@pytest.mark.parametrize("n_discs", [1, 2, 7, 12])
def test_environment_takes_the_plan_and_ends_at_its_last_move_only(n_discs: int) -> None:
    env = HanoiEnv(n_discs=n_discs)
    _, info = env.reset()
    assert info["optimal_steps"] == 2**n_discs - 1
    actions = env.plan()
    assert len(actions) == info["optimal_steps"]
    for number, action in enumerate(actions, start=1):
        _, reward, terminated, truncated, info = env.step(action)
        last = number == len(actions)
        assert (terminated, truncated, info["is_success"]) == (last, False, last)
        assert reward == pytest.approx(-0.01 + last)


@settings(max_examples=60, deadline=None)
@given(
    n_discs=st.integers(1, 12),
    pegs=st.permutations(range(3)),
    actions=st.lists(st.integers(0, 5), max_size=80),
)
def test_any_actions_keep_the_state_legal_and_the_observation_inside_its_space(
    n_discs: int, pegs: list[int], actions: list[int]
) -> None:
    env = HanoiEnv(n_discs=n_discs, source=pegs[0], target=pegs[1])
    observation, _ = env.reset()
    referee = Referee(n_discs, pegs[0])
    for action in actions:
        assert env.observation_space.contains(observation)
        source, target = MOVES[action]
        pile, onto = referee.piles[source], referee.piles[target]
        legal = bool(pile) and (not onto or pile[-1] < onto[-1])
        if legal:
            referee.move(source, target)
        observation, reward, terminated, _, _ = env.step(action)
        assert env.discs == [peg for disc in range(1, n_discs + 1) for peg in range(3) if disc in referee.piles[peg]]
        assert terminated == (len(referee.piles[pegs[1]]) == n_discs)
        assert reward == pytest.approx(-0.01 - 0.05 * (not legal) + terminated)


def test_observation_is_what_the_docstring_says() -> None:
    env = HanoiEnv(n_discs=3, source=0, target=2)
    observation, _ = env.reset()
    named = dict(zip(OBSERVATION_NAMES, observation, strict=True))
    # Three discs are coloured -1, +1, -1; the bases of source and target go on with +1, the spare one is -1.
    assert [named[f"rank[{peg}]"] for peg in range(3)] == [-1, 0.5, 0.5]
    assert [named[f"colour[{peg}]"] for peg in range(3)] == [-1, -1, 1]
    assert [named[f"empty[{peg}]"] for peg in range(3)] == [0, 1, 1]
    observation, *_ = env.step(ACTION_NAMES.index("move 0->2"))
    named = dict(zip(OBSERVATION_NAMES, observation, strict=True))
    assert [named[f"rank[{peg}]"] for peg in range(3)] == [0, 1, -1]
    assert [named[f"colour[{peg}]"] for peg in range(3)] == [1, -1, -1]
    assert [named[f"empty[{peg}]"] for peg in range(3)] == [0, 1, 0]


@pytest.mark.parametrize("n_discs", range(1, 11))
def test_handwritten_controller_is_optimal_on_training_and_unseen_variations(n_discs: int) -> None:
    program = hanoi_program()
    assert size_of(program) == (0, 1)
    episodes = play_batch(program, "Hanoi-v0", 24, 2**10, n_discs=n_discs, source="random", target="random")
    assert all(episode.success for episode in episodes)
    assert {episode.steps for episode in episodes} == {episode.optimal for episode in episodes} == {2**n_discs - 1}


def test_handwritten_controller_stays_optimal_when_its_history_survives_episodes() -> None:
    policy = Player(hanoi_program())
    env = gym.make("Hanoi-v0", n_discs=4)
    assert [play(policy, env).steps for _ in range(4)] == [15] * 4


@pytest.mark.parametrize(
    ("source", "target", "pairs"),
    [
        ("random", "random", set(permutations(range(3), 2))),
        (1, "random", {(1, 0), (1, 2)}),
        ("random", 0, {(1, 0), (2, 0)}),
    ],
)
def test_random_pegs_are_drawn_anew_for_each_episode(
    source: int | str, target: int | str, pairs: set[tuple[int, int]]
) -> None:
    env = HanoiEnv(n_discs=2, source=source, target=target)
    drawn = set()
    for episode in range(60):
        _, info = env.reset(seed=3 if episode == 0 else None)
        assert info["variation"] == {"n_discs": 2, "source": source, "target": target}
        drawn.add((env.source, env.target))
        assert [env.step(action)[2] for action in env.plan()] == [False, False, True]
    assert drawn == pairs


def test_source_and_target_must_differ() -> None:
    with pytest.raises(ValueError, match=r"source=1 and target=1 .* two different pegs from 0 to 2, or 'random'"):
        HanoiEnv(source=1, target=1)
    env = HanoiEnv(source=0, target=2)
    with pytest.raises(ValueError, match="source=2 and target=2"):
        env.reset(options={"source": 2})
    assert env.variation == {"n_discs": 3, "source": 0, "target": 2}


@pytest.mark.parametrize("action", [-1, 6, 1.5, "left"])
def test_action_out_of_range_is_refused(action: object) -> None:
    env = HanoiEnv()
    env.reset()
    with pytest.raises(ValueError, match="integers from 0 to 5"):
        env.step(action)  # type: ignore[arg-type]


def test_text_shows_discs_source_and_target() -> None:
    env = HanoiEnv(n_discs=2, render_mode="ansi")
    env.reset()
    env.step(ACTION_NAMES.index("move 0->1"))
    lines = env.render().splitlines()
    assert lines[-2].split() == ["=====", "===", "|"]
    assert "source" in lines[-1]
    assert "target" in lines[-1]


def test_picture_shows_the_state() -> None:
    assert_picture_shows_the_state(gym.make("Hanoi-v0", render_mode="rgb_array"), action=0)


def test_window_opens_shows_and_closes() -> None:
    assert_window_opens_shows_and_closes("Hanoi-v0")


@pytest.mark.parametrize("n_discs", [1, 12])
def test_environment_checkers_find_nothing(n_discs: int) -> None:
    assert_checkers_are_silent("Hanoi-v0", n_discs=n_discs)


def test_long_run_of_random_actions() -> None:
    options = [{"n_discs": n, "source": n % 3, "target": (n + 1) % 3} for n in (1, 2, 3, 5, 12)]
    assert_long_run_stays_sound("Hanoi-v0", 1_000_000, options)


def test_registration_does_not_import_the_environment() -> None:
    code = "import progpolicy_envs, sys; assert not {'progpolicy_envs.hanoi', 'pybullet', 'torch'} & set(sys.modules)"
    run_python(code)


def pddl_problem(n_discs: int) -> str:
    """Write the problem for PDDLGym's Hanoi domain: all discs from the first peg to the third."""
    discs, pegs = [f"d{disc}" for disc in range(n_discs)], ["p0", "p1", "p2"]
    places = [*discs, *pegs]
    facts = [f"(smaller {peg} {disc})" for peg in pegs for disc in discs]
    facts += [f"(smaller {discs[j]} {discs[i]})" for i in range(n_discs) for j in range(i + 1, n_discs)]
    facts += [f"(move {disc} {place})" for disc in discs for place in places if disc != place]
    tower = [*discs, "p0"]
    facts += [f"(on {upper} {lower})" for upper, lower in pairwise(tower)]
    facts += ["(clear d0)", "(clear p1)", "(clear p2)"]
    done = [*discs, "p2"]
    goal = " ".join(f"(on {upper} {lower})" for upper, lower in pairwise(done))
    return (
        f"(define (problem hanoi{n_discs}) (:domain hanoi) (:objects {' '.join(places)})\n"
        f"(:init {' '.join(facts)})\n(:goal (and {goal})))\n"
    )


@pytest.mark.parametrize("n_discs", [1, 2, 3, 4, 5])
def test_plan_is_a_valid_plan_in_pddlgym(n_discs: int, tmp_path: Path) -> None:
    pddlgym = pytest.importorskip("pddlgym", reason="PDDLGym is not installed", exc_type=ImportError)
    from pddlgym.core import PDDLEnv

    (tmp_path / "problem0.pddl").write_text(pddl_problem(n_discs))
    domain_file = Path(pddlgym.__file__).parent / "pddl" / "hanoi.pddl"
    env = PDDLEnv(str(domain_file), str(tmp_path), raise_error_on_invalid_action=True)
    env.reset()
    (move,) = env.action_predicates
    referee, done = Referee(n_discs, 0), False
    for source, target in planner.plan([0] * n_discs, 2):
        assert not done
        referee.move(source, target)
        pile = referee.piles[target]
        under = f"d{pile[-2] - 1}" if len(pile) > 1 else f"p{target}"
        _, _, done, _, _ = env.step(move(f"d{pile[-1] - 1}", under))
    assert done


def situations(n_discs: int, source: int, target: int) -> set[tuple[bytes, int | None]]:
    """What can be seen on the shortest solution: each observation with the move before it."""
    env, seen, previous = HanoiEnv(n_discs, source, target), set(), None
    observation, _ = env.reset()
    for move in planner.plan([source] * n_discs, target):
        seen.add((observation.tobytes(), previous))
        previous = MOVES.index(move)
        observation, *_ = env.step(previous)
    return seen


def test_small_towers_show_every_situation_of_larger_ones_only_when_the_pegs_are_drawn() -> None:
    tested = set().union(*(situations(n, 0, 2) for n in range(1, 11)))
    fixed = set().union(*(situations(n, 0, 2) for n in range(1, 5)))
    drawn = set().union(*(situations(n, *pegs) for n in range(1, 5) for pegs in permutations(range(3), 2)))
    assert (len(tested), len(tested - fixed), len(tested - drawn)) == (38, 18, 0)
