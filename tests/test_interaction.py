"""The interaction history: the two wrappers agree, and say what happened."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_progpolicy import InteractionHistory, VecInteractionHistory
from sb3_progpolicy.interaction import program_names
from sb3_progpolicy.names import GYMNASIUM_NAMES, readable_names
from sb3_progpolicy.spaces import action_spec, encode_actions

ACTION_SPACES = {
    "discrete": spaces.Discrete(3, start=-1),
    "box": spaces.Box(-1, 1, (2,), np.float32),
    "multi_discrete": spaces.MultiDiscrete([2, 3]),
    "multi_binary": spaces.MultiBinary(2),
}


class Echo(gym.Env):
    """Rewards are the step number; every other episode is truncated after 3 steps, the others end after 4."""

    observation_space = spaces.Box(-100, 100, (2,), np.float64)

    def __init__(self, kind="discrete"):
        self.action_space = ACTION_SPACES[kind]
        self.episode = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.episode = 0, self.episode + 1
        return np.array([self.t, self.episode], float), {}

    def step(self, action):
        self.t += 1
        observation = np.array([self.t, self.episode], float)
        truncated = self.episode % 2 == 0 and self.t == 3
        return observation, float(self.t), self.t == 4, truncated, {}


@pytest.mark.parametrize("kind", ACTION_SPACES)
def test_both_wrappers_agree_step_for_step(kind):
    single = DummyVecEnv([lambda: InteractionHistory(Echo(kind))] * 2)
    batched = VecInteractionHistory(DummyVecEnv([lambda: Echo(kind)] * 2))
    assert single.observation_space == batched.observation_space
    single.action_space.seed(0)
    observations = [env.reset() for env in (single, batched)]
    np.testing.assert_array_equal(*observations)
    ends = 0
    for _ in range(30):
        actions = np.stack([single.action_space.sample() for _ in range(2)])
        (a, *first, infos_a), (b, *second, infos_b) = single.step(actions), batched.step(actions)
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype == np.float32
        np.testing.assert_array_equal(first, second)
        assert batched.observation_space.contains(b[0])
        for info_a, info_b, done in zip(infos_a, infos_b, first[1], strict=True):
            assert ("terminal_observation" in info_a) == ("terminal_observation" in info_b) == done
            if done:
                np.testing.assert_array_equal(info_a["terminal_observation"], info_b["terminal_observation"])
                ends += 1
    assert ends > 10


def test_history_is_what_was_done_and_survives_the_end_of_an_episode():
    env = InteractionHistory(Echo())
    observation, _ = env.reset()
    np.testing.assert_array_equal(observation, [0, 1, 0, 0, 0, 0, 0])
    for action, one_hot in ((-1, [1, 0, 0]), (1, [0, 0, 1]), (0, [0, 1, 0])):
        observation, reward, *_ = env.step(action)
        np.testing.assert_array_equal(observation[2:], [*one_hot, reward, 0])
    observation, *_ = env.step(0)
    np.testing.assert_array_equal(observation, [4, 1, 0, 1, 0, 4, 1])
    observation, _ = env.reset()
    np.testing.assert_array_equal(observation, [0, 2, 0, 1, 0, 4, 1])


@pytest.mark.parametrize("arguments", [{"seed": 0}, {"options": {"any": 1}}])
def test_history_is_zero_after_a_reset_that_starts_a_task(arguments):
    env = InteractionHistory(Echo())
    env.reset()
    env.step(1)
    observation, _ = env.reset(**arguments)
    np.testing.assert_array_equal(observation[2:], np.zeros(5))


def test_vectorised_history_is_zero_after_reset():
    env = VecInteractionHistory(DummyVecEnv([Echo] * 3))
    env.reset()
    env.step(np.array([0, 1, 1]))
    np.testing.assert_array_equal(env.reset()[:, 2:], np.zeros((3, 5)))


def test_terminal_observation_of_a_truncated_episode_is_not_marked_as_the_end():
    env = VecInteractionHistory(DummyVecEnv([Echo]))
    env.reset()
    ends = []
    for _ in range(7):
        observation, _, dones, infos = env.step(np.array([1]))
        if dones[0]:
            ends.append(infos[0]["terminal_observation"])
            assert observation[0, -1] == 1  # the next episode begins after an end, whichever
    np.testing.assert_array_equal(ends[0], [4, 1, 0, 0, 1, 4, 1])  # terminated
    np.testing.assert_array_equal(ends[1], [3, 2, 0, 0, 1, 3, 0])  # truncated


# The checker's advice on the bounds of a space and on checking unwrapped environments is not for a wrapper.
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Hanoi-v0", "Pendulum-v1"])
def test_wrapped_environment_passes_gymnasiums_checker(env_id):
    check_env(InteractionHistory(gym.make(env_id).unwrapped), skip_render_check=True)


def test_discrete_actions_are_one_hot_and_others_raw():
    def encode(kind, actions):
        return encode_actions(np.array(actions), action_spec(ACTION_SPACES[kind])).tolist()

    assert encode("discrete", [-1, 1]) == [[1, 0, 0], [0, 0, 1]]
    assert encode("multi_discrete", [[1, 2], [0, 0]]) == [[0, 1, 0, 0, 1], [1, 0, 1, 0, 0]]
    assert encode("multi_binary", [[1, 0]]) == [[1, 0]]
    assert encode("box", [[0.5, -1.0]]) == [[0.5, -1.0]]


@pytest.mark.parametrize(
    "space",
    [
        spaces.Text(3),
        spaces.MultiDiscrete([[2, 2]]),
        spaces.MultiDiscrete([2, 2], start=[1, 0]),
        spaces.MultiBinary([2, 2]),
    ],
)
def test_action_spaces_that_a_program_cannot_act_in_are_refused(space):
    with pytest.raises(ValueError, match="is not accepted"):
        action_spec(space)


def test_observations_that_a_program_cannot_read_are_refused():
    with pytest.raises(ValueError, match="FlattenObservation"):
        InteractionHistory(gym.make("FrozenLake-v1"))


def test_names_come_from_the_environment_or_are_numbered():
    hanoi = VecInteractionHistory(DummyVecEnv([lambda: gym.make("Hanoi-v0")]))
    inputs, outputs = program_names(hanoi)
    assert inputs[0] == "rank[0]"
    assert inputs[9] == "previous move 0->1"
    assert inputs[-2:] == ("previous reward", "previous done")
    assert len(inputs) == hanoi.observation_space.shape[0]
    assert outputs[0] == "move 0->1"


def test_gymnasiums_own_tasks_have_names_too():
    inputs, outputs = program_names(VecInteractionHistory(DummyVecEnv([lambda: gym.make("MountainCar-v0")])))
    assert outputs == ("push left", "no push", "push right")
    history = (*(f"previous {name}" for name in outputs), "previous reward", "previous done")
    assert inputs == ("position", "velocity", *history)


@pytest.mark.parametrize("name", GYMNASIUM_NAMES)
def test_names_of_gymnasiums_tasks_fit_all_their_versions_that_can_be_made(name):
    versions = [spec.id for spec in gym.registry.values() if spec.id.rpartition("-v")[0] == name]
    assert versions
    for version in versions:
        try:
            env = gym.make(version)
        except gym.error.DependencyNotInstalled:
            pytest.skip("LunarLander needs box2d")
        except gym.error.DeprecatedEnv:
            continue
        known = GYMNASIUM_NAMES[name]
        assert len(known.observations) == env.observation_space.shape[0]
        assert len(known.actions) == action_spec(env.action_space).n_outputs


def test_without_names_inputs_and_outputs_are_numbered():
    names = readable_names(None, None, "Mine-v0", 2, 1, history=False)
    assert names == (("observation[0]", "observation[1]"), ("action[0]",))
    # A wrapper has changed how many there are: the names would be those of other numbers.
    assert readable_names(("a", "b"), None, "Pendulum-v1", 5, 1, history=False).observations[0] == "observation[0]"
