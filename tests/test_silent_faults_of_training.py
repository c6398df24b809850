"""What training and evaluation must not pass over: arguments, options, shapes, files."""

import json
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_progpolicy import ReptilePPO, ReptileWrapper, evaluate_model, evaluate_program, load_pretrained
from sb3_progpolicy.cli import run
from sb3_progpolicy.experiment.sources import find_source
from sb3_progpolicy.reptile_ppo.loading import _check_sizes
from sb3_progpolicy.reptile_ppo.saving import SavedModel
from sb3_progpolicy.vec_env import make_fast_vec_env
from sb3_progpolicy.vec_env.repeat import RepeatOptions, repeat_options

SMALL = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "seed": 0, "device": "cpu"}


class Sized(gym.Env):
    """Observes the size that this reset was given, as Gymnasium's environments read options: for one reset."""

    observation_space = spaces.Box(-10, 10, (2,), np.float32)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}

    def __init__(self, size=1.0, space=None, render_mode=None):
        self.default, self.render_mode = size, render_mode
        self.action_space = spaces.Discrete(2) if space is None else space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.size, self.n_steps = (options or {}).get("size", self.default), 0
        return np.array([self.size, self.np_random.uniform()], np.float32), {}

    def step(self, action):
        assert action in self.action_space
        self.n_steps += 1
        return np.array([self.size, 0], np.float32), float(self.size), self.n_steps == 3, False, {}

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)


@pytest.fixture(scope="module", autouse=True)
def sized():
    gym.register("Sized-v0", entry_point=Sized, max_episode_steps=20)
    yield
    gym.registry.pop("Sized-v0")


def test_options_are_in_force_in_every_episode(tmp_path):
    model = ReptilePPO("ProgPolicy", "Sized-v0", tasks={"size": [0.5, 5.0]}, n_envs=2, **SMALL)
    seen = []
    reset = Sized.reset

    def spy(self, *, seed=None, options=None):
        observation, info = reset(self, seed=seed, options=options)
        seen.append(self.size)
        return observation, info

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sized, "reset", spy)
        model.learn(200)
    assert set(seen[2:]) == {0.5, 5.0}  # SB3 resets once without a task
    assert len(seen) > 40
    (row,) = evaluate_program(model.program(), "Sized-v0", [{"size": 5.0}], 6)
    assert row.return_mean == 15
    seen.clear()
    stock = PPO("MlpPolicy", DummyVecEnv([Sized]), **SMALL)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Sized, "reset", spy)
        stock.learn(100, callback=ReptileWrapper({"size": [0.5, 5.0]}))
    assert set(seen[1:]) == {0.5, 5.0}
    model.save(tmp_path / "model.zip")
    assert ReptilePPO.load(tmp_path / "model.zip").wrappers == ()


def test_options_that_are_given_replace_those_before():
    venv = make_fast_vec_env("Sized-v0", 1)
    repeat_options(venv)
    repeat_options(venv)
    for size in (2.0, 3.0):
        venv.set_options({"size": size})
        assert venv.reset()[0, 0] == size
        for _ in range(4):
            observations, *_ = venv.step(np.zeros(1, int))
        assert observations[0, 0] == size
    assert not isinstance(venv.unwrapped.envs[0].env, RepeatOptions)  # once only
    ours = make_vec_env("Hanoi-v0", 1)
    repeat_options(ours)
    assert not any(ours.env_is_wrapped(RepeatOptions))


def small_pushes():
    return gym.make("CartPole-v1")


def small_pushes_repeated():
    return RepeatOptions(small_pushes())


def test_options_of_environments_in_other_processes_are_not_lost_silently():
    venv = SubprocVecEnv([small_pushes], start_method="fork")
    with pytest.warns(UserWarning, match="loses them when an episode ends; make each of them as RepeatOptions"):
        repeat_options(venv)
    venv.close()
    venv = SubprocVecEnv([small_pushes_repeated], start_method="fork")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        repeat_options(venv)
    venv.close()


def test_constructor_arguments_that_tasks_set_too_are_refused():
    with pytest.raises(ValueError, match="env_kwargs sets n_discs, which the tasks set, too"):
        ReptilePPO("ProgPolicy", "Hanoi-v0", env_kwargs={"n_discs": 6})
    with pytest.raises(ValueError, match="max_episode_steps is given twice"):
        ReptilePPO("ProgPolicy", "CartPole-v1", env_kwargs={"max_episode_steps": 5}, max_episode_steps=7)


def test_constructor_arguments_go_with_the_model_and_its_program(tmp_path):
    model = ReptilePPO("ProgPolicy", "Sized-v0", env_kwargs={"size": 4.0}, n_envs=1, **SMALL).learn(8)
    program = model.program()
    assert program.metadata["env_kwargs"] == {"size": 4.0}
    assert evaluate_program(program)[0].return_mean == 12
    assert evaluate_program(program, env_kwargs={})[0].return_mean == 3
    model.save(tmp_path / "model.zip")
    assert find_source(str(tmp_path / "model.zip")).env_kwargs == {"size": 4.0}
    limited = ReptilePPO("ProgPolicy", "CartPole-v1", env_kwargs={"max_episode_steps": 5}, n_envs=1, **SMALL)
    assert evaluate_program(limited.program())[0].steps_mean <= 5


def test_arguments_that_the_command_line_refuses_are_refused_here_too():
    wrong = {
        "gamma": 2.0,
        "learning_rate": -1.0,
        "max_grad_norm": -1.0,
        "temperature": float("inf"),
        "growth_iterations": 2.5,
        "n_steps": 0,
        "n_epochs": 0,
        "inner_updates": 2.0,
        "tasks_per_iteration": 2.0,
        "normalize_advantage": 1,
        "clip_range": "lin_1_0.1",
        "seed": -1,
        "ent_coef": float("nan"),
    }
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=name):
            ReptilePPO("ProgPolicy", "CartPole-v1", **{name: value})
    with pytest.raises(ValueError, match="temperature is for the conditions of programs, not for Act"):
        ReptilePPO("MlpPolicy", "CartPole-v1", temperature=0.5)
    with pytest.raises(ValueError, match=r"inner_updates=1\.5 is not accepted"):
        ReptileWrapper({"n_discs": [1, 2]}, inner_updates=1.5)
    assert len(ReptileWrapper({"n_discs": [1, 2]}).tasks) == 2


def test_what_is_accepted_can_be_saved_and_loaded(tmp_path):
    limits = {"max_grad_norm": float("inf"), "target_kl": float("inf"), "verbose": False, "learning_rate": 1}
    model = ReptilePPO("ProgPolicy", "CartPole-v1", tensorboard_log=tmp_path / "logs", n_envs=2, **limits, **SMALL)
    model.learn(2e1, callback=None).save(tmp_path / "model.zip")
    loaded = ReptilePPO.load(tmp_path / "model.zip")
    assert loaded.max_grad_norm == loaded.target_kl == float("inf")
    assert loaded.program().body == model.program().body
    with pytest.raises(ValueError, match=r"total_timesteps=2\.5 is not accepted"):
        model.learn(2.5)
    model.n_updates = None
    model._n_updates = -1
    with pytest.raises(ValueError, match="the model is not saved: n_updates=-1 would not be accepted"):
        model.save(tmp_path / "model.zip")
    assert ReptilePPO.load(tmp_path / "model.zip").num_timesteps == loaded.num_timesteps


def test_multi_binary_models_are_loaded(tmp_path):
    space = spaces.MultiBinary(3)
    model = ReptilePPO("ProgPolicy", Sized(space=space), **SMALL)
    model.save(tmp_path / "model.zip")
    assert ReptilePPO.load(tmp_path / "model.zip").action_space == space
    assert ReptilePPO.load(tmp_path / "model.zip", env=Sized(space=space)).action_space == space


def test_indices_of_symmetries_are_no_sizes_of_layers():
    state = {"n_envs": 1, "observation_space": spaces.Box(-1, 1, (400,)), "action_space": spaces.Discrete(2)}
    tied = {"symmetries": [{"inputs": [list(range(400)), [1] * 400]}]}
    _check_sizes(SavedModel({"n_steps": 8, "policy_kwargs": tied}, state, {}, {}))
    with pytest.raises(ValueError, match="layers of up to 100000 units are not accepted"):
        _check_sizes(SavedModel({"n_steps": 8, "policy_kwargs": {"net_arch": [100_000, 100_000]}}, state, {}, {}))


def test_shapes_of_actions_are_those_of_the_space():
    space = spaces.Box(-1, 2, (2, 2), np.float32)
    model = ReptilePPO("ProgPolicy", "Sized-v0", env_kwargs={"space": space}, n_envs=1, **SMALL)
    (row,) = evaluate_program(model.program(), "Sized-v0", env_kwargs={"space": space})
    assert row.return_mean == 3
    growing = ReptilePPO(
        "ProgPolicy", "Sized-v0", env_kwargs={"space": space}, n_envs=1, search_method="growth", **SMALL
    )
    growing.learn(200)


def test_normalised_model_is_not_another_one_after_loading(tmp_path):
    def normalised(**arguments):
        return VecNormalize(DummyVecEnv([lambda: gym.make("CartPole-v1")]), **arguments)

    with pytest.raises(ValueError, match="norm_reward=True is not accepted for a program"):
        ReptilePPO("ProgPolicy", normalised(), **SMALL)
    venv = normalised(norm_reward=False)
    model = ReptilePPO("ProgPolicy", venv, normalize_observations=False, **SMALL).learn(64)
    model.save(tmp_path / "model.zip")
    venv.save(tmp_path / "statistics.pkl")
    alone = ReptilePPO.load(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="wrapped in VecNormalize"):
        evaluate_model(alone, "CartPole-v1")
    with pytest.raises(ValueError, match="wrapped in VecNormalize"):
        evaluate_program(alone.program(), "CartPole-v1")
    with pytest.raises(ValueError, match="env is not accepted without VecNormalize"):
        ReptilePPO.load(tmp_path / "model.zip", env="CartPole-v1")
    again = ReptilePPO.load(tmp_path / "model.zip", env=VecNormalize.load(tmp_path / "statistics.pkl", venv.venv))
    assert again.program().body == model.program().body


def test_another_environment_is_named_by_its_own_id():
    model = ReptilePPO("ProgPolicy", "CartPole-v1", n_envs=1, **SMALL)
    gym.register("Cart-v9", "gymnasium.envs.classic_control:CartPoleEnv", max_episode_steps=7)
    try:
        model.set_env("Cart-v9")
        assert model.env_id == model.program().metadata["env"] == "Cart-v9"
        assert evaluate_program(model.program())[0].steps_mean <= 7
    finally:
        gym.registry.pop("Cart-v9")


def test_without_a_seed_trainings_differ():
    starts = []
    for _ in range(2):
        arguments = {**SMALL, "seed": None}
        model = ReptilePPO("ProgPolicy", "Hanoi-v0", tasks={"n_discs": [3, 4], "source": ["random"]}, **arguments)
        model.learn(1)
        starts.append(model.rollout_buffer.observations.copy())
    assert not np.array_equal(*starts)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"variations": {"size": 5.0}}, "it is a sequence of mappings"),
        ({"variations": "size"}, "it is a sequence of mappings"),
        ({"n_episodes": 1.5}, r"n_episodes=1\.5 is not accepted"),
        ({"seed": None}, "seed=None is not accepted"),
        ({"max_steps": 0}, "max_steps=0 is not accepted"),
        ({"env_id": Sized()}, "it is the id of an environment"),
    ],
)
def test_arguments_of_an_evaluation_are_checked(arguments, message):
    program = ReptilePPO("ProgPolicy", "Sized-v0", n_envs=1, **SMALL).program()
    with pytest.raises(ValueError, match=message):
        evaluate_program(program, **{"env_id": "Sized-v0", **arguments})


def test_model_of_other_actions_is_not_evaluated():
    model = ReptilePPO("MlpPolicy", "Sized-v0", n_envs=1, interaction_history=False, **SMALL)
    with pytest.raises(ValueError, match=r"the model acts in Discrete\(2\); Sized-v0 has Discrete\(4\)"):
        evaluate_model(model, "Sized-v0", env_kwargs={"space": spaces.Discrete(4)})


def test_model_of_a_file_names_no_module_to_import(tmp_path):
    model = ReptilePPO("MlpPolicy", "CartPole-v1", n_envs=1, **SMALL)
    model.env_id = "not_imported_yet:Mine-v0"
    model.save(tmp_path / "model.zip")
    assert find_source(str(tmp_path / "model.zip")).env_id is None


def test_film_is_of_the_variation_that_is_asked_for(tmp_path, capsys):
    program = ReptilePPO("ProgPolicy", "Sized-v0", n_envs=1, **SMALL).program()
    program.save(tmp_path / "program.json")
    film = ["render", str(tmp_path / "program.json"), "-o", str(tmp_path / "film.gif")]
    assert run([*film, "--set", "nonsense=3"]) == 2
    assert "the reset option nonsense has no effect; Sized-v0 does not read it" in capsys.readouterr().err
    assert run([*film, "--set", "size=3"]) == 0
    said = capsys.readouterr().err
    assert "3 steps" in said
    assert "goal" not in said


def test_two_starts_of_a_training_are_refused(capsys):
    arguments = ["train", "--algo", "reptile_ppo", "--env", "CartPole-v1", "-n", "8", "-i", "x.zip"]
    assert run([*arguments, "--init-program", "y.json"]) == 2
    assert "two starts" in capsys.readouterr().err


def test_legend_of_a_comparison_is_shown(capsys):
    assert run(["compare", "Hanoi-v0", "Hanoi-v0", "--set", "n_discs=1", "--episodes", "1"]) == 0
    assert "[share solved]" in capsys.readouterr().out


def test_a_comparison_says_where_the_environments_differ(tmp_path, capsys):
    same, other = str(tmp_path / "same.json"), str(tmp_path / "other.json")
    program = load_pretrained("Hanoi-v0")
    program.save(same)
    program.metadata["env_kwargs"] = {"source": 2, "target": 0}
    program.save(other)
    arguments = ["--set", "n_discs=1", "--episodes", "1", "--json"]
    assert run(["compare", same, other, *arguments]) == 0
    printed = capsys.readouterr()
    assert f"The environments differ: each run acts in the one that it was trained in, {same} in " in printed.err
    assert f"{other} in {{'source': 2, 'target': 0}}." in printed.err.replace("\n", "")
    assert [row["env_kwargs"] for row in json.loads(printed.out)] == [{}, {"source": 2, "target": 0}]
    assert run(["compare", same, same, *arguments]) == 0
    assert "differ" not in capsys.readouterr().err
