from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_progpolicy import ReptilePPO, evaluate_model, evaluate_program, load_pretrained
from sb3_progpolicy.cli import run
from tests.handwritten.hanoi import hanoi_program

SIZES = [{"n_discs": n_discs} for n_discs in range(1, 6)]


@pytest.mark.parametrize("semantics", ["crisp", "soft"])
def test_optimal_program_is_measured_as_optimal(semantics):
    rows = evaluate_program(hanoi_program(), "Hanoi-v0", SIZES, n_episodes=2, semantics=semantics)
    assert [row.steps_mean for row in rows] == [1, 3, 7, 15, 31]
    assert {(row.success_rate, row.ratio, row.steps_std, row.semantics, row.env) for row in rows} == {
        (1, 1, 0, semantics, "Hanoi-v0")
    }


def test_failed_episode_counts_as_the_cap_and_the_cap_can_be_lifted():
    (capped,) = evaluate_program(hanoi_program(), "Hanoi-v0", [{"n_discs": 10}])
    assert (capped.success_rate, capped.steps_mean, capped.optimal_steps_mean) == (0, 500, 1023)
    (lifted,) = evaluate_program(hanoi_program(), "Hanoi-v0", [{"n_discs": 10}], max_steps=1023)
    assert (lifted.success_rate, lifted.steps_mean) == (1, 1023)


@pytest.fixture
def untrained():
    return ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=2, n_steps=8, seed=1, policy_kwargs={"condition_size": 3})


@pytest.fixture
def unbatched():
    """Hanoi registered without its vectorised form."""
    gym.register("UnbatchedHanoi-v0", gym.spec("Hanoi-v0").entry_point, max_episode_steps=500)
    yield "UnbatchedHanoi-v0"
    del gym.registry["UnbatchedHanoi-v0"]


def test_batched_and_single_environments_give_the_same_rows(untrained, unbatched):
    variations = [{"n_discs": 1, "source": source, "target": "random"} for source in (0, 1, 2, 1)]
    batched, single = (
        evaluate_program(untrained.program(), env_id, variations, 6, seed=3, max_steps=40)
        for env_id in ("Hanoi-v0", unbatched)
    )
    assert [replace(row, env="Hanoi-v0") for row in single] == batched
    assert 0 < np.mean([row.success_rate for row in batched]) < 1


def test_model_and_its_program_do_the_same_under_soft_semantics(untrained):
    variations = [{"n_discs": 1, "source": source, "target": "random"} for source in (0, 1, 2)]
    expected = evaluate_program(untrained.program(), None, variations, 4, "soft", max_steps=30)
    untrained.policy.module.search.select(untrained.policy.module.search.most_likely())
    actual = evaluate_model(untrained, "Hanoi-v0", variations, 4, max_steps=30)
    assert [row.steps_mean for row in actual] == [row.steps_mean for row in expected]
    assert {row.semantics for row in actual} == {None}


def test_variations_need_not_name_the_same_parameters():
    rows = evaluate_program(hanoi_program(), "Hanoi-v0", [{"n_discs": 2}, {"n_discs": 2, "source": 1}, {}])
    assert [row.steps_mean for row in rows] == [3, 3, 7]


def test_stock_model_is_evaluated():
    (row,) = evaluate_model(PPO("MlpPolicy", "Hanoi-v0", n_steps=8, batch_size=8), "Hanoi-v0", [{"n_discs": 8}])
    assert (row.success_rate, row.steps_mean) == (0, 500)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"env_id": "Hanoy-v0"}, "Hanoi-v0"),
        ({"env_id": "CartPole-v1"}, "9 numbers"),
        ({"n_episodes": 0}, "n_episodes=0"),
        ({"max_steps": 0}, "max_steps=0"),
        ({"variations": [{"n_disc": 3}]}, "n_discs"),
        ({"semantics": "hard"}, "semantics='hard'"),
    ],
)
def test_wrong_argument_is_named(arguments, said):
    with pytest.raises(ValueError, match=said):
        evaluate_program(hanoi_program(), **{"env_id": "Hanoi-v0", **arguments})


@pytest.mark.parametrize("normalized", [False, True])
def test_environment_without_a_goal_has_returns_and_lengths(normalized):
    assert "is_success" not in gym.make("CartPole-v1").reset()[1]
    env = make_vec_env("CartPole-v1", 2)
    model = PPO("MlpPolicy", VecNormalize(env) if normalized else env, n_steps=8, batch_size=8, seed=0).learn(64)
    (row,) = evaluate_model(model, "CartPole-v1", n_episodes=5)
    assert row.success_rate is None
    assert row.steps_mean == row.return_mean > 5  # a reward of 1 in each step
    assert row.steps_std == row.return_std


def test_returns_are_sums_of_rewards():
    (row,) = evaluate_program(hanoi_program(), "Hanoi-v0", [{"n_discs": 3}])
    env = gym.make("Hanoi-v0", n_discs=3)
    env.reset()
    rewards = [env.step(action)[1] for action in env.unwrapped.plan()]
    assert row.return_mean == pytest.approx(sum(rewards), abs=1e-5)


def test_program_file_imports_no_module(tmp_path, monkeypatch, capsys):
    (tmp_path / "evil_module.py").write_text("raise SystemExit('imported')")
    monkeypatch.chdir(tmp_path)
    program = replace(load_pretrained("Hanoi-v0"), metadata={"env": "evil_module:Hanoi-v0"})
    with pytest.raises(ValueError, match="give env_id"):
        evaluate_program(program, variations=[{"n_discs": 1}])
    program.save(tmp_path / "program.json")
    assert run(["evaluate", "program.json", "--set", "n_discs=1"]) == 2
    assert "give --env" in capsys.readouterr().err
    assert run(["show", "program.json"]) == 0
    # A module that is imported already registers its ids anyway.
    known = replace(program, metadata={"env": "progpolicy_envs:Hanoi-v0"})
    assert evaluate_program(known, variations=[{"n_discs": 1}])[0].success_rate == 1
