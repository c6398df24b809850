"""The registry of methods, and one helper for programs whatever trained them."""

import dataclasses
import inspect
import json

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_progpolicy import ProgrammaticPolicy, VecInteractionHistory, extract_program, holds_program
from sb3_progpolicy.cli import run
from sb3_progpolicy.experiment.methods import METHODS, get_method
from sb3_progpolicy.hyperparams import load_hyperparams
from sb3_progpolicy.programs import ProgramRunner, join_inputs


@pytest.mark.parametrize("name", METHODS)
def test_methods_have_settings_a_policy_and_a_source(name):
    method = get_method(name)
    assert method.name == name
    assert method.policy in method.all_policies
    assert load_hyperparams(name, "CartPole-v1")["policy"] == method.policy
    assert method.source
    assert ("tasks" in inspect.signature(method.algorithm).parameters) == method.has_reptile
    with pytest.raises(dataclasses.FrozenInstanceError):
        method.name = "another"


def test_registry_cannot_be_changed_and_names_the_nearest():
    with pytest.raises(TypeError):
        METHODS["own"] = METHODS["ppo"]
    with pytest.raises(ValueError, match="nearest: reptile_ppo"):
        get_method("reptil_ppo")


def test_program_trained_by_stock_ppo_is_written_shown_and_evaluated(tmp_path, capsys):
    settings = ["policy:PRLPolicy", "n_envs:4", "n_steps:16", "batch_size:32", "interaction_history:true"]
    arguments = ["train", "--algo", "ppo", "--env", "Hanoi-v0", "--seed", "0", "-n", "128", "-f", str(tmp_path)]
    assert run([*arguments, "--hyperparams", *settings]) == 0
    folder = tmp_path / "ppo" / "Hanoi-v0_1"
    assert (folder / "program.json").is_file()
    capsys.readouterr()
    assert run(["show", str(folder)]) == 0
    assert "Program for Hanoi-v0" in capsys.readouterr().out
    assert run(["evaluate", str(folder), "--set", "n_discs=1,2", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["semantics"] for row in rows] == ["soft", "soft", "crisp", "crisp"]


def test_program_of_a_stock_model_reads_and_does_what_its_policy_does():
    env = VecInteractionHistory(make_vec_env("CartPole-v1", 3, seed=0))
    model = PPO(ProgrammaticPolicy, env, n_steps=32, batch_size=32, seed=0, policy_kwargs={"depth": 1}).learn(96)
    assert holds_program(model)
    program = extract_program(model, note="x")
    origin = {"env": "CartPole-v1", "seed": 0, "timesteps": 96, "learned_by": "reinforcement"}
    assert program.metadata == {**origin, "note": "x"}
    assert (program.n_observations, program.interaction, program.n_inputs) == (4, True, 8)
    runner, observations = ProgramRunner(program, 3), env.reset()
    for _ in range(20):
        x = join_inputs(program, observations[:, :4])
        x[:, 4:] = observations[:, 4:]
        actions = model.predict(observations, deterministic=True)[0]
        np.testing.assert_array_equal(runner.act(x), actions)
        observations, *_ = env.step(actions)


def test_network_holds_no_program():
    model = PPO("MlpPolicy", "CartPole-v1")
    assert not holds_program(model)
    with pytest.raises(TypeError, match="ActorCriticPolicy is not a program"):
        extract_program(model)
