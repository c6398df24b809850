"""The C header, compiled without a warning, against the interpreter."""

import ctypes
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from sb3_progpolicy import load_pretrained, pretrained_names
from sb3_progpolicy.programs import ActionSpec, Controller, ProgramRunner, export_c, join_inputs
from tests.programs.formats import c_code, check_c
from tests.programs.hostile import TITLES, with_hostile_texts, with_plain_texts
from tests.programs.strategies import CELLS, KINDS, build_program, random_actions, small_program
from tests.programs.test_hostile import LARGEST, with_all_pieces

COMPILER = shutil.which("gcc") or shutil.which("cc")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler is installed")
# A first step, then steps in which the previous action is given or is what the last call wrote.
PLAY = """
#include <stddef.h>
#include "program.h"
int play(int n, int n_observations, int n_actions, const double *observations, const TYPE *previous,
    const double *rewards, const double *dones, TYPE *actions)
{
    PREFIX_state state;
    PREFIX_reset(&state);
    for (int k = 0; k < n; k++) {
        const TYPE *before = k ? previous + (k - 1) * n_actions : NULL;
        const double *observation = observations + k * n_observations;
        if (PREFIX_act(&state, observation, before, rewards[k], dones[k], actions + k * n_actions)) return k + 1;
    }
    return 0;
}
int repeat(int n, const double *observation, TYPE *action)
{
    PREFIX_state state;
    PREFIX_reset(&state);
    if (PREFIX_act(&state, observation, NULL, 0.0, 0.0, action)) return -1;
    for (int k = 1; k < n; k++)
        if (PREFIX_act(&state, observation, action, 0.5, 0.0, action)) return -1;
    return 0;
}
"""


def compiled(program, folder, flags=(*FLAGS, "-O2")):
    """The library that plays the program's header."""
    export_c(program, folder / "program.h")
    prefix = re.search(r"(\w+)_state;", (folder / "program.h").read_text())[1]
    kind = "double" if program.action.kind == "box" else "long long"
    (folder / "play.c").write_text(PLAY.replace("PREFIX", prefix).replace("TYPE", kind))
    library = f"play_{len(list(folder.glob('*.so')))}.so"  # one of the same name would not be loaded again
    command = [COMPILER, *flags, "-shared", "-fPIC", "-o", library, "play.c", "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(folder / library))


def array(values, kind=np.float64):
    values = np.ascontiguousarray(values, dtype=kind)
    return values, values.ctypes.data_as(ctypes.c_void_p)


def check_actions(program, folder, n_steps, seed=0, **options):
    """The header's actions are the interpreter's in one long game with random previous actions, rewards and flags."""
    rng = np.random.default_rng(seed)
    observations = rng.normal(size=(n_steps, program.n_observations))
    previous = random_actions(rng, program.action, n_steps)
    rewards, dones = rng.normal(size=n_steps), rng.integers(2, size=n_steps).astype(float)
    runner, expected, branches = ProgramRunner(program), [], set()
    for step in range(n_steps):
        before = previous[step - 1 : step] if step else None
        inputs = join_inputs(program, observations[step], before, rewards[step], dones[step])
        expected.append(runner.act(inputs)[0])
        branches.add(int(runner.branch[0]))
    kind = np.float64 if program.action.kind == "box" else np.int64
    n_actions = np.size(expected[0])
    actions, pointer = array(np.zeros((n_steps, n_actions)), kind)
    columns = [array(observations), array(previous, kind), array(rewards), array(dones)]
    library = compiled(program, folder, **options)
    sizes = n_steps, program.n_observations, n_actions
    assert library.play(*map(ctypes.c_int, sizes), *(address for _, address in columns), pointer) == 0
    expected = np.array(expected).reshape(n_steps, n_actions)
    np.testing.assert_array_equal(actions.astype(expected.dtype), expected)
    return branches


@needs_compiler
@pytest.mark.parametrize("interaction", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_header_takes_the_same_actions_as_the_runner(kind, interaction, tmp_path):
    branches = set()
    for seed in range(len(CELLS)):
        program = build_program(seed, [*CELLS[seed:], *CELLS[:seed]], kind, interaction, hidden_size=seed + 1)
        branches |= check_actions(program, tmp_path, 1_000, seed)
    assert len(branches) > 3


@needs_compiler
@pytest.mark.parametrize("cell", CELLS)
def test_header_follows_a_long_game_of_every_cell(cell, tmp_path):
    check_actions(build_program(7, [cell, cell], "box", True), tmp_path, 3_000)


@needs_compiler
@pytest.mark.parametrize("name", pretrained_names())
def test_header_of_a_shipped_program_takes_the_same_actions(name, tmp_path):
    check_actions(load_pretrained(name), tmp_path, 2_000)


@needs_compiler
def test_header_of_one_controller_without_inputs_compiles(tmp_path):
    program = build_program(0, [], "discrete", False, n_observations=0)
    assert check_actions(program, tmp_path, 3) == {0}


@needs_compiler
def test_compiler_that_may_join_a_product_and_a_sum_does_not(tmp_path):
    flags = ("-std=gnu99", "-O3", "-mfma", "-ffp-contract=fast", "-Wall", "-Wextra", "-Werror")
    if subprocess.run([COMPILER, "-mfma", "-E", "-xc", "-"], input="", capture_output=True, text=True).returncode:
        pytest.skip("this machine has no instruction for a * b + c")
    program = build_program(1, ["gru", "affine"], "box", True, n_observations=20)
    compiled(program, tmp_path, flags)
    assembly = subprocess.run(
        [COMPILER, *flags, "-S", "-o", "-", "play.c"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "fmadd" not in assembly.stdout


@needs_compiler
def test_sums_in_another_order_are_refused(tmp_path):
    with pytest.raises(AssertionError, match="compile without -ffast-math"):
        compiled(build_program(0, [], "box", False), tmp_path, ("-ffast-math",))


@needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_action_may_be_written_over_the_previous_one(kind, tmp_path):
    program = build_program(4, ["gru"], kind, True)
    library, runner, action = compiled(program, tmp_path), ProgramRunner(program), None
    for step in range(30):
        inputs = join_inputs(program, [0.5] * 5, action, 0.5 if step else 0.0, False)
        action = runner.act(inputs)
    written, pointer = array(np.zeros(np.size(action)), np.float64 if kind == "box" else np.int64)
    assert library.repeat(30, array([0.5] * 5)[1], pointer) == 0
    if kind == "box":
        np.testing.assert_allclose(written, action[0], rtol=1e-5)  # the runner was given its actions as float32
    else:
        np.testing.assert_array_equal(written, np.ravel(action))


@needs_compiler
def test_previous_action_beyond_the_space_is_refused(tmp_path):
    program = build_program(0, [], "discrete", True)
    program = replace(program, action=replace(program.action, start=-2))
    n, library = program.action.n_outputs, compiled(program, tmp_path)
    numbers = [array(np.zeros((2, size)))[1] for size in (5, 1, 1)]
    for given, refused in ((-2, 0), (n - 3, 0), (-3, 2), (n - 2, 2)):
        _, pointer = array(np.zeros(2), np.int64)
        observations, *rest = numbers
        assert library.play(2, 5, 1, observations, array([given, 0], np.int64)[1], *rest, pointer) == refused


@needs_compiler
def test_first_of_equal_scores_is_taken_and_no_weight_of_zero_is_written(tmp_path):
    program = build_program(0, [], "discrete", False, n_observations=3)
    controller = Controller(((0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)), (0.0, 0.0, 0.0))
    program = replace(program, body=controller, action=ActionSpec("discrete", (3,), start=2**31 - 1))
    program = replace(program, output_names=("left", "stay", "right"))
    assert check_actions(program, tmp_path, 100) == {0}
    sums = re.findall(r"y\[\d\] = .*", export_c(program))
    assert sums == ["y[0] = x[1]; /* left */", "y[1] = -x[1]; /* stay */", "y[2] = x[1]; /* right */"]


@needs_compiler
def test_condition_that_is_exactly_zero_holds(tmp_path):
    program = build_program(1, ["affine", "affine"], "discrete", False)
    condition = replace(program.conditions[0], readout=(0.0,) * 5, readout_bias=0.0)
    assert check_actions(replace(program, body=replace(program.body, condition=condition)), tmp_path, 50) == {0}


@needs_compiler
@pytest.mark.filterwarnings("ignore:overflow encountered in add")
def test_infinite_sum_of_two_constants_compiles(tmp_path):
    program = build_program(0, ["rnn"], "discrete", False, hidden_size=1)
    for sign in (1, -1):
        condition = replace(program.conditions[0], bias_ih=(sign * 1.7e308,), bias_hh=(sign * 1.7e308,))
        check_actions(replace(program, body=replace(program.body, condition=condition)), tmp_path, 20)


# Texts


def test_no_text_of_a_program_becomes_code():
    rng = np.random.default_rng(0)
    for _ in range(100):
        program = small_program(rng)
        for _ in range(10):
            check_c(with_hostile_texts(program, rng))


@pytest.mark.parametrize("title", [*TITLES, "*/ int main(void) { return 1; } /*", "int", "9", "??/", "my_envs:Pong-v5"])
def test_functions_have_the_name_of_the_environment_as_far_as_c_can_have_it(title):
    program = replace(build_program(0, [], "box", False), metadata={"env": title})
    expected = c_code(export_c(with_plain_texts(program)))
    assert c_code(export_c(program)) == expected
    if title == "my_envs:Pong-v5":
        assert "static inline void pong_v5_reset(pong_v5_state *state)" in export_c(program)


@needs_compiler
def test_header_with_every_hostile_piece_compiles_without_a_warning(tmp_path):
    program = with_all_pieces()
    names = ("*/", "/*", "*//*/", "??/", "???/", "\\", "// x \\", "*" * 100, "/" * 100, *program.input_names[9:])
    program = replace(program, input_names=names, metadata={"env": "*/ #error ??/"})
    check_actions(program, tmp_path, 100)
    compiled(program, tmp_path, (*FLAGS, "-trigraphs"))


@needs_compiler
@pytest.mark.parametrize("n_observations", [300, 4_000])
def test_long_sums_become_loops_that_add_in_the_same_order(n_observations, tmp_path):
    program = build_program(0, ["affine", "gru"], "box", True, n_observations, hidden_size=1)
    assert "static const" in export_c(program)
    check_actions(program, tmp_path, 100)
    controller, dense = program.controllers[-1], [0.1 + k for k in range(program.n_inputs)]
    weights = (tuple(dense),) * len(controller.weights)
    check_actions(replace(program, body=replace(controller, weights=weights)), tmp_path, 100)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("shape", LARGEST)
def test_header_of_a_largest_program_compiles(shape, tmp_path):
    compiled(LARGEST[shape], tmp_path, ("-std=c99", "-O0"))
