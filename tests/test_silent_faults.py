"""What must not go wrong without a word."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_progpolicy import (
    Evaluation,
    InteractionHistory,
    ProgrammaticPolicy,
    ReptileCheckpoint,
    ReptilePPO,
    ReptileWrapper,
    TaskDistribution,
    evaluate_model,
    evaluate_program,
    extract_program,
)
from sb3_progpolicy.experiment.config import make_config
from sb3_progpolicy.experiment.run import build_model
from sb3_progpolicy.interaction import VecInteractionHistory
from sb3_progpolicy.programs import ProgramRunner

SMALL = {"n_steps": 16, "batch_size": 32, "n_epochs": 2, "seed": 0, "device": "cpu"}


class Broken(gym.Env):
    """Gives a number that is not finite at its 55th step."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, what):
        self.what, self.n_steps = what, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.n_steps += 1
        now = self.n_steps == 55
        observation = np.full(2, np.inf if now and self.what == "observation" else 0.5, np.float32)
        return observation, np.nan if now and self.what == "reward" else 1.0, self.n_steps % 10 == 0, False, {}


def broken(what):
    return DummyVecEnv([lambda: Broken("nothing"), lambda: Broken(what), lambda: Broken("nothing")])


@pytest.mark.parametrize("what", ["reward", "observation"])
def test_training_stops_at_what_is_not_finite_and_the_checkpoint_stays_finite(what, tmp_path):
    model = ReptilePPO("ProgPolicy", broken(what), normalize_observations=True, scale_rewards=True, **SMALL)
    checkpoint = ReptileCheckpoint(tmp_path / "model.zip")
    with pytest.raises(FloatingPointError, match=f"the {what} of environment 1 is not finite .* at step 165"):
        model.learn(3000, callback=checkpoint)
    checkpoint.save()
    for parameter in (
        *model.policy.state_dict().values(),
        *ReptilePPO.load(tmp_path / "model.zip").policy.parameters(),
    ):
        assert th.isfinite(parameter).all()


@pytest.mark.parametrize("what", ["reward", "observation"])
def test_callback_stops_stock_algorithms_too(what):
    model = PPO("MlpPolicy", broken(what), **SMALL)
    with pytest.raises(FloatingPointError, match=f"the {what} of environment 1"):
        model.learn(3000, callback=ReptileWrapper(TaskDistribution([{}])))
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


def test_parameter_that_explodes_is_named():
    model = ReptilePPO("MlpPolicy", "CartPole-v1", n_envs=4, learning_rate=1e30, max_grad_norm=1e30, **SMALL)
    with pytest.raises(FloatingPointError, match=r"(parameter .*|the loss) is not finite"):
        model.learn(2000)


def test_reset_option_that_nothing_reads_is_an_error():
    tasks = TaskDistribution({"g": [1.0, 20.0]})
    with pytest.raises(ValueError, match=r"the reset option g has no effect; Pendulum-v1 does not read it"):
        ReptilePPO("ProgPolicy", make_vec_env("Pendulum-v1", 2), tasks=tasks, **SMALL).learn(64)
    with pytest.raises(ValueError, match="apply='constructor'"):
        PPO("MlpPolicy", make_vec_env("Pendulum-v1", 2), **SMALL).learn(64, callback=ReptileWrapper(tasks))
    # One that is read is accepted.
    ReptilePPO("ProgPolicy", make_vec_env("Pendulum-v1", 2), tasks={"x_init": [0.1]}, **SMALL).learn(64)


class Gravity(gym.Env):
    """One step; it succeeds where the constructor's gravity is 2, whatever the reset options say."""

    observation_space, action_space = gym.spaces.Box(-9, 9, (1,)), gym.spaces.Discrete(2)

    def __init__(self, gravity=1.0, render_mode=None):
        self.gravity = gravity

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([self.gravity], np.float32), {}

    def step(self, action):
        done = self.gravity == 2.0
        return np.array([self.gravity], np.float32), 0.0, True, False, {"is_success": done}


@pytest.fixture
def gravity_env():
    gym.register("Gravity-v0", entry_point=Gravity, max_episode_steps=5)
    yield "Gravity-v0"
    del gym.registry["Gravity-v0"]


def test_variation_that_only_the_constructor_takes_is_made_by_it(gravity_env, tmp_path):
    said = r"Gravity-v0 does not read the reset option gravity, .* \(apply='constructor'\)"
    tasks = {"gravity": [1.0, 2.0]}
    with pytest.warns(UserWarning, match=said):
        model = ReptilePPO("ProgPolicy", gravity_env, tasks=tasks, n_envs=2, tasks_per_iteration=2, **SMALL)
    model.learn(64)
    assert model.tasks.success_rates.tolist() == [0.0, 1.0]
    model.save(tmp_path / "model.zip")
    ReptilePPO.load(tmp_path / "model.zip", env=gravity_env).learn(64)
    config = make_config("ppo", gravity_env, 0, overrides={"tasks": [{"gravity": 1.0}, {"gravity": 2.0}]})
    with pytest.warns(UserWarning, match=said):
        assert build_model(config)[1].tasks.apply == "constructor"
    rows = evaluate_program(model.program(), gravity_env, [{"gravity": 1.0}, {"gravity": 2.0}], n_episodes=2)
    assert [row.success_rate for row in rows] == [0.0, 1.0]


def test_evaluation_of_a_variation_that_nothing_reads_is_an_error(gravity_env):
    program = ReptilePPO("ProgPolicy", gravity_env, n_envs=2, **SMALL).program()
    with pytest.raises(ValueError, match="the reset option mass has no effect"):
        evaluate_program(program, gravity_env, [{"mass": 1.0}], n_episodes=2)


def test_labels_are_short_unique_and_rounded():
    tasks = TaskDistribution({"force_mag": [10.0], "length": [0.30000000000000004, 0.5], "masspole": [0.1, 0.25]})
    labels = [tasks.label(index) for index in range(4)]
    assert labels[0] == "length=0.3,masspole=0.1"
    long = TaskDistribution([{"a_rather_long_name_of_a_parameter": value, "b": 1} for value in (1, 2)])
    drawn = TaskDistribution([{"length": lambda rng: 1.0}, {"length": lambda rng: 2.0}])
    arrays = TaskDistribution([{"wind": np.array([0.0, 1.0])}, {"wind": np.array([0.0, 2.0])}])
    for tasks in (long, drawn, arrays):
        labels = [tasks.label(index) for index in range(len(tasks))]
        assert len({label[:30] for label in labels}) == 2
        assert max(map(len, labels)) <= 30


def test_training_with_long_labels_logs(capsys):
    tasks = TaskDistribution(
        {"length": [0.30000000000000004, 0.5], "masspole": [0.1, 0.25], "force_mag": [9.123456789, 10.0]},
        apply="attributes",
    )
    ReptilePPO(
        "MlpPolicy", make_vec_env("CartPole-v1", 8), tasks=tasks, tasks_per_iteration=8, verbose=1, **SMALL
    ).learn(800)
    assert "0:length" in capsys.readouterr().out


@pytest.mark.parametrize("n_envs", [1, 2, 3, 5, 6, 7, 12])
@pytest.mark.parametrize("policy", ["ProgPolicy", "MlpLstmPolicy"])
def test_defaults_are_accepted_with_any_number_of_environments(policy, n_envs):
    model = ReptilePPO(policy, "Hanoi-v0", n_envs=n_envs, n_steps=48)
    assert 1 <= model.batch_size <= 48 * n_envs


def test_prediction_for_one_observation_is_an_array_as_in_sb3():
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=1, **SMALL)
    action, _ = model.predict(np.zeros(17, np.float32), deterministic=True)
    assert isinstance(action, np.ndarray)
    assert action.shape == ()


def test_plain_observations_and_reset_tuples_are_explained():
    model, env = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=1, **SMALL), gym.make("Hanoi-v0")
    with pytest.raises(ValueError, match="InteractionHistory"):
        model.predict(env.reset()[0])
    with pytest.raises(ValueError, match="mixing Gym API"):  # the words of SB3's own error
        model.predict(InteractionHistory(env).reset())


class Minus(BaseFeaturesExtractor):
    def __init__(self, space):
        super().__init__(space, space.shape[0])

    def forward(self, x):
        return -x


@pytest.mark.parametrize("algorithm", [ReptilePPO, PPO])
def test_features_extractor_that_a_program_cannot_hold_is_refused(algorithm):
    policy = "PRLPolicy" if algorithm is ReptilePPO else ProgrammaticPolicy
    with pytest.raises(ValueError, match="features_extractor_class=Minus"):
        algorithm(policy, "CartPole-v1", policy_kwargs={"features_extractor_class": Minus})


def test_architecture_of_the_actor_is_refused_and_that_of_the_critic_taken():
    with pytest.raises(ValueError, match="the actor is a program"):
        PPO(ProgrammaticPolicy, "CartPole-v1", policy_kwargs={"net_arch": {"pi": [8], "vf": [8]}})
    model = PPO(ProgrammaticPolicy, "CartPole-v1", policy_kwargs={"net_arch": {"vf": [7]}})
    assert model.policy.value_net.in_features == 7


def test_architecture_in_the_form_of_old_sb3_is_taken_with_a_warning():
    with pytest.warns(UserWarning, match="without a list"):
        model = PPO(ProgrammaticPolicy, "CartPole-v1", policy_kwargs={"net_arch": [{"vf": [7]}]})
    assert model.policy.value_net.in_features == 7


def test_dict_observations_are_refused_by_name():
    env = gym.Env()
    env.observation_space, env.action_space = spaces.Dict({"a": spaces.Box(-1, 1, (2,))}), spaces.Discrete(2)
    with pytest.raises(ValueError, match=r"Dict.* is not accepted.*FlattenObservation"):
        ReptilePPO(MultiInputActorCriticPolicy, env, interaction_history=False, **SMALL)


def test_rollouts_are_collected_outside_of_learning_as_in_sb3():
    model = ReptilePPO("ProgPolicy", "CartPole-v1", n_envs=4, **{**SMALL, "n_steps": 64})
    _, callback = model._setup_learn(total_timesteps=256)
    assert model.collect_rollouts(model.get_env(), callback, model.rollout_buffer, model.n_steps)
    assert len(model.ep_info_buffer) > 0


def test_discrete_observations_fill_the_buffer():
    model = ReptilePPO("MlpPolicy", "FrozenLake-v1", n_envs=4, interaction_history=False, **SMALL).learn(128)
    assert model.num_timesteps == 128


class NoTerminalObservation(DummyVecEnv):
    """As some VecEnv of others: an episode is cut off, and its last observation is not told."""

    def step_wait(self):
        observations, rewards, dones, infos = super().step_wait()
        for info in infos:
            info.pop("terminal_observation", None)
        return observations, rewards, dones, infos


def test_environments_without_terminal_observations_are_trained_on():
    env = NoTerminalObservation([lambda: gym.make("Pendulum-v1", max_episode_steps=10)] * 2)
    model = ReptilePPO("ProgPolicy", env, **SMALL).learn(64)
    assert model.num_timesteps == 64


def test_statistics_of_the_critic_move_too_where_it_has_its_own():
    kwargs = {"share_features_extractor": False}
    model = ReptilePPO(
        "ProgPolicy", "Pendulum-v1", n_envs=2, normalize_observations=True, policy_kwargs=kwargs, **SMALL
    )
    model.learn(64)
    actor, critic = model.policy.pi_features_extractor, model.policy.vf_features_extractor
    assert actor is not critic
    assert critic.mean.abs().max() > 0
    th.testing.assert_close(actor.mean, critic.mean)


def test_evaluation_of_numpy_values_is_json():
    row = Evaluation(
        "X-v0", {"wind": np.array([1.0, 2.0]), "n": np.int64(3)}, 1, np.float64(1.0), 2.0, 0.0, None, "soft", 0.0, 0.0
    )
    assert json.loads(json.dumps(row.to_json()))["variation"] == {"wind": [1.0, 2.0], "n": 3}


@pytest.mark.parametrize("names", [None, ["a", "b", "c"], np.array(["a", "b", "c"])])
def test_names_are_taken_from_lists_and_arrays_and_none_is_none(names):
    class Named(gym.Wrapper):
        observation_names = names

    env = DummyVecEnv([lambda: Named(gym.make("Pendulum-v1"))])
    model = ReptilePPO("ProgPolicy", env, **{**SMALL, "batch_size": 8})
    assert model.program().input_names[:3] == (
        ("a", "b", "c") if names is not None else ("cos angle", "sin angle", "velocity")
    )


# What stands between the environment and the model


@pytest.mark.parametrize("norm_reward", [False, True])
@pytest.mark.parametrize("algorithm", [PPO, ReptilePPO])
def test_statistics_of_vec_normalize_are_folded_into_the_program(algorithm, norm_reward):
    venv = VecNormalize(make_vec_env("Pendulum-v1", 4, seed=0), norm_reward=norm_reward)
    policy = ProgrammaticPolicy if algorithm is PPO else "ProgPolicy"
    kwargs = (
        {"policy_kwargs": {"depth": 1}} if algorithm is PPO else {"interaction_history": False, "search_fraction": 0.0}
    )
    model = algorithm(policy, venv, **{**SMALL, "n_steps": 64}, **kwargs).learn(1024)
    venv.training, program = False, extract_program(model)
    runner, observations, state = ProgramRunner(program, 4, "soft"), venv.reset(), None
    for _ in range(100):
        actions, state = model.predict(observations, state, deterministic=True)
        np.testing.assert_allclose(runner.act(venv.get_original_obs()), actions, atol=1e-4)
        observations, *_ = venv.step(actions)


def test_program_that_reads_scaled_rewards_is_refused():
    venv = VecNormalize(make_vec_env("Pendulum-v1", 4, seed=0))
    with pytest.raises(ValueError, match="scale_rewards=True"):
        ReptilePPO("ProgPolicy", venv, **SMALL)
    model = PPO(ProgrammaticPolicy, VecInteractionHistory(venv), **SMALL).learn(64)
    with pytest.raises(ValueError, match="scale_rewards=True"):
        extract_program(model)


def test_model_is_evaluated_with_the_statistics_of_its_environment():
    venv = VecNormalize(make_vec_env("Hanoi-v0", 4, env_kwargs={"n_discs": 1}))
    model, seen = PPO("MlpPolicy", venv, **SMALL).learn(256), []
    predict = model.predict

    def watched(observation, *arguments, **kwargs):
        seen.append(observation)
        return predict(observation, *arguments, **kwargs)

    model.predict = watched
    evaluate_model(model, "Hanoi-v0", [{"n_discs": 1}], max_steps=3)
    raw = gym.make("Hanoi-v0", n_discs=1).reset()[0]
    np.testing.assert_allclose(seen[0][0], venv.normalize_obs(raw))
    assert np.abs(seen[0][0] - raw).max() > 0.1


def test_wrappers_that_an_id_does_not_bring_back_are_named_and_evaluation_by_id_is_refused(tmp_path):
    def wrapped():
        env = gym.make("Hanoi-v0", n_discs=1)
        return gym.wrappers.TransformObservation(env, lambda x: -x, env.observation_space)

    model = ReptilePPO("ProgPolicy", DummyVecEnv([wrapped] * 2), **SMALL).learn(64)
    program = model.program()
    assert program.metadata["wrappers"] == ["TransformObservation"]
    with pytest.raises(ValueError, match="wrapped in TransformObservation"):
        evaluate_program(program, variations=[{"n_discs": 1}])
    model.save(tmp_path / "model")
    for network in (model, ReptilePPO.load(tmp_path / "model"), PPO("MlpPolicy", DummyVecEnv([wrapped]), **SMALL)):
        with pytest.raises(ValueError, match="wrapped in TransformObservation"):
            evaluate_model(network, "Hanoi-v0", [{"n_discs": 1}])
    stacked = PPO("MlpPolicy", VecFrameStack(make_vec_env("Hanoi-v0", 2), 2), **SMALL)
    with pytest.raises(ValueError, match="wrapped in VecFrameStack"):
        evaluate_model(stacked, "Hanoi-v0", [{"n_discs": 1}])
    assert "wrappers" not in ReptilePPO("ProgPolicy", make_vec_env("Hanoi-v0", 2), **SMALL).program().metadata
