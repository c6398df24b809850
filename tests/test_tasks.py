"""Task distributions: what is drawn, when, and how it is put in force in a real environment."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from progpolicy_envs import DOMAINS
from sb3_progpolicy import ReptilePPO, ReptileWrapper, TaskDistribution
from sb3_progpolicy.reptile.checks import check_variations
from sb3_progpolicy.reptile.samplers import CurriculumSampler, FailureSampler, ProgressSampler, make_sampler
from sb3_progpolicy.reptile.tasks import RemakeOnVariation, default_tasks
from sb3_progpolicy.vec_env import make_fast_vec_env


def drawn(tasks, n, progress=0.0, seed=0):
    rng = np.random.default_rng(seed)
    return [tasks.sample(rng, progress)[0] for _ in range(n)]


def test_mapping_makes_all_combinations_and_a_list_is_taken_as_it_is():
    tasks = TaskDistribution({"a": [1, 2], "b": range(3, 5), "c": np.array([0.5])})
    assert tasks.variations == [{"a": a, "b": b, "c": 0.5} for a in (1, 2) for b in (3, 4)]
    assert len(tasks) == 4
    assert TaskDistribution([{"a": 1}, {"a": 2}]).variations == [{"a": 1}, {"a": 2}]


def test_callables_are_drawn_anew_each_time():
    tasks = TaskDistribution({"n": [1, 2], "length": lambda rng: rng.uniform(0.3, 1.0)})
    assert len(tasks) == 2
    lengths = [variation["length"] for _, variation in drawn(tasks, 50)]
    assert len(set(lengths)) == 50
    assert 0.3 <= min(lengths) < max(lengths) <= 1.0


def test_equal_seeds_draw_equal_tasks():
    tasks = TaskDistribution({"n": range(9), "x": lambda rng: rng.normal()})
    assert drawn(tasks, 30, seed=1) == drawn(tasks, 30, seed=1)
    assert drawn(tasks, 30, seed=1) != drawn(tasks, 30, seed=2)


def test_uniform_sampler_draws_all_equally_often():
    counts = np.bincount([index for index, _ in drawn(TaskDistribution({"n": range(4)}), 4000)])
    np.testing.assert_allclose(counts, 1000, atol=120)


def test_curriculum_lets_in_one_variation_after_the_other():
    tasks = TaskDistribution({"n": range(4)}, sampler=CurriculumSampler(fraction=0.8))
    for progress, let_in in ((0.0, 1), (0.19, 1), (0.21, 2), (0.41, 3), (0.61, 4), (1.0, 4)):
        assert {index for index, _ in drawn(tasks, 100, progress)} == set(range(let_in))


def test_failure_sampler_prefers_what_fails():
    tasks = TaskDistribution({"n": range(3)}, sampler=FailureSampler(floor=0.1))
    tasks.record(0, 1.0)
    tasks.record(1, 0.0)
    counts = np.bincount([index for index, _ in drawn(tasks, 2300)])
    np.testing.assert_allclose(counts, [100, 1100, 1100], atol=110)  # the third is untried: as if it failed


def progressing(scores, sampler="progress", as_return=False):
    """A distribution whose variations have had these successes, or returns, one after the other."""
    tasks = TaskDistribution({"n": range(len(scores))}, sampler=sampler)
    for index, values in enumerate(scores):
        for value in values:
            tasks.record(index, None if as_return else value, value if as_return else None)
    return tasks


@pytest.mark.parametrize("as_return", [False, True])
def test_progress_sampler_prefers_what_changes_up_or_down(as_return):
    still, rises, falls = [0.5] * 20, [0.0] * 10 + [1.0] * 10, [1.0] * 10 + [0.0] * 10
    tasks = progressing([still, rises, falls], ProgressSampler(floor=0.3), as_return)
    assert tasks.learning_progress[0] == 0
    assert tasks.learning_progress[1] == pytest.approx(tasks.learning_progress[2])
    counts = np.bincount([index for index, _ in drawn(tasks, 3000)])
    np.testing.assert_allclose(counts, [300, 1350, 1350], atol=110)


def test_progress_is_measured_by_success_where_there_is_one():
    tasks = progressing([[0.5, 0.5]])
    tasks.record(0, 0.5, 1000.0)
    assert tasks.learning_progress[0] == 0


def test_progress_sampler_draws_what_is_new_as_often_as_what_changes_most():
    tasks = progressing([[0.0] * 5 + [1.0], [0.0] * 5 + [0.5], []], ProgressSampler(floor=0.1))
    counts = np.bincount([index for index, _ in drawn(tasks, 3000)])
    assert counts[2] == pytest.approx(counts[0], rel=0.15)
    assert counts[0] > 1.5 * counts[1]


def test_progress_sampler_is_uniform_before_anything_changes():
    for scores in ([[], [], []], [[0.5, 0.5]] * 3):
        counts = np.bincount([index for index, _ in drawn(progressing(scores), 3000)])
        np.testing.assert_allclose(counts, 1000, atol=110)


def test_old_progress_is_forgotten():
    tasks = progressing([[0.0] * 5 + [1.0]])
    before = tasks.learning_progress[0]
    for _ in range(100):
        tasks.record(0, 1.0)
    assert tasks.learning_progress[0] < 0.05 * before


def test_trained_model_tells_the_sampler_of_successes_or_of_returns(tmp_path):
    poles = TaskDistribution({"length": [0.3, 0.9]}, "progress", apply="attributes")
    discs = TaskDistribution({"n_discs": [1, 3]}, "progress")
    for env, tasks in ((make_vec_env("CartPole-v1", 4), poles), (make_fast_vec_env("Hanoi-v0", 4), discs)):
        model = ReptilePPO("ProgPolicy", env, tasks=tasks, seed=0, device="cpu").learn(4096)
        if tasks is poles:
            assert (poles.learning_progress > 0).all()
            assert np.isnan(poles.success_rates).all()
        else:
            np.testing.assert_array_equal(discs.scores[0], discs.success_rates)
        model.save(tmp_path / "model.zip")
        loaded = ReptilePPO.load(tmp_path / "model.zip", device="cpu")
        assert loaded.tasks.sampler == ProgressSampler()
        np.testing.assert_array_equal(loaded.tasks.scores, model.tasks.scores)


def test_sampler_is_given_by_itself_and_changed_in_loading(tmp_path):
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=2, sampler={"name": "curriculum", "fraction": 0.5})
    assert model.tasks.variations == list(DOMAINS["Hanoi-v0"].train)
    assert model.tasks.sampler == CurriculumSampler(0.5)
    given = TaskDistribution({"n_discs": [1, 2]}, "failure")
    assert ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=2, tasks=given).tasks.sampler == FailureSampler()
    assert ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=2, tasks=given, sampler="progress").tasks.sampler.floor == 0.2
    model.save(tmp_path / "model.zip")
    loaded = ReptilePPO.load(tmp_path / "model.zip", sampler="progress", device="cpu")
    assert loaded.tasks.sampler == ProgressSampler()


@pytest.mark.parametrize(("given", "message"), [
    ("best", "known samplers: uniform, curriculum, failure, progress"),
    ({"fraction": 0.5}, "known samplers"),
    ({"name": "curriculum", "fracton": 0.5}, "fracton=0.5 is not accepted; curriculum takes fraction"),
    ({"name": "uniform", "floor": 0.5}, "floor=0.5 is not accepted; uniform takes nothing"),
    ({"name": "progress", "floor": "much"}, "floor='much' is not accepted; it is a number"),
    ({"name": "progress", "floor": 0.0}, "floor=0.0 is not accepted; it is above 0 and at most 1"),
    ({"name": "progress", "floor": 1.5}, "floor=1.5 is not accepted"),
    ({"name": "curriculum", "fraction": 2}, "fraction=2 is not accepted"),
    (3, "known samplers"),
])  # fmt: skip
def test_sampler_that_there_is_not_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        make_sampler(given)


def test_success_rates_are_running_means():
    tasks = TaskDistribution({"n": range(2)})
    assert np.isnan(tasks.success_rates).all()
    tasks.record(1, 1.0)
    assert tasks.success_rates[1] == 1.0
    tasks.record(1, 0.0)
    assert tasks.success_rates[1] == pytest.approx(1 - TaskDistribution.SUCCESS_SMOOTHING)


def test_several_tasks_at_once_are_different_as_long_as_there_are_enough():
    tasks = TaskDistribution({"n": range(3)})
    for seed in range(20):
        indices = [index for index, _ in tasks.sample(np.random.default_rng(seed), n_tasks=5)]
        assert set(indices[:3]) == {0, 1, 2}
        assert len(set(indices[3:])) == 2


def test_domains_train_on_their_own_variations_and_others_as_they_are():
    for env_id in ("Hanoi-v0", "progpolicy_envs:Hanoi-v0"):
        assert default_tasks(env_id).variations == list(DOMAINS["Hanoi-v0"].train)
    assert default_tasks("CartPole-v1").variations == default_tasks(None).variations == [{}]


@pytest.mark.parametrize("make", [make_fast_vec_env, make_vec_env])
def test_options_are_in_force_from_the_next_reset(make):
    env = make("Hanoi-v0", 3)
    tasks = TaskDistribution({"n_discs": range(1, 9)})
    tasks.put_in_force(env, [{"n_discs": n} for n in (2, 5, 7)])
    env.reset()
    assert [info["variation"]["n_discs"] for info in env.unwrapped.reset_infos] == [2, 5, 7]


def test_attributes_are_set_in_the_environment_itself():
    env = make_vec_env("CartPole-v1", 2)
    tasks = TaskDistribution({"length": [0.3, 0.9], "force_mag": [5.0, 20.0]}, apply="attributes")
    tasks.put_in_force(env, [{"length": 0.3, "force_mag": 20.0}, {"length": 0.9, "force_mag": 5.0}])
    assert [single.unwrapped.length for single in env.envs] == [0.3, 0.9]
    # Force decides how far one push to the right goes.
    env.seed(0)
    env.reset()
    speeds = env.step(np.array([1, 1]))[0][:, 1]
    assert speeds[0] > speeds[1] + 0.15


def test_constructor_arguments_make_the_environment_anew():
    env = DummyVecEnv([lambda: gym.wrappers.RecordEpisodeStatistics(RemakeOnVariation("Pendulum-v1", g=9.0))] * 2)
    before = [single.unwrapped for single in env.envs]
    TaskDistribution({"g": [1.0, 2.0]}, apply="constructor").put_in_force(env, [{"g": 1.0}, {"g": 2.0}])
    assert [single.unwrapped.g for single in env.envs] == [1.0, 2.0]
    assert all(single.unwrapped is not old for single, old in zip(env.envs, before, strict=True))
    env.reset()
    env.step(np.zeros((2, 1)))
    TaskDistribution([{}], apply="constructor").put_in_force(env, [{}, {}])
    assert [single.unwrapped.g for single in env.envs] == [9.0, 9.0]


def test_attribute_that_the_environment_lacks_is_refused():
    tasks = TaskDistribution({"lenght": [1.0]}, apply="attributes")
    with pytest.raises(ValueError, match="'lenght' is not accepted"):
        tasks.put_in_force(make_vec_env("CartPole-v1", 1), [{"lenght": 1.0}])


@pytest.mark.parametrize("apply", ["attributes", "constructor"])
def test_environments_that_cannot_be_varied_so_are_refused(apply):
    tasks = TaskDistribution({"n_discs": [1]}, apply=apply)
    with pytest.raises(ValueError, match="these environments are not accepted"):
        tasks.put_in_force(make_fast_vec_env("Hanoi-v0", 2), [{"n_discs": 1}] * 2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([],), "at least one variation"),
        (({},), "at least one variation"),
        (({"n": 3},), "n=3 is not accepted"),
        (({"n": "abc"},), "n='abc' is not accepted"),
        (({"n": []},), "n=\\[\\] is not accepted"),
        (([1, 2],), "mapping"),
        (("abc",), "mapping"),
        (({"n": [1]}, "best"), "known samplers: uniform, curriculum, failure"),
        (({"n": [1]}, "uniform", "magic"), "known: options, attributes, constructor"),
    ],
)
def test_what_makes_no_distribution_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        TaskDistribution(*arguments)


@pytest.mark.parametrize("apply", ["options", "attributes", "constructor"])
def test_variations_set_the_same_parameters_unless_the_environment_is_made_anew(apply):
    variations = [{"n_discs": 2}, {"n_discs": 3, "source": 1}]
    if apply == "constructor":
        assert TaskDistribution(variations, apply=apply).variations == variations
        return
    with pytest.raises(ValueError, match="leave out source"):
        TaskDistribution(variations, apply=apply)


def test_samplers_refuse_values_out_of_range():
    with pytest.raises(ValueError, match="fraction=0"):
        CurriculumSampler(0)
    with pytest.raises(ValueError, match="floor=0"):
        FailureSampler(0)


def test_labels_tell_variations_apart():
    tasks = TaskDistribution({"n": [1, 2], "x": lambda rng: 0})
    assert len({tasks.label(0), tasks.label(1)}) == 2
    assert "n=1" in tasks.label(0)
    assert TaskDistribution([{}]).label(0) == "default"


class Bowl(gym.Env):
    """A number rolls towards 0, by how steep the bowl is; ``colour`` is read and ignored."""

    observation_space = gym.spaces.Box(-10, 10, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, steep=0.1, colour="red"):
        self.steep, self.colour = steep, colour

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        options = dict(options or {})
        self.steep, self.colour = options.get("steep", self.steep), options.get("colour", self.colour)
        self.place = self.np_random.uniform(1, 2)
        return np.array([self.place], np.float32), {}

    def step(self, action):
        self.place = (1 - self.steep) * self.place + 0.1 * float(action[0])
        return np.array([self.place], np.float32), -abs(self.place), False, False, {}


def test_variations_that_change_nothing_are_refused_when_training_begins():
    env = make_vec_env(Bowl, 2, seed=0)
    ignored = TaskDistribution({"colour": ["red", "blue"]})
    message = "the variations colour=red and colour=blue do not differ: .* give TaskDistribution check=False"
    with pytest.raises(ValueError, match=message):
        PPO("MlpPolicy", env, n_steps=16, batch_size=16).learn(32, callback=ReptileWrapper(ignored))
    with pytest.raises(ValueError, match=message):
        ReptilePPO("MlpPolicy", env, n_steps=16, tasks=ignored).learn(32)
    check_variations(TaskDistribution({"steep": [0.1, 0.2]}), env)  # only the dynamics differ
    check_variations(TaskDistribution({"colour": ["red", "blue"]}, check=False), env)
    check_variations(TaskDistribution([{"colour": "red"}]), env)
    mixed = TaskDistribution({"steep": [0.1, 0.2], "colour": ["red", "blue"]})
    with pytest.raises(ValueError, match=r"steep=0.1,colour=red and steep=0.1,colour=blue do not differ"):
        check_variations(mixed, env)


@pytest.mark.parametrize("domain", [d for d in DOMAINS.values() if not d.simulation], ids=lambda d: d.id)
@pytest.mark.parametrize("n_envs", [1, 4])
def test_variations_of_the_domains_differ(domain, n_envs):
    check_variations(TaskDistribution(domain.train), make_fast_vec_env(domain.id, n_envs))


def test_check_leaves_training_as_it_is():
    parameters = []
    for check in (True, False):
        tasks = TaskDistribution(DOMAINS["Stacking-v0"].train, check=check)
        model = ReptilePPO("ProgPolicy", "Stacking-v0", n_envs=4, n_steps=16, tasks=tasks, seed=0).learn(256)
        parameters.append([tensor.detach().clone() for tensor in model.policy.parameters()])
    assert all(th.equal(one, other) for one, other in zip(*parameters, strict=True))


def test_split_by_seed():
    tasks = TaskDistribution({"length": [0.1 * n for n in range(10)], "mass": [1, 2]}, sampler="curriculum")
    train, validation, unseen = tasks.split(validation=0.1, unseen=4, seed=3)
    assert (len(train), len(validation), len(unseen)) == (14, 2, 4)
    parts = [*train.variations, *validation, *unseen]
    assert sorted(map(str, parts)) == sorted(map(str, tasks.variations)), "each is in one of them"
    assert train.variations == [v for v in tasks.variations if v in train.variations], "the order stays"
    assert type(train.sampler) is type(tasks.sampler)
    again = tasks.split(validation=0.1, unseen=4, seed=3)
    assert (again[0].variations, again[1:]) == (train.variations, (validation, unseen))
    assert tasks.split(0.1, 4, seed=4)[2] != unseen


@pytest.mark.parametrize("parts", [{"validation": 0.5, "unseen": 0.5}, {"unseen": -1}, {"unseen": 1.5}, {"unseen": 20}])
def test_split_that_is_not_accepted(parts):
    with pytest.raises(ValueError, match=r"is not accepted|leave none of 20 variations"):
        TaskDistribution({"length": range(20)}).split(**parts)


def test_drawn_values_are_not_split():
    with pytest.raises(ValueError, match="cannot be split; give lists"):
        TaskDistribution({"length": lambda rng: rng.uniform()}).split()
