"""What is trained is what is run: branches drawn for Box actions, temperatures, programs of a given shape."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from sb3_progpolicy import ProgrammaticPolicy, ReptilePPO
from sb3_progpolicy.differentiable.module import ProgramModule
from sb3_progpolicy.differentiable.sampler import ProgramSampler
from sb3_progpolicy.distributions import BranchMixture
from sb3_progpolicy.programs import Program, ProgramRunner
from sb3_progpolicy.spaces import action_spec

SMALL = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "n_epochs": 2, "seed": 0, "device": "cpu"}
BOX = action_spec(spaces.Box(-1, 1, (2,)))


def module(depth=3, searching=True, **arguments):
    th.manual_seed(0)
    made = ProgramModule(5, BOX, depth, "affine", semantics="branches", **arguments)
    if not searching:
        made.search.select(depth - 1)
    return made


@pytest.mark.parametrize("searching", [True, False])
def test_density_of_the_mixture_is_torchs(searching):
    program, x, actions = module(searching=searching), th.randn(7, 5), th.randn(7, 2)
    values = program.conditions(x, program.initial_state(1))[0]
    weights, log_std = program.mixture_weights(values), th.tensor([-0.5, 0.3])
    distribution = BranchMixture(2).proba_distribution(program.mix(x, weights), log_std)
    means = program._terms(x).permute(2, 0, 1)
    expected = MixtureSameFamily(Categorical(weights), Independent(Normal(means, log_std.exp()), 1))
    th.testing.assert_close(distribution.log_prob(actions), expected.log_prob(actions))
    th.testing.assert_close(distribution.mode(), means[th.arange(7), weights.argmax(1)])
    terms = program.derivation_terms(x, values)
    th.testing.assert_close(program.mix_derivation(terms), program.mix(x, weights))
    assert distribution.entropy() is None


def test_drawn_actions_have_the_mixtures_moments():
    program, n = module(), 40_000
    x = th.randn(1, 5).expand(n, 5)
    weights = program.mixture_weights(program.conditions(x, program.initial_state(1))[0])
    log_std = th.full((2,), -1.5)
    distribution = BranchMixture(2).proba_distribution(program.mix(x, weights), log_std)
    mean = (weights[0, :, None] * program._terms(x[:1])[:, :, 0]).sum(0)
    sampler = ProgramSampler(program, program.initial_state(n), 1, np.random.default_rng(0), log_std)
    drawn = th.from_numpy(sampler.sample(x.numpy()))
    for actions in (distribution.sample(), drawn):
        th.testing.assert_close(actions.mean(0), mean, atol=0.01, rtol=0)
        # Unlike a Gaussian around the mixed means, it spreads as far as the branches do.
        assert (actions.std(0) > 1.1 * log_std.exp()).all()


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy"])
def test_branches_train_and_program_acts_as_the_policy(policy):
    kwargs = {"depth": 3, "semantics": "branches"}
    model = ReptilePPO(policy, "Pendulum-v1", policy_kwargs=kwargs, **SMALL).learn(256)
    program = model.program()
    assert program.semantics == "branches"
    inputs = np.random.default_rng(0).uniform(-1, 1, (64, 1, 6))
    runner, states, starts = ProgramRunner(program, 1, "soft"), None, np.ones(1, bool)
    model.policy.module.search.select(len(program.conditions))
    for x in inputs.astype(np.float32):
        action, states = model.predict(x, states, starts, deterministic=True)
        np.testing.assert_allclose(action, runner.act(x), rtol=1e-4, atol=1e-5)


def test_branches_in_the_stock_algorithm():
    kwargs = {"n_conditions": 1, "semantics": "branches"}
    model = PPO(ProgrammaticPolicy, make_vec_env("Pendulum-v1", 2), n_steps=32, policy_kwargs=kwargs, seed=0)
    model.learn(128)
    assert isinstance(model.policy.action_dist, BranchMixture)
    assert len(model.policy.program().conditions) == 1


def test_semantics_of_a_program_is_kept_in_its_file(tmp_path):
    model = ReptilePPO("PRLPolicy", "Pendulum-v1", policy_kwargs={"semantics": "branches"}, **SMALL)
    model.program().save(tmp_path / "program.json")
    assert Program.load(tmp_path / "program.json") == model.program()
    text = (tmp_path / "program.json").read_text().replace('"branches",', '"both",', 1)
    (tmp_path / "program.json").write_text(text)
    with pytest.raises(ValueError, match="semantics='both' is not accepted; it is one of means, branches"):
        Program.load(tmp_path / "program.json")


@pytest.mark.parametrize("n_conditions", [0, 2])
def test_program_of_a_given_shape_is_not_searched_for(n_conditions):
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", policy_kwargs={"n_conditions": n_conditions}, **SMALL)
    assert not model.searching
    assert len(model.learn(128).program().conditions) == n_conditions
    with pytest.raises(ValueError, match="n_conditions=-1 is not accepted"):
        ReptilePPO("ProgPolicy", "Hanoi-v0", policy_kwargs={"n_conditions": -1}, **SMALL)


def test_action_temperature_follows_its_schedule_and_is_folded_into_the_program():
    model = ReptilePPO(
        "ProgPolicy", "Hanoi-v0", action_temperature=LinearSchedule(1.0, 0.1, 1.0), verbose=0, **SMALL
    ).learn(1024)
    module = model.policy.module
    assert 0.1 <= module.action_temperature.item() < 0.2
    weights = module.to_syntax(0).weights
    rows = module._controller_rows(0)
    expected = module.controllers.weight.unflatten(0, (module.n_controllers, -1))[rows[0]] / module.action_temperature
    np.testing.assert_allclose(weights, expected.detach().numpy(), rtol=1e-6)
    assert 0 <= model.logger.name_to_value["program/crisp_disagreement"] <= 1


def test_soft_and_crisp_agree_more_at_low_temperatures():
    th.manual_seed(3)
    program = ProgramModule(5, action_spec(spaces.Discrete(3)), 3, "affine")
    program.search.select(2)
    x = th.randn(2000, 5)
    values = program.conditions(x, program.initial_state(1))[0]
    shares = []
    for temperature in (3.0, 0.01):
        program.temperature.fill_(temperature)
        shares.append(program.crisp_disagreement(x, values))
    assert shares[0] > 0.1
    assert shares[1] < 0.02


@pytest.mark.parametrize(
    ("env", "policy", "arguments", "message"),
    [
        ("Pendulum-v1", "ProgPolicy", {"action_temperature": 0.5}, "is for programs with discrete actions"),
        ("CartPole-v1", "MlpPolicy", {"action_temperature": 0.5}, "is for programs with discrete actions"),
        ("Pendulum-v1", "ProgPolicy", {"policy_kwargs": {"semantics": "x"}}, "'x' is not accepted"),
    ],
)
def test_values_that_are_not_accepted_are_named(env, policy, arguments, message):
    with pytest.raises(ValueError, match=message):
        ReptilePPO(policy, env, **SMALL, **arguments)


def test_temperature_that_falls_to_zero_is_refused():
    model = ReptilePPO("ProgPolicy", "CartPole-v1", action_temperature=lambda progress: 0.0, **SMALL)
    with pytest.raises(ValueError, match=r"action_temperature=0.0 is not accepted; it is above 0"):
        model.learn(64)
