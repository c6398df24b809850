"""Symmetries of the domains: what is true of a state is true of its twin."""

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS
from progpolicy_envs.symmetry import Grid, Permutation, Symmetry, group_of

PLANNING = [domain.id for domain in DOMAINS.values() if domain.symmetries and not domain.simulation]
PANDA = [domain.id for domain in DOMAINS.values() if domain.simulation]


def twin_action(symmetry, action):
    if isinstance(action, np.ndarray):
        return symmetry.action(action)
    return symmetry.action.source.index(action)


def hanoi_twins(env, symmetry):
    """A state and the one in which every peg has its new name; a move shows the names."""
    state = env.unwrapped.state
    pegs = {}
    for action, (source, target) in enumerate(((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))):
        new = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))[twin_action(symmetry, action)]
        pegs[source], pegs[target] = new
    renamed = {name: pegs[state[name]] for name in ("source", "target")}
    return {**state, **renamed, "discs": [pegs[peg] for peg in state["discs"]]}


def turn(symmetry):
    """Where north and east point to after a symmetry of the compass, as a matrix on (row, column)."""
    directions = ((-1, 0), (0, 1), (1, 0), (0, -1))
    north, east = (directions[twin_action(symmetry, action)] for action in (0, 1))
    return np.array([[-north[0], east[0]], [-north[1], east[1]]])


def stacking_twins(env, symmetry):
    matrix = turn(symmetry)
    state = env.unwrapped.state
    return {
        **state,
        "plates": [(matrix @ (np.array(plate) - 2) + 2).tolist() for plate in state["plates"]],
        "gripper": (matrix @ (np.array(state["gripper"]) - 2) + 2).tolist(),
    }


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize(("env_id", "twin", "options"), [
    ("Hanoi-v0", hanoi_twins, {"n_discs": 4, "source": "random", "target": "random"}),
    ("Stacking-v0", stacking_twins, {"n_plates": 3}),
])  # fmt: skip
def test_twins_stay_twins(env_id, twin, options, seed):
    env, other = gym.make(env_id), gym.make(env_id)
    rng = np.random.default_rng(seed)
    group = group_of(DOMAINS[env_id].symmetries)
    symmetry = group[1 + seed % (len(group) - 1)]
    observation, _ = env.reset(seed=seed, options=options)
    other.reset(seed=0, options={"n_discs": 4} if env_id == "Hanoi-v0" else options)
    seen = other.unwrapped.set_state(twin(env, symmetry))
    for _ in range(30):
        np.testing.assert_array_equal(symmetry.observation(observation), seen)
        action = int(rng.integers(env.action_space.n))
        observation, *outcome = env.step(action)
        seen, *others = other.step(twin_action(symmetry, action))
        assert outcome == others
        if outcome[1]:
            break


@pytest.mark.parametrize("seed", range(8))
def test_a_map_that_is_turned_is_walked_alike(seed):
    rng = np.random.default_rng(seed)
    rows = rng.choice(list(".#"), (8, 8), p=[0.7, 0.3])
    rows[3, 3], rows[3, 4] = "H", "*"
    (quarter,) = DOMAINS["HikingEgo-v0"].symmetries
    against_the_clock = 1 if twin_action(quarter, 0) == 3 else -1  # from north to west
    maps = [["".join(row) for row in grid] for grid in (rows, np.rot90(rows, against_the_clock))]
    envs = [gym.make("HikingEgo-v0", layout=grid, n_stars=1) for grid in maps]
    observation, seen = (env.reset()[0] for env in envs)
    for _ in range(40):
        np.testing.assert_array_equal(quarter.observation(observation), seen)
        action = int(rng.integers(4))
        observation, *outcome = envs[0].step(action)
        seen, *others = envs[1].step(twin_action(quarter, action))
        assert outcome == others
        if outcome[1]:
            break


@pytest.mark.parametrize("env_id", PANDA)
def test_arm_and_its_mirror_image_move_alike(env_id):
    (mirror,) = DOMAINS[env_id].symmetries
    env, other = gym.make(env_id), gym.make(env_id)
    env.reset(seed=3)
    start = env.unwrapped.start
    mirrored = {
        name: [[place[0], -place[1], *place[2:]] for place in places]
        for name, places in start.items()
        if isinstance(places, list)
    }
    observation, _ = env.reset(seed=3, options=start)
    seen, _ = other.reset(seed=3, options={**start, **mirrored})
    rng = np.random.default_rng(0)
    for _ in range(15):
        # The arm's seven joints are not quite symmetric, which velocities show.
        differences = np.abs(mirror.observation(observation) - seen)
        assert differences.max() < 0.15
        assert differences[[not name[:-1].endswith("_v") for name in env.unwrapped.observation_names]].max() < 0.02
        action = rng.uniform(-1, 1, 4).astype(np.float32)
        observation = env.step(action)[0]
        seen = other.step(twin_action(mirror, action))[0]
    assert np.abs(observation - seen).max() > 0.01, "it does move to the side"
    env.close()
    other.close()


@pytest.mark.parametrize(
    ("env_id", "size"), [("Hanoi-v0", 6), ("Stacking-v0", 8), ("HikingEgo-v0", 4), ("PandaPush-v0", 2)]
)
def test_groups_have_the_known_sizes(env_id, size):
    group = group_of(DOMAINS[env_id].symmetries)
    assert len(group) == size
    numbers = np.random.default_rng(0).normal(size=len(group[0].observation.source))
    np.testing.assert_array_equal(group[0].observation(numbers), numbers)
    for one in group:
        for other in group:
            np.testing.assert_array_equal(
                one.after(other).observation(numbers), one.observation(other.observation(numbers))
            )


def test_domains_without_symmetries_have_no_group():
    assert DOMAINS["Hiking-v0"].symmetries == ()
    assert group_of(()) == ()


@pytest.mark.parametrize(
    "domain", [domain for domain in DOMAINS.values() if domain.grids], ids=lambda domain: domain.id
)
def test_grids_lie_where_the_names_say(domain):
    names = gym.make(domain.id).unwrapped.observation_names
    for grid in domain.grids:
        places = [name.removeprefix(f"{grid.name}[").removesuffix("]").split(",")
                  for name in names[grid.start : grid.start + len(grid.rows)]]  # fmt: skip
        found = np.array(places, dtype=float)
        found -= (found.max(0) + found.min(0)) / 2
        np.testing.assert_array_equal(found.T, [grid.rows, grid.columns])


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Permutation.of([0, 0]), "each of its indices comes once"),
    (lambda: Permutation.of([0, 1], [1, 2]), "2 times 1 or -1"),
    (lambda: Grid("map", 0, (1.0,), ()), "1 rows and 0 columns"),
])  # fmt: skip
def test_arguments_are_checked(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_signs_and_places_go_together():
    permutation = Permutation.of([1, 0, 2], [-1, 1, 1])
    assert permutation(np.array([5.0, 7.0, 9.0])).tolist() == [-7.0, 5.0, 9.0]
    symmetry = Symmetry("x", permutation, Permutation.of([0]))
    assert len(group_of([symmetry])) == 4
