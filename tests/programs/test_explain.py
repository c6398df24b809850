import numpy as np
import pytest
from hypothesis import given, settings

from sb3_progpolicy.programs import ProgramRunner, explain, join_inputs
from tests.programs.strategies import build_program, programs, random_actions, seeds


@given(program=programs, seed=seeds)
@settings(max_examples=50, deadline=None)
def test_the_terms_of_an_explanation_sum_to_the_outputs_from_which_the_action_is_chosen(program, seed):
    rng, runner, plain = np.random.default_rng(seed), ProgramRunner(program), ProgramRunner(program)
    action = None
    for _ in range(5):
        observation, reward, done = rng.normal(size=program.n_observations), float(rng.normal()), bool(rng.integers(2))
        step = explain(program, observation, action, reward, done, runner)
        before = None if action is None else np.asarray(action)[None]
        expected = plain.act(join_inputs(program, observation, before, reward, done))[0]
        np.testing.assert_array_equal(step.action, expected)
        assert step.condition_values == tuple(plain.condition_values[0])
        assert step.branch == plain.branch[0]
        assert step.mixture_weights is None
        assert [name for name, _ in step.inputs] == list(program.input_names)
        for output, value in zip(step.active, step.outputs[step.branch], strict=True):
            total = output.constant
            for contribution in output.contributions:
                total += contribution
            assert total == output.value == value
        action = random_actions(rng, program.action, 1)[0]


def test_the_memory_of_an_explanation_is_what_the_conditions_read():
    program = build_program(1, ["affine", "gru"], "discrete", True, hidden_size=3)
    step = explain(program, np.ones(5))
    outer = program.conditions[0]
    assert [len(units) for units in step.memory] == [3, 0]
    assert step.condition_values[0] == pytest.approx(outer.readout_bias + np.dot(outer.readout, step.memory[0]))


def test_the_runner_of_an_explanation_remembers_and_without_one_nothing_does():
    program = build_program(2, ["lstm"], "box", True)
    runner = ProgramRunner(program)
    first, second = (explain(program, np.ones(5), runner=runner) for _ in range(2))
    assert first.memory != second.memory
    assert explain(program, np.ones(5)).memory == first.memory


def test_soft_explanations_have_mixture_weights():
    program = build_program(3, ["gru", "rnn"], "discrete", False)
    step = explain(program, np.ones(5), runner=ProgramRunner(program, semantics="soft"))
    assert len(step.mixture_weights) == 3
    assert sum(step.mixture_weights) == pytest.approx(1)


def test_a_runner_of_another_program_or_of_several_environments_is_refused():
    program, other = (build_program(seed, ["gru"], "discrete", False) for seed in (4, 5))
    with pytest.raises(ValueError, match="another program"):
        explain(program, np.ones(5), runner=ProgramRunner(other))
    with pytest.raises(ValueError, match="2 environments"):
        explain(program, np.ones(5), runner=ProgramRunner(program, 2))
