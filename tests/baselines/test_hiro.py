"""HIRO: goals, relabelling, the replay buffer that serves both levels, a predict with a state, and that it learns."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecNormalize

from sb3_progpolicy import HIRO
from sb3_progpolicy.baselines.hiro.buffer import GoalReplayBuffer, Segments
from sb3_progpolicy.baselines.hiro.goals import candidate_goals, goal_transition, intrinsic_reward, scaled
from sb3_progpolicy.baselines.hiro.learning import low_batch, relabelled_goals
from sb3_progpolicy.interaction import VecInteractionHistory

SMALL = {
    "learning_starts": 40,
    "high_learning_starts": 60,
    "batch_size": 16,
    "goal_period": 5,
    "buffer_size": 1000,
    "policy_kwargs": {"net_arch": [16]},
    "device": "cpu",
    "seed": 0,
}


class Line(gym.Env):
    """A point that moves along one axis of two, from the middle; paid for being at the right end. 20 steps."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)

    def __init__(self, discrete=False, reward=1.0):
        self.action_space = spaces.Discrete(3, start=1) if discrete else spaces.Box(-1, 3, (1,), np.float32)
        self.reward = reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.steps = 0.0, 0
        return self._observation(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        # The middle of either action space stands still.
        self.x = float(np.clip(self.x + 0.2 * (np.asarray(action).item() - (1 if self.is_box else 2)), -2, 2))
        self.steps += 1
        return self._observation(), self.reward * self.x, False, self.steps == 20, {}

    @property
    def is_box(self):
        return isinstance(self.action_space, spaces.Box)

    def _observation(self):
        return np.array([self.x, 7.0], dtype=np.float32)


class Numbered(Line):
    """Observations that are no vectors."""

    observation_space = spaces.Discrete(5)


def model(env=None, **kwargs):
    return HIRO("MlpPolicy", env or Line(), **{**SMALL, **kwargs})


def test_goal_points_to_the_same_place_from_the_next_position():
    position, goal, following = th.tensor([[1.0, 2.0]]), th.tensor([[3.0, -1.0]]), th.tensor([[2.0, 2.5]])
    moved = goal_transition(position, goal, following)
    assert th.equal(following + moved, position + goal)


def test_intrinsic_reward_is_minus_the_distance_left():
    position, goal = th.zeros(1, 2), th.tensor([[3.0, 4.0]])
    assert intrinsic_reward(position, goal, position, th.ones(2)).item() == -5
    assert intrinsic_reward(position, goal, goal, th.ones(2)).item() == 0
    assert intrinsic_reward(position, goal, position, th.tensor([3.0, 4.0])).item() == pytest.approx(-(2**0.5))
    # A dimension without goals does not count.
    assert intrinsic_reward(position, goal, position, th.tensor([1.0, 0.0])).item() == -3


def test_candidates_are_the_original_the_reached_and_eight_around_it():
    th.manual_seed(0)
    scale = th.tensor([2.0, 0.0])
    goals, start, end = th.tensor([[0.9, 0.0]]), th.zeros(1, 2), th.tensor([[-1.0, 3.0]])
    candidates = candidate_goals(goals, start, end, scale)
    assert candidates.shape == (1, 10, 2)
    assert candidates[0, 0].tolist() == pytest.approx([0.9, 0])
    assert candidates[0, 1].tolist() == [-0.5, 0.0]
    assert candidates.abs().max() <= 1
    many = candidate_goals(goals.repeat(5000, 1), start, end.repeat(5000, 1) * 0, th.ones(2))[:, 2:]
    inside = many[many.abs() < 1]
    assert inside.abs().median().item() == pytest.approx(0.31, abs=0.02)  # of a Gaussian of 0.5, cut at 1


def filled(n_steps, n_envs=2, size=60, period=4, episode=6):
    """Return a buffer whose observations count steps; goals count segments."""
    box = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    buffer = GoalReplayBuffer(size * n_envs, box, box, "cpu", n_envs, n_goal_dims=1, goal_period=period)
    age, segment, in_episode = np.zeros(n_envs, np.int64), np.zeros(n_envs), np.arange(n_envs)
    for step in range(n_steps):
        in_episode += 1
        done = in_episode >= episode
        buffer.note_goals(segment[:, None].astype(np.float32), age)
        observation = np.full((n_envs, 1), step, np.float32)
        infos = [{"TimeLimit.truncated": env == 1} for env in range(n_envs)]
        buffer.add(observation, observation + 1, observation, np.ones(n_envs), done, infos)
        ended = done | (age == period - 1)
        age, segment = np.where(ended, 0, age + 1), segment + ended
        in_episode[done] = 0
    return buffer


@pytest.mark.parametrize("n_steps", [15, 59, 60, 61, 157])
def test_segments_are_whole_and_in_order_also_after_the_buffer_has_wrapped(n_steps):
    th.manual_seed(0)
    segments = filled(n_steps).sample_segments(300)
    lengths = segments.mask.sum(dim=1)
    assert set(lengths.tolist()) <= {4, 2, 1, 3}
    assert th.equal(segments.rewards[:, 0], lengths.float())
    start = segments.observations[:, 0, 0]
    assert th.equal(segments.ends[:, 0], start + lengths)
    assert start.min() >= n_steps - 60
    steps = start[:, None] + th.arange(4)
    assert th.equal(segments.observations[..., 0][segments.mask], steps[segments.mask])
    assert th.equal(segments.actions[..., 0][segments.mask], steps[segments.mask])
    # Episodes of 6 are cut into 4 and 2; those of the second environment ran out of time.
    assert set(segments.dones[lengths == 4].tolist()[0]) == {0.0}
    assert {0.0, 1.0} == set(segments.dones[lengths == 2][:, 0].tolist())


def test_steps_know_where_their_goal_was_proposed():
    th.manual_seed(0)
    steps = filled(157).sample_steps(500)
    since = steps.observations - steps.starts
    assert since.min() >= 0
    assert since.max() == 3
    assert th.equal(steps.next_observations, steps.observations + 1)


def test_buffer_without_a_finished_segment_gives_none():
    assert filled(1, n_envs=1).sample_segments(5) is None
    with pytest.raises(ValueError, match="the replay buffer is empty"):
        filled(0).sample_steps(1)


def test_segment_left_unfinished_by_a_new_start_is_not_sampled():
    buffer = filled(2, n_envs=1, episode=100)
    for age in range(4):
        buffer.note_goals(np.ones((1, 1), np.float32), np.array([age]))
        buffer.add(*(np.full((1, 1), 10.0 + age, np.float32),) * 3, np.ones(1), np.zeros(1), [{}])
    assert set(buffer.sample_segments(50).observations[:, 0, 0].tolist()) == {10.0}


class Follower(th.nn.Module):
    """A low level that moves in the goal's direction."""

    def forward(self, inputs):
        return inputs[:, 2:3].sign()


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_relabelling_finds_the_goal_that_explains_the_actions(direction):
    agent = model(goal_scale=1.0, goal_dims=[0])
    agent.policy.low.actor.forward = Follower().forward
    observations = th.zeros(6, 5, 2)
    observations[:, :, 0] = direction * 0.1 * th.arange(5)
    segments = Segments(
        observations,
        th.full((6, 5, 1), direction),
        th.ones(6, 5, dtype=th.bool),
        observations[:, -1] + th.tensor([direction * 0.1, 0.0]),
        th.zeros(6, 1),
        th.zeros(6, 1),
        th.full((6, 1), -0.9 * direction),
    )
    goals = relabelled_goals(agent.policy, segments)
    assert (goals[:, 0].sign() == direction).all()
    kept = segments._replace(goals=th.full((6, 1), 0.8 * direction))
    # The original comes first, and so is kept where it explains the actions as well as any.
    assert th.equal(relabelled_goals(agent.policy, kept), kept.goals)
    # Steps beyond the segment's end say nothing.
    short = segments._replace(actions=segments.actions.clone(), mask=segments.mask.clone())
    short.actions[:, 3:], short.mask[:, 3:] = -direction, False
    assert (relabelled_goals(agent.policy, short)[:, 0].sign() == direction).all()


def test_low_level_is_paid_for_what_is_left_of_the_goal():
    agent = model(goal_scale=2.0, goal_dims=[0]).learn(60)
    batch = low_batch(agent.policy, agent.replay_buffer.sample_steps(200), 0.9)
    assert th.allclose(batch.rewards[:, 0], -batch.next_observations[:, 2].abs(), atol=1e-5)
    moved = batch.next_observations[:, 0] - batch.observations[:, 0]
    assert th.allclose(batch.observations[:, 2] - moved / 2, batch.next_observations[:, 2], atol=1e-5)


def test_predict_keeps_its_goal_for_a_period_and_starts_anew_with_an_episode():
    agent = model()
    observation, state, ages, goals = np.zeros((2, 2), np.float32), None, [], []
    for step in range(12):
        observation[:, 0] += 0.1
        episode_start = np.array([step == 0, step in (0, 7)])
        _, state = agent.predict(observation, state, episode_start, deterministic=True)
        ages.append(state.ages.tolist())
        goals.append(state.goals.copy())
        assert state.goals.shape == (2, 2)
    assert [age for age, _ in ages] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1]
    assert [age for _, age in ages] == [0, 1, 2, 3, 4, 0, 1, 0, 1, 2, 3, 4]
    np.testing.assert_array_equal(goals[0], goals[4])
    assert (goals[5] != goals[4]).any()
    with pytest.raises(ValueError, match="the state is of 2 environments; there are 3 observations"):
        agent.predict(np.zeros((3, 2), np.float32), state)


def test_predict_takes_single_observations():
    agent = model()
    action, state = agent.predict(np.zeros(2, np.float32))
    assert action.shape == (1,)
    assert agent.predict(np.zeros(2, np.float32), state)[1].ages.tolist() == [1]
    with pytest.raises(FloatingPointError, match="the observation is not finite"):
        agent.predict(np.array([np.inf, 0], np.float32))


@pytest.mark.parametrize("discrete", [False, True])
def test_learns_to_go_where_the_reward_is(discrete):
    env = make_vec_env(lambda: Line(discrete), 4, seed=0)
    agent = model(
        env,
        goal_dims=[0],
        learning_starts=80,
        high_learning_starts=240,
        batch_size=32,
        gradient_steps=2,
        learning_rate=3e-3,
        policy_kwargs={"net_arch": [32, 32], "optimizer_kwargs": {"fused": True}},
    ).learn(960)
    mean, _ = evaluate_policy(agent, make_vec_env(lambda: Line(discrete), 3, seed=1), 6, deterministic=True)
    assert mean > 20  # 36 at best, 0 at random
    assert agent.policy.goal_scale.item() > 0.5


@pytest.mark.parametrize("discrete", [False, True])
def test_saved_model_predicts_and_learns_on_alike(tmp_path, discrete):
    agent = model(make_vec_env(lambda: Line(discrete), 2, seed=0), goal_scale="auto").learn(200)
    assert agent.policy.goal_scale[1] == 0  # what never changes has no goals
    agent.save(tmp_path / "model")
    loaded = HIRO.load(tmp_path / "model", device="cpu")
    other = model(Line(discrete), seed=9)
    other.set_parameters(agent.get_parameters())
    scale = agent.policy.goal_scale.clone()
    rng, states = np.random.default_rng(0), [None, None, None]
    for _ in range(12):
        observations = rng.normal(size=(3, 2)).astype(np.float32)
        outcomes = [
            m.predict(observations, state, deterministic=True)
            for m, state in zip((agent, loaded, other), states, strict=True)
        ]
        states = [state for _, state in outcomes]
        for actions, state in outcomes[1:]:
            np.testing.assert_array_equal(actions, outcomes[0][0])
            np.testing.assert_array_equal(state.goals, outcomes[0][1].goals)
    reloaded = HIRO.load(tmp_path / "model", env=make_vec_env(lambda: Line(discrete), 3, seed=0), device="cpu")
    reloaded.learn(90, reset_num_timesteps=False)
    assert reloaded.num_timesteps == 290
    other.learn(60)
    # Measured once, also where it was copied rather than loaded.
    assert th.equal(reloaded.policy.goal_scale, scale)
    assert th.equal(other.policy.goal_scale, scale)
    agent.save_replay_buffer(tmp_path / "buffer")
    loaded = HIRO.load(tmp_path / "model", env=make_vec_env(lambda: Line(discrete), 2, seed=0), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.replay_buffer.size() == 110


def test_model_with_a_history_is_loaded_without_an_environment(tmp_path):
    agent = model(VecInteractionHistory(make_vec_env(lambda: Line(True), 2, seed=0)), goal_scale="auto").learn(80)
    assert agent.policy.goal_dims.tolist() == [0, 1]  # of seven numbers
    agent.save(tmp_path / "model")
    loaded = HIRO.load(tmp_path / "model", device="cpu")
    observation = np.ones((1, 7), np.float32)
    actions = [one.predict(observation, deterministic=True)[0] for one in (loaded, agent)]
    np.testing.assert_array_equal(*actions)
    assert loaded.policy.goal_dims.tolist() == [0, 1]


def test_networks_may_be_named_again_in_loading(tmp_path):
    model().save(tmp_path / "model")
    assert HIRO.load(tmp_path / "model", policy_kwargs=SMALL["policy_kwargs"], device="cpu").goal_period == 5


def test_same_seed_trains_the_same():
    first, second = (model().learn(120).get_parameters()["policy"] for _ in range(2))
    assert all(th.equal(first[key], second[key]) for key in first)


def test_runs_with_normalised_observations_and_rewards():
    agent = model(VecNormalize(make_vec_env(Line, 2, seed=0))).learn(200)
    assert np.isfinite(agent.predict(np.zeros((2, 2), np.float32))[0]).all()


def test_actions_are_within_their_bounds():
    noise = NormalActionNoise(np.zeros(1), np.full(1, 5.0))
    model(make_vec_env(Line, 2, seed=0), action_noise=noise).learn(200)  # Line checks them


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal_dims": [0, 2]}, r"goal_dims=\[0, 2\] is not accepted; .* from 0 to 1"),
        ({"goal_dims": [0.5]}, r"goal_dims=\[0.5\] is not accepted"),
        ({"goal_dims": []}, r"goal_dims=\[\] is not accepted"),
        ({"goal_dims": [1, 1]}, r"goal_dims=\[1, 1\] is not accepted"),
        (
            {"goal_scale": [1.0, 2.0, 3.0]},
            "goal_scale=.* is not accepted; it is 'auto', a number above 0, or 2 of them",
        ),
        ({"goal_scale": 0.0}, "goal_scale=0.0 is not accepted"),
        ({"goal_scale": "large"}, "goal_scale='large' is not accepted"),
        ({"learning_starts": 4}, "learning_starts=4 is too few to measure goal_scale='auto'"),
        ({"policy_kwargs": {"goal_dims": [0]}}, r"policy_kwargs has \['goal_dims'\]; give them as arguments"),
        ({"goal_period": 0}, "goal_period=0 is not accepted; it is at least 1"),
        ({"goal_noise": -1}, "goal_noise=-1 is not accepted; it is at least 0"),
        ({"reward_scale": 0}, "reward_scale=0 is not accepted; it is more than 0"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        model(**arguments)


def test_wrong_spaces_are_named():
    with pytest.raises(ValueError, match=r"HIRO takes observations that are vectors .*FlattenObservation"):
        HIRO("MlpPolicy", Numbered())
    with pytest.raises(ValueError, match="accepted only for Box actions"):
        model(Line(discrete=True), action_noise=NormalActionNoise(np.zeros(1), np.ones(1)))
    with pytest.raises(ValueError, match="finds no change along goal_dims=\\[1\\]"):
        model(goal_dims=[1]).learn(60)


def test_training_stops_at_a_reward_that_is_not_finite():
    with pytest.raises(FloatingPointError, match="reward of environment 0 is not finite"):
        model(Line(reward=np.nan)).learn(60)


def test_loss_that_is_not_finite_does_not_reach_the_parameters():
    agent = model(Line(reward=1e25))
    with pytest.raises(FloatingPointError, match="the loss is not finite"):
        agent.learn(100)  # the square of the reward is too large for a float
    assert all(bool(th.isfinite(parameter).all()) for parameter in agent.policy.parameters())


def test_scaled_goals_are_zero_without_a_scale():
    assert scaled(th.tensor([3.0, 4.0]), th.tensor([2.0, 0.0])).tolist() == [1.5, 0.0]
