"""What release 0.1 saved and called by another name."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_progpolicy import InteractionHistory, ReptilePPO, load_pretrained, make_fast_vec_env
from sb3_progpolicy.programs import ProgramRunner

MODEL = Path(__file__).parent / "data" / "reptile_ppo_0_1.zip"  # 128 steps on Hanoi, Adam as the meta-optimizer


@pytest.mark.filterwarnings("ignore:sb3_progpolicy.tasks")
def test_model_of_release_0_1_is_loaded_and_trains_on():
    with pytest.raises(ValueError, match="allow_pickle=True"):
        ReptilePPO.load(MODEL, env="Hanoi-v0")
    model = ReptilePPO.load(MODEL, env="Hanoi-v0", allow_pickle=True)
    assert (model.meta_iteration, model.num_timesteps) == (2, 128)
    assert [variation["n_discs"] for variation in model.tasks.variations] == [1, 2]
    momentum = model.outer_optimizer.state_dict()["state"][0]["exp_avg"]
    assert momentum.abs().max() > 0
    assert model.program().input_names[0] == "rank[0]"
    model.learn(128, reset_num_timesteps=False)
    assert (model.meta_iteration, model.num_timesteps) == (4, 256)


def test_names_of_release_0_1_still_work_and_say_what_they_are_called_now():
    runner = ProgramRunner(load_pretrained("Hanoi-v0"))
    runner.act(np.zeros((1, runner.program.n_inputs)))
    with pytest.warns(DeprecationWarning, match="mixture_weights"):
        masses = runner.masses
    np.testing.assert_array_equal(masses, runner.mixture_weights)
    env = InteractionHistory(make_fast_vec_env("CartPole-v1", 1).envs[0])
    env.reset(seed=0)
    assert env.step(1)[0][-3:].any()
    with pytest.warns(DeprecationWarning, match="reset_history"):
        env.forget()
    assert not env.observation(np.zeros(4))[4:].any()
    with pytest.warns(DeprecationWarning, match=r"sb3_progpolicy\.reptile\.tasks"):
        from sb3_progpolicy.tasks import UniformSampler
    assert UniformSampler.__module__ == "sb3_progpolicy.reptile.samplers"
    from sb3_progpolicy.programs.syntax import Program

    assert isinstance(runner.program, Program)


def test_programs_are_loaded_run_and_exported_with_torch_and_sb3_blocked():
    code = """
import sys
for name in ("torch", "stable_baselines3", "sb3_contrib"):
    sys.modules[name] = None
import numpy as np
from sb3_progpolicy import load_pretrained, spaces
from sb3_progpolicy.programs import ProgramRunner, export_c, export_graphviz, export_latex, export_python, export_text
program = load_pretrained("Hanoi-v0")
assert ProgramRunner(program).act(np.zeros((1, program.n_inputs))).shape == (1,)
assert all(export(program) for export in (export_text, export_python, export_c, export_latex, export_graphviz))
assert str(program) == export_text(program)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
