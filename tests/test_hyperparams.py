import json

import pytest
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_progpolicy.experiment.config import _accepted, make_config, parse_config
from sb3_progpolicy.experiment.methods import METHODS
from sb3_progpolicy.experiment.run import build_model
from sb3_progpolicy.hyperparams import DEFAULT, SEARCH, algorithms, load_hyperparams, parse_kwargs, parse_value
from sb3_progpolicy.reptile.samplers import CurriculumSampler, ProgressSampler


@pytest.mark.parametrize("algo", list(METHODS))
@pytest.mark.parametrize("env_id", ["Hanoi-v0", "CartPole-v1"])
def test_shipped_hyperparameters_build_a_model(algo, env_id):
    config = make_config(algo, env_id, seed=0)
    model, _ = build_model(config)
    assert getattr(model, "n_steps", 1) == config.hyperparams.get("n_steps", 1)
    assert model.n_envs == config.hyperparams["n_envs"]


def test_there_is_a_file_for_every_algorithm():
    assert set(algorithms()) == set(METHODS)


def test_entry_of_an_environment_starts_from_the_default_one():
    hanoi, default = (load_hyperparams("reptile_ppo", env_id) for env_id in ("Hanoi-v0", "Other-v0"))
    assert hanoi["n_steps"] == default["n_steps"]
    assert hanoi["n_timesteps"] != default["n_timesteps"]
    assert load_hyperparams("reptile_ppo", "progpolicy_envs:Hanoi-v0") == hanoi


@pytest.mark.parametrize("value", [{"depth": 3, "cell": "gru"}, "dict(depth=3, cell='gru')"])
def test_policy_kwargs_are_a_mapping_or_the_zoos_dict(value):
    assert parse_kwargs("policy_kwargs", value) == {"depth": 3, "cell": "gru"}


def test_nested_dict_is_parsed():
    assert parse_kwargs("policy_kwargs", "dict(net_arch=dict(pi=[8], vf=[16]))") == {
        "net_arch": {"pi": [8], "vf": [16]}
    }


@pytest.mark.parametrize(
    "value", ["dict(depth=__import__('os').getpid())", "open('x')", "dict(**{'a': 1})", "dict(1)", "[1]", "dict(", 7]
)
def test_nothing_in_policy_kwargs_is_run(value):
    with pytest.raises(ValueError, match="policy_kwargs="):
        parse_kwargs("policy_kwargs", value)


def test_number_with_an_exponent_is_a_number():
    assert parse_value("1e-3") == 1e-3
    assert make_config("reptile_ppo", "Hanoi-v0", 0, overrides={"n_timesteps": "4e5"}).n_timesteps == 400_000


def test_numbers_within_lists_and_mappings_are_numbers():
    kwargs = "{optimizer_kwargs: {eps: 1e-5, betas: [9E-1, 0.999]}, cell: gru}"
    expected = {"optimizer_kwargs": {"eps": 1e-5, "betas": [0.9, 0.999]}, "cell": "gru"}
    assert parse_value(kwargs) == parse_kwargs("policy_kwargs", parse_value(kwargs)) == expected
    assert parse_kwargs("policy_kwargs", {"optimizer_kwargs": {"eps": "1e-5"}})["optimizer_kwargs"]["eps"] == 1e-5
    overrides = {"sampler": {"name": "curriculum", "fraction": "5e-1"}, "tasks": {"n_discs": [1, 2]}}
    assert make_config("reptile_ppo", "Hanoi-v0", 0, overrides=overrides).hyperparams["sampler"]["fraction"] == 0.5
    assert parse_value("{name: e5, layout: '12', other: 1e5x}") == {"name": "e5", "layout": "12", "other": "1e5x"}
    with pytest.raises(ValueError, match="numbers are finite"):
        parse_value("{eps: 1e999}")
    with pytest.raises(ValueError, match="numbers are finite"):
        parse_kwargs("policy_kwargs", {"optimizer_kwargs": {"eps": "1e999"}})


@pytest.mark.parametrize(
    ("algo", "env_id", "overrides"),
    [
        ("sac", "Hanoi-v0", {"gradient_steps": -1, "learning_starts": 0}),
        ("sac", "Pendulum-v1", {"train_freq": [1, "episode"], "n_envs": 1, "sde_sample_freq": -1}),
        ("sac", "Pendulum-v1", {"train_freq": [4, "step"]}),
        ("hiro", "Pendulum-v1", {"gradient_steps": -1, "high_learning_starts": 0}),
        ("ppo", "Pendulum-v1", {"sde_sample_freq": -1, "use_sde": True}),
    ],
)
def test_values_that_stable_baselines_accepts_are_accepted(algo, env_id, overrides):
    config = make_config(algo, env_id, 0, overrides=overrides)
    assert parse_config(json.loads(json.dumps(vars(config)))) == config
    model, _ = build_model(config)
    for name, value in overrides.items():
        expected = TrainFreq(value[0], TrainFrequencyUnit(value[1])) if name == "train_freq" else value
        assert getattr(model, name) == expected


@pytest.mark.parametrize(
    ("algo", "overrides", "said"),
    [
        ("sac", {"train_freq": [1, "day"]}, r"train_freq=\[1, 'day'\] is not accepted"),
        (
            "sac",
            {"train_freq": [0, "step"]},
            "a whole number of at least 1, or such a number and step or episode",
        ),
        ("sac", {"train_freq": [1, "episode"]}, "give n_envs=1"),
        ("sac", {"gradient_steps": -2}, "gradient_steps=-2 is not accepted"),
        ("reptile_ppo", {"policy_kwargs": {"activation_fn": "relu"}}, "activation_fn='relu' is not accepted"),
        ("ppo", {"policy_kwargs": {"activation_fn": "relu"}}, "activation_fn='relu' is not accepted"),
        ("reptile_ppo", {"policy_kwargs": {"depth": 2.5}}, "depth=2.5 is not accepted; it is a whole number"),
        ("hiro", {"policy_kwargs": {"net_arch": 64}}, "net_arch=64 is not accepted; it is a list of layer sizes"),
    ],
)
def test_values_that_are_not_accepted_are_named(algo, overrides, said):
    with pytest.raises(ValueError, match=said):
        make_config(algo, "Hanoi-v0", 0, overrides=overrides)


def test_linear_schedule_falls_to_zero():
    config = make_config("ppo", "CartPole-v1", 0, overrides={"learning_rate": "lin_0.002"})
    model, _ = build_model(config)
    assert [model.lr_schedule(remaining) for remaining in (1.0, 0.5, 0.0)] == pytest.approx([0.002, 0.001, 0.0])


def test_linear_schedule_goes_from_one_number_to_another():
    config = make_config("reptile_ppo", "PandaReach-v0", 0, overrides={"action_std": "lin_0.5_0.1", "n_envs": 4})
    model, _ = build_model(config)
    assert [model.action_std(remaining) for remaining in (1.0, 0.5, 0.0)] == pytest.approx([0.5, 0.3, 0.1])


def test_timeouts_are_terminal_where_a_file_or_the_command_line_says_so():
    assert build_model(make_config("reptile_ppo", "Hanoi-v0", 0))[0].timeouts == "bootstrap"
    for algo in ("reptile_ppo", "reptile_mlp"):
        config = make_config(algo, "Hanoi-v0", 0, overrides={"timeouts": "terminal", "max_episode_steps": "9"})
        model = build_model(config)[0]
        assert (model.timeouts, model.max_episode_steps) == ("terminal", 9)


def test_entry_gives_arguments_of_the_environment_which_the_command_line_can_change():
    assert make_config("reptile_ppo", "PandaPush-v0", 0).env_kwargs == {"reward_type": "potential"}
    changed = make_config("reptile_ppo", "PandaPush-v0", 0, env_kwargs={"reward_type": "dense", "n_objects": 2})
    assert changed.env_kwargs == {"reward_type": "dense", "n_objects": 2}


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"n_step": 3}, "nearest: n_steps"),
        ({"n_steps": "abc"}, "n_steps='abc'"),
        ({"n_steps": 0}, "at least 1"),
        ({"n_steps": 2.5}, "whole number"),
        ({"learning_rate": "exp_0.1"}, "lin_<from>"),
        ({"action_std": "lin_0.5_0.1_0"}, "lin_<from>"),
        ({"action_std": "lin_a"}, "lin_<from>"),
        ({"max_episode_steps": 0}, "at least 1"),
        ({"timeouts": "never"}, "known: bootstrap, terminal"),
        ({"meta_update": 1}, "true or false"),
        ({"policy": "ProgPol"}, "nearest: ProgPolicy"),
        ({"policy_kwargs": {"dept": 3}}, "nearest: depth"),
        ({"gamma": "high"}, "gamma='high'"),
        ({"sampler": "hardest"}, "sampler='hardest' is not accepted; known samplers: uniform, curriculum"),
        ({"sampler": {"name": "failure", "flor": 1}}, "flor=1 is not accepted; failure takes floor"),
        ({"init_program": 3}, "init_program=3 is not accepted; it is a file or the name of a shipped program"),
    ],
)
def test_slip_is_named(overrides, said):
    with pytest.raises(ValueError, match=said):
        make_config("reptile_ppo", "Hanoi-v0", 0, overrides=overrides)


def test_unknown_names_are_answered_with_the_nearest():
    with pytest.raises(ValueError, match="nearest: reptile_ppo"):
        make_config("reptil_ppo", "Hanoi-v0", 0)
    with pytest.raises(ValueError, match="Hanoi-v0"):
        make_config("reptile_ppo", "Hanoy-v0", 0)
    with pytest.raises(ValueError, match="nearest: n_discs"):
        make_config("reptile_ppo", "Hanoi-v0", 0, env_kwargs={"n_disc": 3})


@pytest.mark.parametrize("algo", ["reptile_ppo", "reptile_mlp", "recurrent_ppo_multitask"])
@pytest.mark.parametrize(("sampler", "made"), [
    ("progress", ProgressSampler()),
    ({"name": "curriculum", "fraction": 0.5}, CurriculumSampler(0.5)),
])  # fmt: skip
def test_sampler_is_set_in_a_file_with_tasks_and_without(algo, sampler, made):
    for tasks in ({}, {"tasks": {"n_discs": [1, 2, 3]}}):
        config = make_config(algo, "Hanoi-v0", 0, overrides={"sampler": sampler, "n_envs": 2, **tasks})
        model, wrapper = build_model(parse_config(json.loads(json.dumps(vars(config), default=dict))))
        distribution = model.tasks if wrapper is None else wrapper.tasks
        assert distribution.sampler == made
        assert len(distribution) == (3 if tasks else 4)


def test_sampler_is_read_from_the_command_line():
    assert parse_value("{name: curriculum, fraction: 0.5}") == {"name": "curriculum", "fraction": 0.5}


def test_names_of_a_tuning_section_and_of_hyperparameters_do_not_clash():
    for algo in algorithms():
        accepted = _accepted(algo)
        assert not {SEARCH, DEFAULT} & set(accepted)
