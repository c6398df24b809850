"""Hiking: maps, tours and observations, and the right-hand rule written as a program."""

from collections import Counter, deque
from itertools import permutations, product

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from progpolicy_envs.hiking import HikingEgoEnv, HikingEnv, HikingV0Env
from progpolicy_envs.layouts import LAYOUTS, N_RANDOM_LAYOUTS, NEIGHBOURS, Layout, random_layout
from progpolicy_envs.planners import hiking as planner
from sb3_progpolicy.programs.syntax import Program
from tests.envs.helpers import (
    assert_checkers_are_silent,
    assert_long_run_stays_sound,
    assert_picture_shows_the_state,
    assert_window_opens_shows_and_closes,
)
from tests.handwritten.evaluate import Player, play, play_batch, size_of
from tests.handwritten.hiking import egocentric_program, map_program, turns

NORTH, EAST, SOUTH, WEST = range(4)
ENVS = {"Hiking-v0": HikingV0Env, "Hiking-v1": HikingEnv, "HikingEgo-v0": HikingEgoEnv}
WHOLE_MAPS = ("Hiking-v0", "Hiking-v1")
SAMPLE = [*LAYOUTS.values(), *(random_layout(number) for number in range(0, N_RANDOM_LAYOUTS, 16))]


def walk(rows: tuple[str, ...], cell: tuple[int, int], action: int) -> tuple[int, int]:
    """Walk by the map's text alone; stay where there is no pathway."""
    row, column = cell[0] + (-1, 0, 1, 0)[action], cell[1] + (0, 1, 0, -1)[action]
    inside = 0 <= row < len(rows) and 0 <= column < len(rows[0])
    return (row, column) if inside and rows[row][column] in ".H" else cell


def distances_from(rows: tuple[str, ...], start: tuple[int, int]) -> dict[tuple[int, int], int]:
    distances, queue = {start: 0}, deque([start])
    while queue:
        cell = queue.popleft()
        for action in range(4):
            near = walk(rows, cell, action)
            if near not in distances:
                distances[near] = distances[cell] + 1
                queue.append(near)
    return distances


@pytest.mark.parametrize("layout", SAMPLE, ids=lambda layout: layout.rows[0])
def test_map_is_a_tree_of_pathways_with_room_for_all_stars(layout: Layout) -> None:
    assert [len(row) for row in layout.rows] == [10] * 8
    text = "".join(layout.rows)
    assert set(text) <= set(".#~H")
    assert text.count("H") == 1
    path = {(row, column) for row in range(8) for column in range(10) if layout.rows[row][column] in ".H"}
    start = divmod(layout.start, 10)
    assert set(distances_from(layout.rows, start)) == path, "connected"
    links = sum((row + 1, column) in path for row, column in path) + sum((row, col + 1) in path for row, col in path)
    assert links == len(path) - 1, "no ring"
    assert len(layout.star_cells) >= 12
    assert layout.start not in layout.star_cells


def test_hand_drawn_maps_bend_fork_and_end() -> None:
    for name in ("valley", "comb", "fork", "lakeside"):
        layout = LAYOUTS[name]
        ways = [
            sum(walk(layout.rows, divmod(int(cell), 10), action) != divmod(int(cell), 10) for action in range(4))
            for cell in np.flatnonzero(layout.is_path)
        ]
        assert ways.count(1) >= 3, "dead ends"
        assert max(ways) >= 3, "a fork"


def test_random_maps_differ_and_a_number_always_gives_the_same() -> None:
    assert len({random_layout(number).rows for number in range(200)}) == 200
    before = random_layout(17).rows
    random_layout.cache_clear()
    assert random_layout(17).rows == before


def test_maps_to_practise_on_are_none_of_the_others() -> None:
    rows = [random_layout(number).rows for number in range(2 * N_RANDOM_LAYOUTS)]
    assert not set(rows[:N_RANDOM_LAYOUTS]) & {*rows[N_RANDOM_LAYOUTS:], *(layout.rows for layout in LAYOUTS.values())}
    drawn = {"random": set(), "practice": set()}
    for family, seen in drawn.items():
        env = HikingEgoEnv(layout=family)
        for seed in range(50):
            env.reset(seed=seed)
            seen.add(tuple(env.state["layout"].split("\n")))
    assert drawn["random"] <= set(rows[:N_RANDOM_LAYOUTS])
    assert drawn["practice"] <= set(rows[N_RANDOM_LAYOUTS:])


@pytest.mark.parametrize("number", [-1, 2 * N_RANDOM_LAYOUTS])
def test_random_map_number_out_of_range_is_refused(number: int) -> None:
    with pytest.raises(ValueError, match=f"random map {number} does not exist; numbers are 0 to 2047"):
        random_layout(number)


@pytest.mark.parametrize("layout", SAMPLE[:12], ids=lambda layout: layout.rows[0])
def test_distances_are_those_of_breadth_first_search(layout: Layout) -> None:
    for cell in np.flatnonzero(layout.is_path):
        expected = distances_from(layout.rows, divmod(int(cell), 10))
        for other in range(80):
            assert layout.distances[cell, other] == expected.get(divmod(other, 10), -1)


@pytest.mark.parametrize("seed", range(12))
def test_planner_is_as_short_as_trying_every_order(seed: int) -> None:
    generator = np.random.default_rng(seed)
    layout = SAMPLE[seed * 5]
    stars = generator.permutation(layout.star_cells)[: 1 + seed % 6].tolist()
    legs = {place: distances_from(layout.rows, divmod(place, 10)) for place in [layout.start, *stars]}
    shortest = min(
        sum(legs[a][divmod(b, 10)] for a, b in zip((layout.start, *order), order, strict=False))
        for order in permutations(stars)
    )
    assert planner.optimal_steps(layout, layout.start, stars) == shortest
    assert len(planner.plan(layout, layout.start, stars)) == shortest


@pytest.mark.parametrize("name", LAYOUTS)
def test_planner_knows_the_shortest_tour_of_a_tree(name: str) -> None:
    # Without a way back: every pathway that leads to a star twice, but the way to the farthest star once.
    layout = LAYOUTS[name]
    for seed in range(5):
        stars = np.random.default_rng(seed).permutation(layout.star_cells)[:12].tolist()
        from_start = distances_from(layout.rows, divmod(layout.start, 10))
        used = set()
        for star in stars:
            from_star = distances_from(layout.rows, divmod(star, 10))
            length = from_start[divmod(star, 10)]
            used |= {cell for cell in from_start if from_start[cell] + from_star[cell] == length}
        farthest = max(from_start[divmod(star, 10)] for star in stars)
        assert planner.optimal_steps(layout, layout.start, stars) == 2 * (len(used) - 1) - farthest


def test_plan_of_no_stars_is_empty() -> None:
    layout = LAYOUTS["fork"]
    assert planner.plan(layout, layout.start, []) == []
    assert planner.optimal_steps(layout, layout.start, []) == 0


@pytest.mark.parametrize(("n_stars", "layout"), list(product([1, 5, 12], [*LAYOUTS, "random", "practice"])))
def test_environment_takes_the_plan_and_ends_at_its_last_step_only(n_stars: int, layout: str) -> None:
    env = HikingEnv(n_stars=n_stars, layout=layout)
    _, info = env.reset(seed=n_stars)
    actions = env.plan()
    assert len(actions) == info["optimal_steps"]
    results = [env.step(action) for action in actions]
    assert [result[2] for result in results] == [False] * (len(actions) - 1) + [True]
    assert sum(result[1] for result in results) == pytest.approx(n_stars - 0.01 * len(actions))
    assert results[-1][4]["is_success"]


@settings(max_examples=60, deadline=None)
@given(
    n_stars=st.integers(1, 12),
    layout=st.sampled_from([*LAYOUTS, "random"]),
    env_id=st.sampled_from(list(ENVS)),
    seed=st.integers(0, 2**31),
    actions=st.lists(st.integers(0, 3), max_size=60),
)
def test_any_actions_obey_the_map_and_keep_the_observation_inside_its_space(
    n_stars: int, layout: str, env_id: str, seed: int, actions: list[int]
) -> None:
    env = ENVS[env_id](n_stars=n_stars, layout=layout)
    seen, _ = env.reset(seed=seed)
    rows, place, stars = env.layout.rows, divmod(env.hiker, 10), {divmod(star, 10) for star in env.stars}
    assert len(stars) == n_stars
    assert place not in stars
    for action in actions:
        assert env.observation_space.contains(seen)
        before, place = place, walk(rows, place, action)
        found = place in stars
        stars.discard(place)
        seen, reward, terminated, _, _ = env.step(action)
        assert divmod(env.hiker, 10) == place
        assert {divmod(star, 10) for star in env.stars} == stars
        assert reward == pytest.approx(-0.01 - 0.05 * (before == place) + found)
        assert terminated == (not stars)
        if terminated:
            break
        assert_observation_shows(dict(zip(env.observation_names, seen, strict=True)), env_id, rows, place, stars)


def assert_observation_shows(
    named: dict[str, float], env_id: str, rows: tuple[str, ...], hiker: tuple[int, int], stars: set
) -> None:
    """Rebuild every number of an observation from the text of the map."""
    for row, column in product(range(-4, 13), range(-4, 15)):
        inside = 0 <= row < 8 and 0 <= column < 10
        value = 0.0 if inside and rows[row][column] in ".H" else -1.0
        if (row, column) in stars:
            value = {"Hiking-v0": 1 / 16, "Hiking-v1": np.float32(1 / (4 * len(stars)))}.get(env_id, 1.0)
        if (row, column) == hiker:
            value = 1.0
        down, right = row - hiker[0], column - hiker[1]
        if env_id in WHOLE_MAPS and inside:
            assert named[f"map[{row},{column}]"] == value
        elif env_id == "HikingEgo-v0" and max(abs(down), abs(right)) <= 4 and (down or right):
            assert named[f"window[{down:+d},{right:+d}]"] == value


def test_directions_are_clockwise_and_north_is_up() -> None:
    assert HikingEnv.action_names == HikingEgoEnv.action_names == ("north", "east", "south", "west")
    assert NEIGHBOURS[11].tolist() == [1, 12, 21, 10]
    assert NEIGHBOURS[0].tolist() == [0, 1, 10, 0]
    assert NEIGHBOURS[79].tolist() == [69, 79, 79, 78]


@pytest.mark.parametrize("n_stars", [1, 2, 3, 4, 5, 7, 10, 12])
@pytest.mark.parametrize("layout", [*LAYOUTS, "random"])
def test_handwritten_egocentric_program_collects_all_stars_on_every_map(layout: str, n_stars: int) -> None:
    program = egocentric_program()
    assert size_of(program) == (0, 1)
    episodes = play_batch(program, "HikingEgo-v0", 100, layout=layout, n_stars=n_stars)
    assert all(episode.success for episode in episodes)
    assert all(episode.steps >= episode.optimal for episode in episodes)
    # Without a map of the stars a round trip is the best one can do; it costs little when there are many.
    ratio = sum(episode.steps for episode in episodes) / sum(episode.optimal for episode in episodes)
    assert ratio < (5.0 if n_stars <= 2 else 2.8 if n_stars <= 4 else 2.3)


@pytest.mark.parametrize("n_stars", [1, 2, 3, 4, 5, 7, 10, 12])
@pytest.mark.parametrize("env_id", WHOLE_MAPS)
def test_handwritten_map_program_solves_training_and_unseen_variations(env_id: str, n_stars: int) -> None:
    program = map_program("valley", env_id)
    assert size_of(program) == (3, 4)
    episodes = play_batch(program, env_id, 100, layout="valley", n_stars=n_stars)
    assert all(episode.success for episode in episodes)
    round_trip = 2 * int(LAYOUTS["valley"].is_path.sum() - 1)
    assert all(episode.optimal <= episode.steps <= round_trip for episode in episodes)


@pytest.mark.parametrize(
    ("env_id", "layout", "program"),
    [("HikingEgo-v0", "random", egocentric_program()), ("Hiking-v1", "valley", map_program("valley"))],
)
def test_handwritten_programs_go_on_when_their_history_survives_episodes(
    env_id: str, layout: str, program: Program
) -> None:
    policy = Player(program)
    env = gym.make(env_id, layout=layout)
    assert all(play(policy, env, seed=seed, n_stars=1 + seed % 10).success for seed in range(30))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_stars_never_outweigh_the_hiker_in_the_map_program(layout: str) -> None:
    for heading in range(4):
        agreeing = max(Counter(turns(LAYOUTS[layout], heading).values()).values(), default=0)
        assert 2.0 * HikingV0Env.star_value * agreeing < 1.0
    assert 2.0 * HikingEnv.star_value < 1.0, "all stars together"


def test_stars_share_a_quarter_as_they_are_collected() -> None:
    env = gym.make("Hiking-v1", n_stars=7, layout="fork")
    observation, _ = env.reset(seed=0)
    seen = [float(observation[(observation > 0) & (observation < 1)].sum())]
    for action in env.unwrapped.plan():
        observation, *_ = env.step(action)
        seen.append(float(observation[(observation > 0) & (observation < 1)].sum()))
    np.testing.assert_allclose(seen[:-1], 0.25, rtol=1e-6)
    assert seen[-1] == 0
    assert observation.max() == 1


def test_positions_follow_the_seed_and_change_from_episode_to_episode() -> None:
    env, twin = HikingEnv(n_stars=4, layout="random"), HikingEnv(n_stars=4, layout="random")
    for seed in (5, None, None):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], twin.reset(seed=seed)[0])
        assert env.layout is twin.layout
    assert len({(env.reset()[0].tobytes()) for _ in range(10)}) == 10


def test_random_layout_is_followed_by_the_named_one_when_asked() -> None:
    env = HikingEnv(layout="random")
    env.reset(seed=0)
    assert env.layout not in LAYOUTS.values()
    _, info = env.reset(options={"layout": "comb"})
    assert env.layout is LAYOUTS["comb"]
    assert info["variation"] == {"n_stars": 3, "layout": "comb"}


@pytest.mark.parametrize("make", [gym.make, lambda *a, **k: gym.make_vec(*a, num_envs=2, **k)])
@pytest.mark.parametrize("observation", ["map", "egocentric"])
def test_choice_of_observation_that_was_once_an_argument_names_the_id_that_replaces_it(
    make: object, observation: str
) -> None:
    with pytest.raises(ValueError, match=f"observation='{observation}' is not accepted; .* HikingEgo-v0"):
        make("Hiking-v0", observation=observation)  # type: ignore[operator]


@pytest.mark.parametrize("env_class", ENVS.values())
def test_every_cell_that_is_seen_has_a_name_of_its_own(env_class: type[HikingEnv]) -> None:
    assert env_class().observation_space == gym.spaces.Box(-1.0, 1.0, (80,), dtype=np.float32)
    assert len(set(env_class.observation_names)) == 80


@pytest.mark.parametrize("action", [-1, 4, 0.5])
def test_action_out_of_range_is_refused(action: object) -> None:
    env = HikingEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="integers from 0 to 3"):
        env.step(action)  # type: ignore[arg-type]


def test_text_shows_hiker_stars_rocks_and_water() -> None:
    env = HikingEnv(n_stars=4, layout="fork", render_mode="ansi")
    env.reset(seed=0)
    text = env.render()
    assert [len(row) for row in text.splitlines()] == [10] * 8
    assert text.splitlines()[1][4] == "H"
    assert text.count("*") == 4
    env.step(WEST)
    assert env.render().splitlines()[1][3:5] == "H."


def test_picture_shows_the_state() -> None:
    assert_picture_shows_the_state(gym.make("Hiking-v0", render_mode="rgb_array"), action=EAST)


def test_window_opens_shows_and_closes() -> None:
    assert_window_opens_shows_and_closes("Hiking-v1")


@pytest.mark.parametrize(("n_stars", "layout"), [(1, "valley"), (12, "random"), (12, "spiral")])
@pytest.mark.parametrize("env_id", sorted({*ENVS} - {"Hiking-v0"}))  # Gymnasium warns of an old version
def test_environment_checkers_find_nothing(n_stars: int, layout: str, env_id: str) -> None:
    assert_checkers_are_silent(env_id, n_stars=n_stars, layout=layout)


@pytest.mark.parametrize("env_id", ENVS)
def test_long_run_of_random_actions(env_id: str) -> None:
    options = [{"n_stars": n, "layout": layout} for n, layout in ((1, "fork"), (3, "comb"), (5, "random"))]
    assert_long_run_stays_sound(env_id, 1_000_000, options)


CROSSING = """
    H...#
    .##*#
    *#~~~
"""


@pytest.mark.parametrize("env_id", ENVS)
def test_map_of_the_user_is_walked_and_stars_lie_where_they_are_marked(env_id: str) -> None:
    env = gym.make(env_id, n_stars=2, layout=CROSSING, render_mode="ansi")
    assert env.observation_space.shape == (80,)
    observation, info = env.reset(seed=0)
    assert info["variation"] == {"n_stars": 2, "layout": "H...#\n.##*#\n*#~~~"}
    assert info["optimal_steps"] == 2 + 2 + 3 + 1
    assert env.render().splitlines() == ["H...######", ".##*######", "*#~~~#####", *["##########"] * 5]
    named = dict(zip(env.unwrapped.observation_names, observation, strict=True))
    seen = named["map[2,0]"] if env_id in WHOLE_MAPS else named["window[+2,+0]"]
    assert seen == (1 / 8 if env_id == "Hiking-v1" else env.unwrapped.star_value)
    results = [env.step(action) for action in env.unwrapped.plan()]
    assert [result[2] for result in results] == [False] * 7 + [True]


def test_map_of_the_user_is_an_option_that_stays_in_force_and_may_be_given_as_rows() -> None:
    env = gym.make("Hiking-v0", n_stars=1)
    rows = ["H.", "#."]
    for options in ({"layout": rows}, None):
        _, info = env.reset(seed=0, options=options)
        assert info["variation"]["layout"] == "H.\n#."
    assert {env.reset()[1]["optimal_steps"] for _ in range(20)} == {1, 2}
    assert env.reset(options={"layout": "fork"})[1]["variation"]["layout"] == "fork"


def test_batch_takes_a_map_for_all_or_one_for_each() -> None:
    batched = gym.make_vec("Hiking-v0", num_envs=2, vectorization_mode="vector_entry_point", n_stars=1)
    for layouts in ("H.\n#.", ["H.\n#.", "comb"], [("H.", "#."), "comb"]):
        observations, infos = batched.reset(seed=3, options={"layout": layouts})
        for row, layout in enumerate([layouts] * 2 if isinstance(layouts, str) else layouts):
            observation, info = gym.make("Hiking-v0", n_stars=1, layout=layout).reset(seed=3 + row)
            np.testing.assert_array_equal(observations[row], observation)
            assert infos["variation"][row] == info["variation"]


@pytest.mark.parametrize(
    ("layout", "said"),
    [
        ("valey", "layout='valey' is not accepted; layout is one of 'valley'.* or a map as rows of text"),
        (5, "layout=5 is not accepted"),
        ({"H": "."}, "is not accepted"),
        (["H.", "."], r"layout: a map of 2 rows of lengths \[1, 2\] .* up to 8 rows of equal length, up to 10"),
        (["H."] * 9, "a map of 9 rows"),
        (["H" + "." * 10], r"lengths \[11\]"),
        (["H.x"], "'x' in row 0, column 2 of a map is not accepted; a cell is"),
        (["..", ".."], "a map with 0 starts"),
        (["H.", ".H"], "a map with 2 starts"),
        (["H#"], "no place for a star"),
        (["H.#.", "####"], "no way leads from the start to row 0, column 3 .* mark with"),
        (["H..*", "##*#", "####", "*###"], "no way leads from the start to row 1, column 2|row 3, column 0"),
        (["H.."], "n_stars=3 is not accepted; on this layout n_stars is at most 2"),
    ],
)
def test_map_that_is_not_accepted_is_refused_and_changes_nothing(layout: object, said: str) -> None:
    env = HikingEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=said):
        env.reset(options={"layout": layout})
    with pytest.raises(ValueError, match=said):
        gym.make_vec("HikingEgo-v0", num_envs=2, layout=layout)
    assert env.reset()[1]["variation"] == {"n_stars": 3, "layout": "valley"}


def test_pathways_without_stars_need_not_be_connected() -> None:
    assert HikingEnv(n_stars=1, layout=["H.*", "###", "..#"]).reset(seed=0)[1]["optimal_steps"] == 2
