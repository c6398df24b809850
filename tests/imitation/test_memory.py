"""Programs that remember what their teacher remembers."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_progpolicy import evaluate_program, imitate
from sb3_progpolicy.imitation import algorithm, memory, recurrent
from sb3_progpolicy.imitation.judge import Judge
from sb3_progpolicy.imitation.learner import Settings
from sb3_progpolicy.imitation.losses import DiscreteLoss
from sb3_progpolicy.imitation.recurrent import Sequences, fit_sequences, map_numbers, rounded_body
from sb3_progpolicy.imitation.rollouts import Pool, ProgramAct, play
from sb3_progpolicy.imitation.teachers import make_teacher
from sb3_progpolicy.programs import Program, ProgramRunner

FORWARD, LEFT, RIGHT = 0, 1, 2


class TMaze(gym.Env):
    """The first observation says on which side the goal will be, at the end of a corridor (Bakker 2002)."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(3)
    observation_names = ("side", "junction")
    action_names = ("forward", "left", "right")
    length = 4

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.side = 0, int(self.np_random.integers(2))
        return self._observation(), {}

    def _observation(self):
        shown = (1 - 2 * self.side) if self.place == 0 else 0
        return np.array([shown, self.place == self.length], np.float32)

    def step(self, action):
        ended = self.place == self.length and action != FORWARD
        success = ended and action == (LEFT, RIGHT)[self.side]
        self.place += int(action == FORWARD and self.place < self.length)
        return self._observation(), float(success), ended, False, {"is_success": bool(success)}

    def plan(self):
        return [FORWARD] * (self.length - self.place) + [(LEFT, RIGHT)[self.side]]


@pytest.fixture(scope="module", autouse=True)
def maze():
    gym.register("TMaze-v0", entry_point=TMaze, max_episode_steps=20)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(algorithm, "Settings", partial(Settings, round_steps=20, final_steps=50))
        patch.setattr(memory, "_N_STEPS", 200)
        patch.setattr(recurrent, "_RESTARTS", 3)
        yield
    gym.registry.pop("TMaze-v0")


SMALL = {"n_timesteps": 600, "n_envs": 8, "n_episodes": 24}


@pytest.fixture(scope="module")
def seen():
    return []


@pytest.fixture(scope="module")
def remembering(maze, seen):
    return imitate("planner", "TMaze-v0", cell="gru", max_conditions=1, callback=seen.append, **SMALL)


def success_rate(program):
    (row,) = evaluate_program(program, "TMaze-v0", n_episodes=60, seed=3)
    return row.success_rate


def test_program_with_one_unit_remembers_the_side_over_episodes(remembering, tmp_path):
    assert success_rate(remembering) == 1
    assert [condition.cell for condition in remembering.conditions] == ["gru"]
    assert remembering.conditions[0].hidden_size == 1
    assert remembering.metadata["learned_by"] == "imitation"
    remembering.save(tmp_path / "program.json")
    assert Program.load(tmp_path / "program.json") == remembering


def test_program_without_memory_cannot(maze):
    assert success_rate(imitate("planner", "TMaze-v0", max_conditions=2, **SMALL)) < 0.8


def test_same_seed_gives_the_same_fit():
    rng = np.random.default_rng(0)
    data = Sequences(rng.normal(size=(6, 3, 2)), np.eye(2)[rng.integers(2, size=(6, 3))], np.ones((6, 3)))
    fits = [fit_sequences(DiscreteLoss(), data, np.ones(2, bool), 2, 5, seed=4, n_steps=5) for _ in range(2)]
    assert fits[0] == fits[1]


def test_episodes_of_a_validation_begin_without_memory(remembering):
    pool = Pool("TMaze-v0", 4)
    act = ProgramAct(remembering, 4)
    first, second = (play(pool, [{}], 4, 9, act) for _ in range(2))
    np.testing.assert_array_equal(first.returns, second.returns)
    act(np.ones((4, 2)))
    act.begin()
    np.testing.assert_array_equal(act(np.zeros((4, 2))), ProgramRunner(remembering, 4).act(np.zeros((4, 2))))


def test_rounding_changes_numbers_and_nothing_else(remembering):
    assert map_numbers(remembering.body, lambda numbers: numbers, lambda output: output) == remembering.body
    condition = rounded_body(remembering.body, 1).condition
    for old, new in zip(remembering.body.condition.bias_hh, condition.bias_hh, strict=True):
        assert new == float(f"{old:.0e}")
    assert condition.cell == "gru"


def test_result_is_that_of_the_best_program(remembering, seen):
    with Pool("TMaze-v0", 8) as pool:
        judge = Judge(pool, [{}], 24, 0.015, make_teacher("planner", pool.envs[0]))
        judge.patience = None
        for so_far in seen:
            judge.score(ProgramAct(so_far.program, 8))
            assert so_far.result == judge.last_result


@pytest.mark.parametrize(
    "arguments",
    [{"cell": "lstm"}, {"cell": "gru", "augment": lambda seen, rng: seen}, {"cell": "gru", "max_conditions": 0}],
)
def test_what_cannot_remember_is_refused(arguments, tmp_path):
    with pytest.raises(ValueError, match="is not accepted"):
        imitate("planner", "TMaze-v0", **arguments)
    with pytest.raises(ValueError, match="is not kept"):
        imitate("planner", "TMaze-v0", cell="gru", checkpoint=tmp_path / "state.npz")
