"""ReptilePPO: what is accepted, and what is refused by name."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_progpolicy import InteractionHistory, ReptilePPO, VecInteractionHistory
from sb3_progpolicy.vec_env import make_fast_vec_env
from tests.reptile_ppo.models import POLICIES, Each, OneStep, make, weights


@pytest.mark.parametrize("policy", POLICIES)
def test_all_policies_train_and_are_evaluated(policy):
    model = make(policy, DummyVecEnv([OneStep] * 8), n_steps=8, learning_rate=0.01, n_epochs=4, scale_rewards=True)
    before = weights(model)
    model.learn(64 * 25)
    assert (weights(model) != before).any()
    env = VecInteractionHistory(DummyVecEnv([OneStep] * 4))
    # Actions of a Discrete space that starts at 5: the environment asserts that they are in it.
    assert evaluate_policy(model, env, 200, warn=False)[0] > 0.8


@pytest.mark.parametrize(
    "space", [spaces.Box(-1, 1, (2, 3), np.float32), spaces.MultiBinary(3), spaces.MultiDiscrete([2, 4])]
)
@pytest.mark.parametrize("interaction_history", [True, False])
@pytest.mark.parametrize("cell", ["gru", "lstm"])
def test_all_action_spaces_and_double_precision_observations(space, interaction_history, cell):
    env = DummyVecEnv([lambda: OneStep(space)] * 4)
    model = make(env=env, interaction_history=interaction_history, policy_kwargs={"cell": cell}).learn(128)
    env = VecInteractionHistory(env) if interaction_history else env
    evaluate_policy(model, env, 8, warn=False)  # the environment asserts that actions are in its space
    assert model.program().action.n_outputs == sum(model.policy.spec_of_actions.sizes)


def test_environments_of_every_form_are_accepted():
    venv = make_fast_vec_env("Hanoi-v0", 3)
    for env, n_envs in (("progpolicy_envs:Hanoi-v0", 2), (gym.make("Hanoi-v0"), 1), (venv, 3)):
        model = make(env=env, **({"n_envs": 2} if isinstance(env, str) else {}))
        assert model.n_envs == n_envs
        assert [variation["n_discs"] for variation in model.tasks.variations] == [1, 2, 3, 4]
        model.learn(64)
    assert ReptilePPO("ProgPolicy", "Hanoi-v0", seed=0).n_envs == 32


@pytest.mark.parametrize("tasks", [{"n_discs": [2]}, [{"n_discs": 2}]])
def test_tasks_are_given_as_mapping_or_list(tasks):
    model = make(tasks=tasks, env_kwargs={"source": 1})
    model.learn(64)
    assert {v["n_discs"] for v in model.get_env().get_attr("row_variations")[0]} == {2}
    assert {v["source"] for v in model.get_env().get_attr("row_variations")[0]} == {1}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": "ProgramPolicy"}, "ProgramPolicy"),
        ({"search_fraction": 1.5}, "search_fraction=1.5"),
        ({"length_coef": -1.0}, "length_coef=-1.0"),
        ({"n_envs": 0}, "n_envs=0"),
        ({"tasks": []}, "at least one variation"),
        ({"inner_updates": 0}, "inner_updates=0"),
        ({"meta_optimizer": "lion"}, "known: sgd, adam"),
        ({"max_episode_steps": 0}, "max_episode_steps=0"),
        ({"timeouts": "failure"}, "known: bootstrap, terminal"),
        ({"env": "FrozenLake-v1"}, "FlattenObservation"),
        ({"policy_kwargs": {"cell": "mamba"}}, "known cells"),
        ({"env_kwargs": {"n_discs": 99}}, "which the tasks set, too"),
    ],
)
def test_values_that_are_not_accepted_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_training_episodes_end_at_a_limit_of_their_own():
    ends = []

    def note(_, local):
        ends.extend(info["episode"]["l"] for info in local["infos"] if info.get("TimeLimit.truncated"))

    model = make(max_episode_steps=3, tasks=[{"n_discs": 5}]).learn(64, callback=Each(note))
    assert set(ends) == {3}
    model.set_env("Hanoi-v0")
    ends.clear()
    model.learn(64, callback=Each(note))
    assert set(ends) == {3}


def test_environments_that_are_made_already_take_no_arguments():
    with pytest.raises(ValueError, match="n_envs, env_kwargs and max_episode_steps"):
        make(env=gym.make("Hanoi-v0"), n_envs=3)
    with pytest.raises(ValueError, match="n_envs, env_kwargs and max_episode_steps"):
        make(env=gym.make("Hanoi-v0"), max_episode_steps=3)
    with pytest.raises(ValueError, match="appends the history itself"):
        make(env=InteractionHistory(gym.make("Hanoi-v0")))


def test_a_network_is_no_program():
    with pytest.raises(TypeError, match="is not a program"):
        make("MlpPolicy").program()


@pytest.mark.parametrize(("policy", "ends"), [("ProgPolicy", (0.02, 0.0)), ("MlpPolicy", (3e-4, 3e-4))])
def test_learning_rate_of_a_program_falls_to_zero_by_default(policy, ends, tmp_path):
    model = ReptilePPO(policy, "CartPole-v1", n_envs=2, n_steps=8)
    model.save(tmp_path / "model.zip")
    for one in (model, ReptilePPO.load(tmp_path / "model.zip")):
        assert (one.lr_schedule(1.0), one.lr_schedule(0.0)) == ends
