"""The planning environments in JavaScript against those in Python, state by state."""

import json
from importlib.resources import files

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs.layouts import LAYOUTS, N_COLUMNS, random_layout
from sb3_progpolicy.pages.episodes import WORLDS
from tests.programs.node import run_node

N_STATES = 4_000
WORLDS_FILE = str(files("sb3_progpolicy.pages") / "js" / "worlds.js")
STEP = """
    const { WORLDS } = require(FILE);
    return data.map(([id, state, action]) => {
        const world = new WORLDS[id](state);
        const before = world.observe();
        const { reward, done } = world.step(action);
        return { before, reward, done, after: world.observe(), state: world.state, solved: world.isSolved() };
    });
"""


def hanoi_state(rng):
    source, target = rng.permutation(3)[:2].tolist()
    n_discs = int(rng.integers(1, 13))
    discs = rng.integers(3, size=n_discs)
    if rng.random() < 0.3:  # one move from the goal, or near it
        discs[:] = target
        discs[0] = rng.integers(3)
    return {"n_discs": n_discs, "source": source, "target": target, "discs": discs.tolist()}


def stacking_state(rng):
    n_plates = int(rng.integers(1, 9))
    cells = rng.permutation(25)[: rng.integers(1, n_plates + 1)]
    gripper = cells[0] if rng.random() < 0.4 else rng.integers(25)
    plates = [list(divmod(int(cell), 5)) for cell in cells]
    return {"n_plates": n_plates, "plates": plates, "gripper": list(divmod(int(gripper), 5))}


def hiking_state(rng):
    named = list(LAYOUTS.values())
    layout = named[rng.integers(len(named))] if rng.random() < 0.5 else random_layout(int(rng.integers(1024)))
    reached = np.flatnonzero(layout.distances[layout.start] >= 0)
    n_stars = int(rng.integers(1, min(12, len(reached) - 1) + 1))
    hiker, *stars = rng.permutation(reached)[: 1 + n_stars].tolist()
    if rng.random() < 0.5:  # a star beside the hiker
        near = [cell for cell in stars if layout.distances[hiker, cell] == 1]
        stars = near[:1] or stars
    places = [list(divmod(cell, N_COLUMNS)) for cell in stars]
    rows = "\n".join(layout.rows)
    return {"n_stars": n_stars, "layout": rows, "hiker": list(divmod(hiker, N_COLUMNS)), "stars": places}


STATES = {
    "Hanoi-v0": hanoi_state,
    "Stacking-v0": stacking_state,
    "Hiking-v1": hiking_state,
    "Hiking-v0": hiking_state,
    "HikingEgo-v0": hiking_state,
}


def as_set(state):
    """A state without its map, which no step changes, and with its stars in no order."""
    return {name: sorted(value) if name == "stars" else value for name, value in state.items() if name != "layout"}


def test_every_planning_environment_has_a_world():
    assert set(STATES) == set(WORLDS)


@pytest.mark.parametrize("env_id", STATES)
def test_a_world_observes_steps_rewards_and_ends_as_the_environment(env_id):
    rng, env = np.random.default_rng(0), gym.make(env_id).unwrapped
    env.reset(seed=0)
    cases, expected = [], []
    for _ in range(N_STATES):
        state, action = STATES[env_id](rng), int(rng.integers(env.action_space.n))
        before = env.set_state(state)
        after, reward, done, _, info = env.step(action)
        cases.append([env_id, state, action])
        expected.append((before.tolist(), reward, done, after.tolist(), env.state, info["is_success"]))
    results = run_node(STEP.replace("FILE", json.dumps(WORLDS_FILE)), cases)
    dones = 0
    for result, (before, reward, done, after, state, solved) in zip(results, expected, strict=True):
        assert result["before"] == before
        assert result["after"] == after
        assert (result["reward"], result["done"], result["solved"]) == (reward, done, solved)
        assert as_set(result["state"]) == as_set(state)
        dones += done
    assert 0 < dones < N_STATES
