"""A saved model is data: what is in the file, what is refused, what loading may change."""

import inspect
import io
import json
import pickle
import zipfile

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import safetensors.numpy
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_progpolicy import RecurrentProgrammaticPolicy, ReptilePPO, TaskDistribution
from sb3_progpolicy.reptile.tasks import Sampler
from sb3_progpolicy.reptile_ppo.fields import ARGUMENTS
from sb3_progpolicy.reptile_ppo.saving import DOCUMENT, TENSORS
from sb3_progpolicy.reptile_ppo.values import ModelFormatError, from_data, to_data
from tests.fuzz.models import NAMES, write


def make(env="Hanoi-v0", policy="ProgPolicy", **arguments):
    return ReptilePPO(policy, env, **{"n_envs": 2, "n_steps": 16, "inner_updates": 1, "seed": 0, **arguments})


def saved(model, **arguments):
    buffer = io.BytesIO()
    model.save(buffer, **arguments)
    return buffer


def document(file):
    with zipfile.ZipFile(file) as archive:
        return json.loads(archive.read(DOCUMENT))


def changed(file, change):
    """The file with its JSON changed."""
    data = document(file)
    change(data)
    with zipfile.ZipFile(file) as archive:
        tensors = archive.read(TENSORS)
    return io.BytesIO(write([(DOCUMENT, json.dumps(data).encode()), (TENSORS, tensors)]))


@pytest.fixture(scope="module")
def content():
    return saved(make(meta_optimizer="adam").learn(64)).getvalue()


@pytest.fixture
def file(content):
    return io.BytesIO(content)


class MySampler(Sampler):
    def weights(self, n_variations, progress, success_rates):
        return np.ones(n_variations)


class MyPolicy(RecurrentProgrammaticPolicy):
    pass


# --------------------------------------------------------------------------------------------------- what is saved


def test_every_argument_of_the_constructor_is_saved(file):
    given = set(inspect.signature(ReptilePPO.__init__).parameters) - {"self", "env", "n_envs", "device"}
    given -= {"_init_setup_model", "init_program", "sampler"}  # a sampler is that of the tasks
    assert given == set(ARGUMENTS) == set(document(file)["arguments"])


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy", "MlpPolicy", "MlpLstmPolicy"])
def test_loaded_model_is_the_saved_one(policy, monkeypatch):
    arguments = {
        "learning_rate": LinearSchedule(0.01, 0.001, 0.5),
        "clip_range": ConstantSchedule(0.3),
        "meta_learning_rate": FloatSchedule(LinearSchedule(0.5, 0.1, 1.0)),
        "meta_optimizer": "adam",
        "scale_rewards": True,
        "timeouts": "terminal",
        "max_episode_steps": 100,
        "tasks": TaskDistribution([{"n_discs": 2}, {"n_discs": np.int64(1)}], sampler="failure"),
        "policy_kwargs": {"activation_fn": th.nn.Tanh, "optimizer_kwargs": {"betas": (0.8, 0.99), "eps": 1e-5}},
        "env_kwargs": {"source": 1, "target": 0},
        "tensorboard_log": None,
    }
    model = make(policy=policy, **arguments).learn(96)
    file = saved(model)
    for module in (pickle, cloudpickle):
        monkeypatch.setattr(module, "loads", None)
        monkeypatch.setattr(module, "load", None)
    monkeypatch.setattr(th, "load", None)
    loaded = ReptilePPO.load(file)
    monkeypatch.undo()
    assert saved(loaded).getvalue() == file.getvalue()
    assert loaded.policy_kwargs == model.policy_kwargs
    assert loaded.learning_rate(0.7) == model.learning_rate(0.7)
    assert loaded.reward_scaler.statistics.var == model.reward_scaler.statistics.var
    np.testing.assert_array_equal(loaded.tasks.success_rates, model.tasks.success_rates)
    observation = model.observation_space.sample()[None]
    np.testing.assert_array_equal(
        model.predict(observation, deterministic=True)[0], loaded.predict(observation, deterministic=True)[0]
    )


@pytest.mark.parametrize("env", ["Pendulum-v1", "FrozenLake-v1"])
def test_spaces_of_other_kinds_are_saved(env, tmp_path):
    model = make(env, "MlpPolicy", interaction_history=False, n_envs=1)
    model.save(tmp_path / "model")
    loaded = ReptilePPO.load(tmp_path / "model", env=env)
    assert (loaded.observation_space, loaded.action_space) == (model.observation_space, model.action_space)


@pytest.mark.parametrize(
    "value",
    [
        *(None, True, 3, -0.1, "text", [1, [2.5]], (1, ("a",)), {"a": {"b": ()}}, th.nn.ReLU, th.optim.AdamW),
        *(spaces.Box(np.float32([-np.inf, 0]), np.float32([1, np.inf])), spaces.Discrete(3, start=1)),
        *(spaces.MultiDiscrete([2, 3]), spaces.MultiBinary([2, 2])),
    ],
)
def test_value_is_the_same_after_a_way_through_json(value):
    assert from_data(json.loads(json.dumps(to_data(value), allow_nan=False))) == value


def test_arrays_keep_their_type_and_numbers_that_are_not_finite():
    for array in (np.arange(6, dtype=np.int16).reshape(2, 3), np.float32([0.1, np.inf, np.nan]), np.array(True)):
        loaded = from_data(json.loads(json.dumps(to_data(array))))
        assert loaded.dtype == array.dtype
        np.testing.assert_array_equal(loaded, array)


def test_excluded_field_is_left_out_unless_it_is_included():
    model = make(verbose=1)
    assert ReptilePPO.load(saved(model, exclude=["verbose"])).verbose == 0
    assert ReptilePPO.load(saved(model, exclude=["verbose"], include=["verbose"])).verbose == 1


# ------------------------------------------------------------------------------------------------- what is not data


@pytest.mark.parametrize(
    ("field", "arguments"),
    [
        ("tasks", {"tasks": {"n_discs": lambda rng: 1}}),
        ("tasks", {"tasks": TaskDistribution([{"n_discs": 1}], sampler=MySampler())}),
        ("learning_rate", {"learning_rate": lambda _: 0.01}),
        ("policy", {"policy": MyPolicy}),
        ("policy_kwargs", {"policy_kwargs": {"activation_fn": type("MyReLU", (th.nn.ReLU,), {})}}),
    ],
)
def test_what_is_not_data_is_named_and_needs_the_switch_on_both_sides(field, arguments, tmp_path):
    model, path = make(**arguments), tmp_path / "model.zip"
    with pytest.raises(ValueError, match=rf"not saved.* {field}: .*allow_pickle=True"):
        model.save(path)
    assert not path.exists()
    model.save(path, allow_pickle=True)
    with pytest.raises(ValueError, match=rf"holds pickles \({field}\).*allow_pickle=True"):
        ReptilePPO.load(path)
    loaded = ReptilePPO.load(path, env="Hanoi-v0", allow_pickle=True).learn(32)
    assert type(loaded.policy) is type(model.policy)
    model.set_parameters(path)  # reads numbers alone


def test_given_object_takes_the_place_of_a_pickled_one():
    file = saved(make(learning_rate=lambda _: 0.01), allow_pickle=True)
    assert ReptilePPO.load(file, custom_objects={"learning_rate": 0.5, "lr_schedule": None}).learning_rate == 0.5
    assert ReptilePPO.load(file, learning_rate=0.5).learning_rate == 0.5


def test_pickle_is_not_touched_without_the_switch(file, tmp_path):
    class Evil:
        def __reduce__(self):
            return open, (str(tmp_path / "evil"), "w")

    with zipfile.ZipFile(file) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    with pytest.raises(ValueError, match=r"holds pickles \(tasks\)"):
        ReptilePPO.load(io.BytesIO(write([*entries, ("tasks.pkl", pickle.dumps(Evil()))])))
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------------------- what loading may change


def test_environment_of_an_id_is_made_as_in_training():
    file = saved(make(n_envs=4, env_kwargs={"source": 1, "target": 0}, tasks={"n_discs": [1]}))
    loaded = ReptilePPO.load(file, env="Hanoi-v0")
    loaded.get_env().reset()
    row = loaded.get_env().get_attr("row_variations")[0][0]
    assert (loaded.n_envs, row["source"], row["target"]) == (4, 1, 0)
    assert saved(loaded).getvalue() == file.getvalue()
    other = ReptilePPO.load(file, env="Hanoi-v0", n_envs=6, env_kwargs={"target": 1}, tasks={"n_discs": [2, 3]})
    other.learn(96)
    assert (other.n_envs, other.env_kwargs, len(other.tasks)) == (6, {"target": 1}, 2)


def test_set_env_takes_an_id():
    model = ReptilePPO.load(saved(make(env_kwargs={"source": 1, "target": 0}, tasks={"n_discs": [1]})))
    model.set_env("Hanoi-v0")
    model.learn(32)
    assert model.get_env().get_attr("row_variations")[0][0]["source"] == 1


@pytest.mark.parametrize(
    "arguments",
    [
        *({"scale_rewards": True}, {"normalize_observations": False}, {"interaction_history": False}),
        *({"policy": "PRLPolicy"}, {"policy_kwargs": {"depth": 5}}, {"meta_optimizer": "sgd"}),
    ],
    ids=lambda arguments: next(iter(arguments)),
)
def test_what_loading_cannot_change_is_refused(arguments, file):
    with pytest.raises(ValueError, match=f"{next(iter(arguments))}=.*loading cannot change"):
        ReptilePPO.load(file, env="Hanoi-v0", **arguments)


def test_same_value_and_arguments_that_can_change_are_accepted(file):
    loaded = ReptilePPO.load(file, scale_rewards=False, learning_rate=0.5, n_steps=8, verbose=0, gamma=0.5)
    assert (loaded.learning_rate, loaded.n_steps, loaded.gamma) == (0.5, 8, 0.5)


def test_unknown_argument_and_environment_that_does_not_fit_are_refused(file):
    with pytest.raises(ValueError, match="n_layers= is not accepted; accepted: policy, learning_rate"):
        ReptilePPO.load(file, n_layers=3)
    with pytest.raises(ValueError, match="spaces do not match"):
        ReptilePPO.load(file, env="CartPole-v1")


def test_parameters_are_taken_from_a_file(file):
    model = make(meta_optimizer="adam")
    model.set_parameters(file)
    expected, actual = ReptilePPO.load(file).policy.state_dict(), model.policy.state_dict()
    assert all(th.equal(expected[name], actual[name]) for name in expected)


def test_versions_are_printed_without_control_characters(file, capsys):
    ReptilePPO.load(changed(file, lambda data: data["saved_with"].update(OS="\x1b[2J")), print_system_info=True)
    assert capsys.readouterr().out.partition("SAVED MODEL")[2].startswith(" SYSTEM INFO ==\n- OS: \\x1b[2J\n- Python: ")


@pytest.mark.parametrize(("force_reset", "kept"), [(True, False), (False, True)])
def test_last_observation_is_kept_if_asked_for(force_reset, kept, file):
    loaded = ReptilePPO.load(file, env=make().get_env(), force_reset=force_reset)
    assert (loaded._last_obs is not None) == kept


# ------------------------------------------------------------------------------------------ damaged and hostile files


def test_parameters_that_are_not_finite_are_neither_saved_nor_loaded(content, tmp_path):
    model = make()
    with th.no_grad():
        model.policy.value_net.bias.fill_(th.nan)
    with pytest.raises(ValueError, match=r"policy/value_net.bias holds numbers that are not finite"):
        model.save(tmp_path / "model.zip")
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        document, tensors = archive.read(DOCUMENT), safetensors.numpy.load(archive.read(TENSORS))
    tensors["policy/value_net.bias"] = np.float32([np.nan])
    file = io.BytesIO(write([(DOCUMENT, document), (TENSORS, safetensors.numpy.save(tensors))]))
    with pytest.raises(ModelFormatError, match=r"value_net.bias holds numbers that are not finite"):
        ReptilePPO.load(file)


@pytest.mark.parametrize("name", NAMES[:2])
def test_entry_with_a_foreign_name_is_refused(name, content, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = [(entry, archive.read(entry)) for entry in archive.namelist()]
    with pytest.raises(ModelFormatError, match=r"model\.json and tensors\.safetensors are expected"):
        ReptilePPO.load(io.BytesIO(write([*entries, (name, b"x")])))
    with pytest.raises(ModelFormatError):
        ReptilePPO.load(io.BytesIO(write([*entries, entries[0]])))
    assert not list(tmp_path.iterdir())


def test_compressed_entry_is_refused_before_it_is_read(content):
    bomb = write([(DOCUMENT, bytes(10**7)), (TENSORS, b"")], zipfile.ZIP_DEFLATED)
    with pytest.raises(ModelFormatError, match="compressed"):
        ReptilePPO.load(io.BytesIO(bomb))


@pytest.mark.parametrize(
    ("part", "name", "value", "message"),
    [
        ("arguments", "n_steps", 10**9, "a rollout of"),
        ("state", "n_envs", 10**6, "n_envs=1000000"),
        ("arguments", "policy_kwargs", {"net_arch": [50_000, 50_000]}, "layers of up to 50000"),
        ("arguments", "policy_kwargs", {"depth": 10**9}, "layers of up to"),
        ("arguments", "policy_kwargs", {"net_arch": [3, 3]}, "is expected"),
        ("arguments", "policy_kwargs", {"activation_fn": {"__kind__": "class", "name": "os.system"}}, "os.system"),
        ("arguments", "learning_rate", "fast", "learning_rate"),
        ("arguments", "tasks", {}, "no model can be made of it"),
        ("arguments", "policy", "torch.nn.Linear", "unknown"),
        ("state", "__class__", 1, "__class__"),
        ("optimizers", "policy.optimizer", [], "settings"),
    ],
)
def test_hostile_values_are_refused(part, name, value, message, file):
    with pytest.raises(ValueError, match=message):
        ReptilePPO.load(changed(file, lambda data: data[part].update({name: value})))


def test_deeply_nested_and_repeated_json_is_refused(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        document, tensors = archive.read(DOCUMENT), archive.read(TENSORS)
    twice = document.replace(b'"n_steps": 16', b'"n_steps": 16, "n_steps": 16')
    for text, message in (
        (b"[" * 50_000, "deeply"),
        (b"[" * 200_000, "more than"),
        (twice, "twice"),
        (b"\xff", "damaged"),
    ):
        with pytest.raises(ModelFormatError, match=message):
            ReptilePPO.load(io.BytesIO(write([(DOCUMENT, text), (TENSORS, tensors)])))


def test_file_that_is_no_zip_is_refused_and_one_that_is_not_there_is_not_found(tmp_path):
    (tmp_path / "model.zip").write_bytes(b"not a zip")
    with pytest.raises(ModelFormatError, match="not a model, or damaged"):
        ReptilePPO.load(tmp_path / "model")
    with pytest.raises(FileNotFoundError):
        ReptilePPO.load(tmp_path / "other")


def test_model_trained_in_a_made_environment_is_loaded_with_another(tmp_path):
    model = ReptilePPO("ProgPolicy", gym.make("CartPole-v1"), n_steps=32, inner_updates=1).learn(32)
    model.save(tmp_path / "model.zip")
    loaded = ReptilePPO.load(tmp_path / "model.zip", env=gym.make("CartPole-v1"))
    loaded.learn(32, reset_num_timesteps=False)
    assert loaded.num_timesteps == 64


def test_limit_of_training_episodes_is_not_that_of_an_environment_made_already():
    limited = saved(make(max_episode_steps=7))
    assert ReptilePPO.load(limited, env="Hanoi-v0").max_episode_steps == 7
    assert ReptilePPO.load(limited, env=gym.make("Hanoi-v0")).max_episode_steps is None
