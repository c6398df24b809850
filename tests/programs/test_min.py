"""Conditions that are the least of several sums: they hold where all of them are not below 0."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.analysis.activity import _label
from sb3_progpolicy.analysis.finetune import why_not
from sb3_progpolicy.interaction import program_names
from sb3_progpolicy.programs import (
    ActionSpec,
    Condition,
    Controller,
    IfThenElse,
    Program,
    ProgramRunner,
    check_program,
    export_graphviz,
    export_latex,
    export_python,
    export_text,
    plot_program,
)
from sb3_progpolicy.programs.export.visitor import Decimals
from sb3_progpolicy.programs.transform import fold_normalization

NEAR_AND_LOW = Condition("min", ((-1.0, 0.0), (0.0, -2.0)), (), (0.5, 1.0), (), (), 0.0)


def grip(condition=NEAR_AND_LOW):
    """Close the hand where it is near and low, else go on."""
    stay, go = Controller(((0.0, 0.0),), (0.0,)), Controller(((1.0, 0.0),), (0.0,))
    action = ActionSpec("box", (1,), (-1.0,), (1.0,))
    return Program(IfThenElse(condition, stay, go), 2, action, False, ("distance", "height"), ("move",))


def test_min_holds_where_all_of_its_sums_do():
    runner = ProgramRunner(grip(), 4)
    runner.act([[0.5, 0.5], [0.6, 0.0], [0.0, 0.6], [0.0, 0.0]])
    np.testing.assert_allclose(runner.condition_values[:, 0], [0.0, -0.1, -0.2, 0.5])
    assert runner.branch.tolist() == [0, 1, 1, 0]
    assert runner.memory[0].shape == (4, 0)
    assert not NEAR_AND_LOW.remembers


def test_min_is_printed_as_what_it_is():
    text = export_text(grip())
    assert "if B1 = min(0.50 - distance, 1 - 2*height) >= 0:" in text
    assert "A min is the least of its sums: it holds where none of them is below 0." in text
    assert "All memory" not in text
    assert "if 0.5 - distance >= 0 and 1 - 2 * height >= 0:" in export_python(grip())
    assert "B1 is the least of" in export_graphviz(grip())
    assert r"\min" in export_latex(grip())
    written = [text.get_text() for text in plot_program(grip()).texts]
    assert "B1 is the least of" in written


def test_long_min_breaks_between_its_sums():
    names = tuple(f"a_rather_long_name_of_input_{index}" for index in range(2))
    three = Condition("min", ((1.0, -3.5),) * 3, (), (0.25,) * 3, (), (), 0.0)
    lines = export_text(replace(grip(three), input_names=names)).splitlines()
    first = lines.index("if B1 = min(0.25 - 3.50*a_rather_long_name_of_input_1 + a_rather_long_name_of_input_0,")
    assert lines[first + 1].strip() == lines[first].removeprefix("if B1 = min(")
    assert lines[first + 2].endswith("a_rather_long_name_of_input_0) >= 0:")
    assert max(map(len, lines[first:])) <= 100


def test_python_of_a_long_min_runs():
    names = tuple(f"a_rather_long_name_of_input_{index}" for index in range(2))
    many = Condition("min", ((1.0, -3.5),) * 2 + ((-1.0, 0.25),), (), (0.25,) * 3, (), (), 0.0)
    program = replace(grip(many), input_names=names)
    space = {}
    exec(compile(export_python(program), "program.py", "exec"), space)
    policy, runner = space["ProgramPolicy"](), ProgramRunner(program)
    for inputs in np.random.default_rng(0).uniform(-1, 1, (50, 2)):
        assert policy.act(inputs.tolist()) == pytest.approx(runner.act(inputs[None])[0])


def test_what_is_not_a_number_holds_nowhere():
    far = Condition("min", ((1.0,) * 7, (1e308, -1e308, *(0.0,) * 5)), (), (0.0, 1.0), (), (), 0.0)
    names = tuple(f"x{index}" for index in range(7))
    still, go = Controller(((0.0,) * 7,), (0.0,)), Controller(((1.0,) * 7,), (0.0,))
    body = IfThenElse(far, still, go)
    program = replace(grip(), body=body, n_observations=7, input_names=names)
    observation, space = [10.0, 10.0, *[0.0] * 5], {}
    with np.errstate(invalid="ignore", over="ignore"):
        assert ProgramRunner(program).act([observation]) == 1.0
    exec(compile(export_python(program), "program.py", "exec"), space)
    assert space["ProgramPolicy"]().act(observation) == [1.0]


def test_normalisation_is_folded_into_every_sum():
    mean, scale = np.array([0.5, -1.0]), np.array([2.0, 0.1])
    folded, inputs = fold_normalization(grip(), mean, scale), np.random.default_rng(0).normal(size=(20, 2))
    runners = ProgramRunner(folded, 20), ProgramRunner(grip(), 20)
    runners[0].act(inputs)
    runners[1].act((inputs - mean) * scale)
    np.testing.assert_allclose(runners[0].condition_values, runners[1].condition_values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bias_ih": (), "weight_ih": ()}, r"bias_ih: 0 numbers given; for 'min' a tuple of at least 1 is accepted"),
        ({"weight_ih": ((1.0, 0.0),)}, r"weight_ih: 1 rows given; a tuple of 2 rows is accepted"),
        ({"weight_ih": ((1.0,), (0.0,))}, r"weight_ih\[0\]: 1 numbers given; a tuple of 2 numbers"),
        ({"readout": (1.0, 1.0)}, r"readout: 2 numbers given; a tuple of 0 numbers"),
        ({"bias_ih": [0.5, 1.0]}, r"bias_ih: 2 numbers given; for 'min' a tuple"),
        ({"readout_bias": False}, r"readout_bias: False is not accepted; finite numbers are"),
        ({"readout_bias": 1.0}, r"readout_bias=1.0 is not accepted; of 'min' it is 0"),
        ({"bias_hh": (0.0,)}, r"bias_hh: 1 numbers given"),
    ],
)
def test_malformed_min_is_an_error(change, message):
    with pytest.raises(ValueError, match=message):
        check_program(grip(replace(NEAR_AND_LOW, **change)))


class All(gym.Env):
    """Every episode is one step long; the right action says whether all three numbers are above -0.4."""

    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seen = self.np_random.uniform(-1, 1, size=3).astype(np.float32)
        return self.seen, {}

    def step(self, action):
        right = bool((self.seen > -0.4).all() == action)
        return self.reset()[0], float(right), True, False, {"is_success": right}


def test_min_is_trained_by_gradient():
    yes, no = (Controller(((0.0,) * 3,) * 2, scores) for scores in ((-1.0, 1.0), (1.0, -1.0)))
    too_strict = Condition("min", tuple(map(tuple, np.eye(3).tolist())), (), (-0.1,) * 3, (), (), 0.0)
    env = VecMonitor(DummyVecEnv([All] * 16))
    names = program_names(env)
    start = Program(IfThenElse(too_strict, yes, no), 3, ActionSpec("discrete", (2,)), False, *names)
    arguments = {"n_epochs": 10, "batch_size": 512, "n_steps": 32, "policy_kwargs": {"temperature": 0.1}}
    model = ReptilePPO("PRLPolicy", env, seed=0, interaction_history=False, init_program=start, **arguments)
    seen = np.random.default_rng(0).uniform(-1, 1, (2000, 3)).astype(np.float32)

    def right(program):
        return (ProgramRunner(program, 2000).act(seen) == (seen > -0.4).all(axis=1)).mean()

    assert right(start) < 0.8
    assert right(model.learn(10_000).program()) > 0.95


def test_sums_that_training_starts_from_come_back_and_a_smaller_min_stays_smaller():
    names, rows = ("cos angle", "sin angle", "velocity"), ((1.0, 0.0, 0.5), (0.0, -1.0, 0.25), (0.5, 0.5, 0.0))
    three, one = (
        Condition("min", rows, (), (0.5, 0.25, 1.0), (), (), 0.0),
        Condition("affine", (), (), (), (), rows[0], 0.5),
    )
    controllers = [Controller((row,), (0.25,)) for row in rows]
    body = IfThenElse(three, controllers[0], IfThenElse(one, controllers[1], controllers[2]))
    program = Program(body, 3, ActionSpec("box", (1,), (-2.0,), (2.0,)), False, names, ("torque",))
    model = ReptilePPO("PRLPolicy", "Pendulum-v1", n_envs=4, interaction_history=False, init_program=program, seed=0)
    assert model.program().body == program.body
    learned = model.learn(512).program()
    assert [len(condition.sums) for condition in learned.conditions] == [3, 1]
    assert learned.body != program.body


def test_growth_divides_no_branch_by_a_min():
    with pytest.raises(ValueError, match="growth' is not accepted with conditions of several sums"):
        ReptilePPO("PRLPolicy", "CartPole-v1", n_envs=2, search_method="growth", policy_kwargs={"cell": "min"}).learn(
            64
        )


def test_picture_of_an_episode_and_simplification_say_what_a_min_is():
    number = Decimals(2)
    assert _label(NEAR_AND_LOW, 0, number, grip()) == "B1 = min(0.50 - distance, 1 - 2*height) >= 0"
    assert why_not(grip()) is None
