"""Growth: conditions are tried one at a time, and stay if the return rises."""

import itertools
import json

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_progpolicy import ReptileCheckpoint, ReptilePPO
from sb3_progpolicy.experiment.config import make_config
from sb3_progpolicy.experiment.run import build_model
from sb3_progpolicy.programs import ProgramRunner, load_program
from sb3_progpolicy.reptile_ppo.growth import COMPARE
from sb3_progpolicy.reptile_ppo.inner_loops import Learning
from sb3_progpolicy.reptile_ppo.returns import MIN_EPISODES, Comparison, episode_returns
from tests.reptile_ppo.models import Each, make, weights

ROLLOUT = 4 * 16
GROWTH = {"search_method": "growth", "growth_iterations": 2, "inner_updates": 1, "tasks": {"n_discs": [1]}}


class EitherOr(gym.Env):
    """Every episode is one step long; the right action is the sign of the product of two numbers, or of the first."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, product=True):
        self.product = product

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seen = self.np_random.uniform(-1, 1, size=2).astype(np.float32)
        return self.seen, {}

    def step(self, action):
        sign = self.seen[0] * self.seen[1] if self.product else self.seen[0]
        right = bool((sign > 0) == action)
        return self.reset()[0], float(right), True, False, {"is_success": right}


class Walk(gym.Env):
    """Pays 1 a step, for as many steps as the environment has been told."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, n_steps):
        self.n_steps = n_steps

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.elapsed = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.elapsed += 1
        return np.zeros(1, np.float32), 1.0, self.elapsed == self.n_steps, False, {}


def learner(product, n_envs=32, **kwargs):
    env = VecMonitor(DummyVecEnv([lambda: EitherOr(product)] * n_envs))
    arguments = {"n_steps": 16, "n_epochs": 5, "gamma": 0.0, "interaction_history": False, "meta_update": False}
    arguments |= {"ent_coef": 0.1, "learning_rate": 0.01}  # so that no controller is sure before it is divided
    arguments |= {"search_method": "growth", "growth_iterations": 8, "inner_updates": 2, "policy_kwargs": {"depth": 4}}
    return ReptilePPO("PRLPolicy", env, seed=0, device="cpu", **{**arguments, **kwargs})


@pytest.fixture
def short(monkeypatch):
    """Looks around and comparisons of the size of the small models."""
    monkeypatch.setattr("sb3_progpolicy.reptile_ppo.growth.MIN_LOOK", 1)
    monkeypatch.setattr("sb3_progpolicy.reptile_ppo.divisions.MIN_STATES", 20)
    monkeypatch.setattr("sb3_progpolicy.reptile_ppo.returns.MIN_EPISODES", 4)


def keep(monkeypatch, kept):
    """Let every trial end at its first comparison."""
    monkeypatch.setattr(Comparison, "pays", property(lambda self: kept))
    monkeypatch.setattr(Comparison, "undecided", property(lambda self: False))


class Stop(BaseCallback):
    """Ends the training where it is told to."""

    def __init__(self, when):
        super().__init__()
        self.when = when

    def _on_step(self):
        return not self.when(self.model)


# ------------------------------------------------------------------------------------------------- what is kept


def test_condition_that_is_needed_is_found_and_kept():
    model = learner(product=True).learn(60_000)
    assert model.growth.trials[0]["kept"] or model.growth.trials[1]["kept"]
    program = model.program()
    assert 1 <= len(program.conditions) <= 3
    x = np.random.default_rng(0).uniform(-1, 1, (1000, 2))
    right = ProgramRunner(program, 1000).act(x) == (x[:, 0] * x[:, 1] > 0)
    assert right.mean() > 0.85, "one affine controller is right at most in three quarters"
    assert program.metadata["growth"] == model.growth.trials
    kept = [trial["n_conditions"] for trial in model.growth.trials if trial["kept"]]
    assert kept == list(range(1, len(program.conditions) + 1))


def test_condition_that_is_not_needed_is_taken_back():
    model = learner(product=False, growth_iterations=4).learn(60_000)
    assert len(model.growth.trials) >= 2
    assert not any(trial["kept"] for trial in model.growth.trials)
    assert len(model.program().conditions) == 0


def test_high_price_keeps_nothing():
    model = learner(product=True, length_coef=100.0, growth_iterations=4).learn(40_000)
    assert len(model.growth.trials) >= 2
    assert len(model.program().conditions) == 0


@pytest.mark.parametrize(("rises", "pays", "undecided"), [
    ([1.0, 1.1, 0.9, 1.0], True, False),
    ([3.0, -2.0, 3.0, -2.0], False, True),
    ([-1.0, -1.1, -0.9, -1.0], False, False),
    ([0.0, 0.0, 0.0, 0.0], False, False),
    ([1.0, np.nan, np.nan, np.nan], False, True),
])  # fmt: skip
def test_rise_has_to_stand_out_from_the_noise(rises, pays, undecided):
    without = np.array([[0.0, 10.0, 0.0, 10.0]])
    outcome = Comparison.of(without, without + rises, 0.0)
    assert outcome.rise == pytest.approx(np.nanmean(rises))
    assert (outcome.pays, outcome.undecided) == (pays, undecided)


def test_price_is_in_deviations_of_the_returns():
    without = np.array([[0.0, 10.0, 0.0, 10.0]])
    cheap, dear = (Comparison.of(without, without + 1, coef) for coef in (0.1, 0.3))
    assert (cheap.price, dear.price) == pytest.approx((0.5, 1.5))
    assert cheap.pays
    assert not dear.pays
    assert not dear.undecided


def test_trial_without_a_clear_outcome_goes_on(monkeypatch, short):
    monkeypatch.setattr(Comparison, "pays", property(lambda self: False))
    monkeypatch.setattr(Comparison, "undecided", property(lambda self: True))
    model = make(**GROWTH).learn(ROLLOUT * 90)
    assert {trial["rounds"] for trial in model.growth.trials} == {3}


# ------------------------------------------------------------------------------------------------- the two programs


def test_condition_that_is_taken_back_leaves_no_trace(monkeypatch, short):
    """The twin was trained on the same tasks as without any trial, with the same numbers of random."""
    keep(monkeypatch, False)
    stop = {"callback": Stop(lambda model: model.meta_iteration == 7)}  # an iteration that is stopped ends there
    same = {"learning_rate": 0.02, "meta_optimizer": "adam", "meta_learning_rate": 0.05}  # whatever steps a trial takes
    tried, plain = (make(**GROWTH, **same, search_fraction=fraction).learn(10**6, **stop) for fraction in (1.0, 0.0))
    assert len(tried.growth.trials) == 1
    assert not plain.growth.trials
    assert th.equal(weights(tried), weights(plain))


def test_inputs_that_never_change_leave_nothing_to_divide(short):
    env = VecMonitor(DummyVecEnv([lambda: Walk(5)] * 4))
    model = make("PRLPolicy", env, **GROWTH | {"tasks": None}, interaction_history=False)
    with pytest.warns(UserWarning, match="nothing to divide"):
        model.learn(ROLLOUT * 5)
    assert model.growth.trials == []


def test_steps_of_both_programs_and_of_the_comparison_are_counted(monkeypatch, short):
    keep(monkeypatch, False)
    heard = []
    model = make(**GROWTH)
    model.learn(ROLLOUT * 30, callback=Each(lambda model, _: heard.append(model.num_timesteps)))
    assert heard == list(range(4, model.num_timesteps + 1, 4))
    assert model.num_timesteps >= ROLLOUT * 30


def test_condition_that_is_kept_is_trained_on(monkeypatch, short):
    keep(monkeypatch, True)
    model = make(**GROWTH, policy_kwargs={"depth": 3})
    seen = []
    model.learn(ROLLOUT * 60, callback=Each(lambda model, _: seen.append(model.search.most_likely())))
    assert [trial["n_conditions"] for trial in model.growth.trials] == [1, 2]
    assert seen[-1] == len(model.program().conditions) == 2, "and no more than there is room for"
    assert len(model.program().controllers) == 3
    module = model.policy.module
    rows = module.controllers.weight.unflatten(0, (module.n_controllers, -1))[module.controllers_in_use]
    assert not any(th.equal(one, other) for one, other in itertools.pairwise(rows))


def test_between_meta_iterations_the_model_is_the_program_without_the_trial(short):
    model = make(**GROWTH, search_fraction=1.0)
    lengths = []

    class Watch(BaseCallback):
        def _on_rollout_start(self):
            lengths.append((self.model.meta_iteration, len(self.model.program().conditions)))

        def _on_step(self):
            return True

    model.learn(ROLLOUT * 5, callback=Watch())
    # Two alone, then a look around, and each of the next on both programs.
    assert lengths == [(0, 0), (1, 0), (2, 0), (2, 0), (2, 1)]
    assert model.growth.arm is not None
    assert len(model.program().conditions) == 0


@pytest.mark.parametrize("stop_at", range(3, 30, 4))
def test_training_that_a_callback_ends_anywhere_holds_the_shorter_program(stop_at, short):
    model = make(**GROWTH, search_fraction=1.0)
    model.learn(ROLLOUT * 100, callback=Stop(lambda model: model.num_timesteps >= ROLLOUT * stop_at / 4))
    assert len(model.program().conditions) == sum(trial["kept"] for trial in model.growth.trials)
    model.learn(ROLLOUT * 10, reset_num_timesteps=False)


def test_after_the_search_no_trial_is_begun_and_an_open_one_is_brought_to_its_end(monkeypatch, short):
    keep(monkeypatch, False)
    model = make(**GROWTH, search_fraction=0.2)
    model.learn(ROLLOUT * 80)
    assert model.growth.arm is None
    assert len(model.growth.trials) >= 1
    assert model.growth.trials[-1]["timesteps"] < 0.6 * ROLLOUT * 80


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy"])
@pytest.mark.parametrize("env_id", ["Hanoi-v0", "Stacking-v0"])
def test_tied_program_stays_one_as_it_grows(env_id, policy, monkeypatch, short):
    keep(monkeypatch, True)
    model = make(policy, env_id, **GROWTH | {"tasks": None}, symmetric=True, n_envs=8, search_fraction=1.0)
    model.learn(8 * 16 * 14)
    assert len(model.program().conditions) >= 1
    module = model.policy.module
    weight = module.conditions.input_weight
    th.testing.assert_close(weight, weight @ module.conditions.projection)


# ------------------------------------------------------------------------------------------------- returns


def test_returns_are_those_of_whole_episodes():
    env = VecMonitor(DummyVecEnv([lambda n=n: Walk(n) for n in (3, 20, 41, 50)]))
    model = make(env=env, **GROWTH | {"tasks": None})
    learning = Learning(model._init_callback(None))
    returns = episode_returns(model, model._begin_task(COMPARE)[0], learning)
    assert returns.shape == (MIN_EPISODES // 4, 4)
    assert (returns == [3, 20, 41, 50]).all()
    assert model.num_timesteps == 4 * 50 * MIN_EPISODES // 4


def test_episodes_without_an_end_count_with_what_they_have(monkeypatch):
    env = VecMonitor(DummyVecEnv([lambda n=n: Walk(n) for n in (3, -1)]))
    monkeypatch.setattr("sb3_progpolicy.reptile_ppo.returns.MAX_STEPS", 10)
    model = make(env=env, **GROWTH | {"tasks": None})
    returns = episode_returns(model, model._begin_task(COMPARE)[0], Learning(model._init_callback(None)))
    assert (returns[:, 0] == 3).all()
    assert returns[0, 1] == 10 * len(returns)
    assert np.isnan(returns[1:, 1]).all()


def test_equal_programs_have_equal_returns():
    model = make(env="CartPole-v1", **GROWTH | {"tasks": None})
    learning = Learning(model._init_callback(None))
    one, other = (episode_returns(model, model._begin_task(COMPARE)[0], learning) for _ in range(2))
    assert (one == other).all()
    assert np.unique(one).size > 5


# ------------------------------------------------------------------------------------------------- files, other engines


class Halt(Exception):
    pass


class HaltAt(ReptileCheckpoint):
    """Fails in the middle of a rollout, at a step of its own."""

    stop_at = 0

    def _on_step(self):
        if self.num_timesteps >= self.stop_at:
            raise Halt
        return True


def resumable(**kwargs):
    arguments = {"meta_optimizer": "adam", "meta_learning_rate": 0.05, "scale_rewards": True, "search_fraction": 0.8}
    return make(**{**GROWTH, "tasks": {"n_discs": [1, 2]}}, sampler="progress", **arguments, **kwargs)


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy"])
@pytest.mark.parametrize(("rollouts", "is_open"), [(5.5, True), (8.5, True), (3.5, False)])
def test_resumed_growth_ends_with_the_same_bits(policy, rollouts, is_open, tmp_path, monkeypatch, short):
    keep(monkeypatch, True)
    path = tmp_path / "model.zip"
    halting = HaltAt(path)
    halting.stop_at = ROLLOUT * rollouts
    with pytest.raises(Halt):
        resumable(policy=policy).learn(ROLLOUT * 60, halting)
    halting.save()
    loaded = ReptilePPO.load(path, env="Hanoi-v0", device="cpu")
    assert (loaded.growth.arm is not None) == is_open
    loaded.learn(ROLLOUT * 60 - loaded.num_timesteps, reset_num_timesteps=False)
    whole = resumable(policy=policy).learn(ROLLOUT * 60)
    assert th.equal(weights(loaded), weights(whole))
    assert loaded.growth.trials == whole.growth.trials
    assert whole.growth.trials
    assert loaded.growth.state() == whole.growth.state()
    np.testing.assert_array_equal(loaded.tasks.scores, whole.tasks.scores)


def test_open_trial_is_saved_and_loaded_as_it_is(tmp_path, short):
    model = make(**GROWTH, search_fraction=1.0, scale_rewards=True).learn(ROLLOUT * 5)
    assert model.growth.arm is not None
    model.save(tmp_path / "model.zip")
    loaded = ReptilePPO.load(tmp_path / "model.zip", device="cpu")
    mine, other = model.growth.arm, loaded.growth.arm
    assert all(th.equal(mine.theta.policy[name], tensor) for name, tensor in other.theta.policy.items())
    assert not th.equal(mine.theta.policy["module.search.selected"], model.search.selected)
    assert other.theta.reward_scaler.state() == mine.theta.reward_scaler.state()
    assert other.theta.optimizer["state"].keys() == mine.theta.optimizer["state"].keys()
    loaded.save(tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == (tmp_path / "model.zip").read_bytes()


def test_saved_search_method_cannot_be_changed(tmp_path):
    make(**GROWTH).save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="search_method='gradient' is not accepted"):
        ReptilePPO.load(tmp_path / "model.zip", search_method="gradient")


def test_inner_loops_in_processes_come_to_the_same_end(monkeypatch, short):
    keep(monkeypatch, True)
    models = [make(**GROWTH, meta_batch_size=2, engine=engine) for engine in ("serial", "local")]
    for model in models:
        model.learn(ROLLOUT * 40)
    assert len(models[0].program().conditions) == 2
    assert th.equal(*map(weights, models))
    assert models[0].growth.trials == models[1].growth.trials


def test_growth_starts_from_a_program_that_is_given(tmp_path, monkeypatch, short):
    keep(monkeypatch, True)
    kwargs = {"interaction_history": False, "n_envs": 4, "growth_iterations": 1, "inner_updates": 16}
    first = make("PRLPolicy", "CartPole-v1", policy_kwargs={"n_conditions": 1}, **kwargs).learn(64)
    path = tmp_path / "program.json"
    first.program().save(path)
    growing = {**kwargs, "search_method": "growth", "policy_kwargs": {"depth": 3}, "search_fraction": 1.0}
    model = make("PRLPolicy", "CartPole-v1", init_program=str(path), **growing)
    assert len(model.program().conditions) == 1
    model.learn(ROLLOUT * 16 * 4)
    assert [trial["n_conditions"] for trial in model.growth.trials] == [2]


def test_log_and_metadata_say_what_was_tried(tmp_path, monkeypatch, capsys, short):
    keep(monkeypatch, True)
    model = make(**GROWTH, verbose=1)
    logged = {}
    record = model.__class__.dump_logs

    def dump(self, iteration=0):
        logged.update(self.logger.name_to_value)
        record(self, iteration)

    monkeypatch.setattr(type(model), "dump_logs", dump)
    model.learn(ROLLOUT * 60)
    names = ("return_before", "rise", "rise_std_error", "price", "tried", "kept", "taken_back", "n_conditions")
    assert {f"growth/{name}" for name in names} <= set(logged)
    assert (logged["growth/tried"], logged["growth/kept"], logged["growth/taken_back"]) == (2, 2, 0)
    assert "Condition 2 kept at step" in capsys.readouterr().out
    program = model.program()
    program.save(tmp_path / "program.json")
    told = load_program(tmp_path / "program.json").metadata["growth"]
    assert told == model.growth.trials == json.loads(json.dumps(told))
    assert set(told[0]) == {*names[:4], "timesteps", "n_conditions", "rounds", "kept"}


def test_gradient_search_says_nothing_of_growth():
    model = make().learn(ROLLOUT)
    assert model.growth is None
    assert "growth" not in model.program().metadata


@pytest.mark.parametrize(("policy", "arguments", "message"), [
    ("MlpPolicy", {}, "not accepted with ActorCriticPolicy"),
    ("ProgPolicy", {"policy_kwargs": {"n_conditions": 2}}, "n_conditions=2"),
    ("ProgPolicy", {"policy_kwargs": {"depth": 1}}, "depth=1"),
    ("ProgPolicy", {"search_method": "grow"}, "unknown search_method 'grow'; nearest: growth"),
    ("ProgPolicy", {"growth_iterations": 0}, "growth_iterations=0 is not accepted; it is a whole number of at least 1"),
    ("ProgPolicy", {"search_fraction": 1.5}, "search_fraction=1.5 is not accepted; it is a number of at most 1"),
])  # fmt: skip
def test_what_cannot_grow_is_refused(policy, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(policy, **{**GROWTH, **arguments})


def test_growth_is_set_in_files_and_on_the_command_line():
    overrides = {"search_method": "growth", "growth_iterations": 3, "n_envs": 4}
    model, _ = build_model(make_config("reptile_ppo", "Hanoi-v0", 0, overrides=overrides))
    assert (model.search_method, model.growth_iterations, model.search.most_likely()) == ("growth", 3, 0)
    with pytest.raises(ValueError, match="search_method=3"):
        make_config("reptile_ppo", "Hanoi-v0", 0, overrides={"search_method": 3})
    with pytest.raises(ValueError, match="growth_iterations=0"):
        make_config("reptile_ppo", "Hanoi-v0", 0, overrides={"growth_iterations": 0})
