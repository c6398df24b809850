"""The exported JavaScript against the interpreter, in Node."""

import json
from dataclasses import replace
from itertools import product

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import get_domain
from sb3_progpolicy import load_pretrained
from sb3_progpolicy.programs import ProgramRunner, explain, export_javascript, join_inputs
from tests.handwritten.hanoi import hanoi_program as handwritten_hanoi
from tests.handwritten.hiking import egocentric_program, map_program
from tests.handwritten.panda import PROGRAMS
from tests.handwritten.stacking import stacking_program
from tests.programs.formats import check_javascript
from tests.programs.hostile import with_hostile_texts
from tests.programs.node import run_node
from tests.programs.strategies import CELLS, KINDS, build_program, random_actions, small_program

DOMAIN_PROGRAMS = {
    "Hanoi-v0 shipped": lambda: load_pretrained("Hanoi-v0"),
    "Stacking-v0 shipped": lambda: load_pretrained("Stacking-v0"),
    "PandaReach-v0 shipped": lambda: load_pretrained("PandaReach-v0"),
    "Hanoi-v0": handwritten_hanoi,
    "Hiking-v1": map_program,
    "HikingEgo-v0": egocentric_program,
    "Stacking-v0": stacking_program,
    **PROGRAMS,
}
#: Beside a threshold that is nearer than this the last bit of tanh may decide.
NARROW = 1e-9
RUN = """
    const fs = require("fs"), path = require("path"), os = require("os");
    const folder = fs.mkdtempSync(path.join(os.tmpdir(), "policy-"));
    const results = data.map(({ source, steps }, index) => {
        const file = path.join(folder, `policy${index}.js`);
        fs.writeFileSync(file, source);
        const policy = new (require(file).ProgramPolicy)();
        return steps.map(([observation, action, reward, done, explained]) => {
            if (observation === null) { policy.reset(); return null; }
            return explained ? policy.explain(observation, action, reward, done)
                             : policy.act(observation, action, reward, done);
        });
    });
    fs.rmSync(folder, { recursive: true });
    return results;
"""


def plain(action):
    return None if action is None else np.asarray(action).tolist()


def play(program, env_id, n_steps):
    """Steps in all variations of a domain, a fifth of the actions random: what was read, what was chosen, margins."""
    domain, rng, runner = get_domain(env_id), np.random.default_rng(0), ProgramRunner(program)
    env, steps, chosen, margins = gym.make(env_id), [], [], []
    variations = (*domain.train, *domain.validation, *domain.unseen)
    per_variation, episode = -(-n_steps // len(variations)), 0
    for variation in variations:
        runner.reset()
        steps.append((None, None, 0.0, False))
        chosen.append(None)
        margins.append(np.inf)
        action, reward, ended, observation = None, 0.0, False, None
        for _ in range(per_variation):
            if observation is None or ended:
                episode += 1
                observation, _ = env.reset(seed=episode, options=dict(variation))
            steps.append((observation.tolist(), plain(action), float(reward), bool(ended)))
            given = None if action is None else np.asarray(action)[None]
            chosen.append(plain(runner.act(join_inputs(program, observation, given, reward, ended))[0]))
            margins.append(np.abs(runner.condition_values).min(initial=np.inf))
            action = chosen[-1]
            if rng.random() < 0.2:
                action = plain(random_actions(rng, program.action, 1)[0])
            action = np.float32(action) if program.action.kind == "box" else action
            observation, reward, terminated, truncated, _ = env.step(action)
            ended, reward = terminated or truncated, np.float32(reward)
    env.close()
    return steps, chosen, margins


@pytest.mark.parametrize("name", DOMAIN_PROGRAMS)
def test_exported_javascript_chooses_as_the_runner_on_ten_thousand_states(name):
    program, env_id = DOMAIN_PROGRAMS[name](), name.split()[0]
    steps, chosen, margins = play(program, env_id, 10_000)
    (actions,) = run_node(RUN, [{"source": export_javascript(program), "steps": steps}])
    assert len(actions) >= 10_000
    recurrent = any(condition.remembers for condition in program.conditions)
    for action, expected, margin in zip(actions, chosen, margins, strict=True):
        assert action == expected or (recurrent and margin < NARROW)


def random_cases():
    for seed, (cell, kind, interaction) in enumerate(product((*CELLS, "all", "none"), KINDS, (True, False))):
        cells = {"all": list(CELLS), "none": []}.get(cell, [cell, cell])
        yield build_program(seed, cells, kind, interaction, hidden_size=1 + seed % 4)


def test_exported_javascript_follows_programs_of_every_cell_and_action_kind():
    cases, expected = [], []
    for number, program in enumerate(random_cases()):
        rng, runner = np.random.default_rng(number), ProgramRunner(program)
        action, steps, explained = None, [], []
        for step in range(60):
            if step == 40:
                runner.reset()
                steps.append((None, None, 0.0, False))
                explained.append(None)
                action = None
            observation, reward, done = rng.normal(size=5), float(rng.normal()), bool(rng.integers(2))
            steps.append((observation.tolist(), plain(action), reward, done, True))
            explained.append(explain(program, observation, action, reward, done, runner))
            action = random_actions(rng, program.action, 1)[0]
        cases.append({"source": export_javascript(program), "steps": steps})
        expected.append(explained)
    for results, explained in zip(run_node(RUN, cases), expected, strict=True):
        for given, step in zip(results, explained, strict=True):
            if step is None:
                continue
            assert given["inputs"] == [value for _, value in step.inputs]
            np.testing.assert_allclose(given["conditionValues"], step.condition_values, rtol=0, atol=1e-11)
            for memory, units in zip(given["memory"], step.memory, strict=True):
                np.testing.assert_allclose(memory, units, rtol=0, atol=1e-11)
            assert given["outputs"] == [list(outputs) for outputs in step.outputs]
            assert given["branch"] == step.branch
            assert given["action"] == plain(step.action)
            contributions = [list(output.contributions) for output in step.active]
            assert given["contributions"][step.branch] == contributions


def test_no_text_of_a_program_becomes_javascript():
    rng = np.random.default_rng(0)
    cases, names = [], []
    for _ in range(60):
        hostile = with_hostile_texts(small_program(rng), rng)
        cases.append(check_javascript(hostile))
        names.append([list(hostile.input_names), list(hostile.output_names)])
    script = """
        return data.map((source) => {
            const module = { exports: {} };
            new Function("module", source)(module);
            return [module.exports.PROGRAM.inputNames, module.exports.PROGRAM.outputNames];
        });
    """
    assert run_node(script, cases) == names


def test_exported_javascript_can_be_imported_as_a_module_and_refuses_what_it_cannot_read(tmp_path):
    program = load_pretrained("Hanoi-v0")
    (tmp_path / "policy.js").write_text(export_javascript(program))
    (tmp_path / "policy.mjs").write_text(export_javascript(program))
    script = f"""
        const {{ ProgramPolicy }} = require({json.dumps(str(tmp_path / "policy.js"))});
        const message = (call) => {{ try {{ call(); return null; }} catch (error) {{ return error.message; }} }};
        const policy = new ProgramPolicy();
        return [
            message(() => policy.act([1, 2])),
            message(() => policy.act(new Array(9).fill(0), 6)),
            message(() => policy.act(new Array(9).fill(NaN))),
            message(() => policy.act(new Array(9).fill(0), 5, -0.01, true)),
        ];
    """
    assert run_node(script, None) == [
        "observation holds 2 numbers; 9 are accepted",
        "previousAction=6 is not accepted; 0 to 5 is",
        "inputs hold a number that is infinite or not a number; finite numbers are accepted",
        None,
    ]
    (tmp_path / "run.mjs").write_text(
        'import { ProgramPolicy } from "./policy.js"; import "./policy.mjs";'
        "console.log(JSON.stringify([new ProgramPolicy().act(new Array(9).fill(0)),"
        " new globalThis.ProgramPolicy().act(new Array(9).fill(0))]));"
    )
    shown = run_node(
        'return JSON.parse(require("child_process").execFileSync(process.execPath, [data]));',
        str(tmp_path / "run.mjs"),
    )
    expected = int(ProgramRunner(program).act(join_inputs(program, np.zeros(9)))[0])
    assert shown == [expected, expected]


def test_a_sum_of_constants_that_overflows_is_infinite_as_in_the_interpreter():
    program = build_program(0, ["rnn"], "discrete", False, hidden_size=1)
    condition = replace(program.conditions[0], bias_ih=(1.7e308,), bias_hh=(1.7e308,))
    program = replace(program, body=replace(program.body, condition=condition))
    steps = [([0.5] * 5, None, 0.0, False, True)]
    ((given,),) = run_node(RUN, [{"source": export_javascript(program), "steps": steps}])
    with np.errstate(over="ignore"):
        assert given["memory"] == [[1.0]] == [list(units) for units in explain(program, [0.5] * 5).memory]
