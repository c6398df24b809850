"""Programs tied over the symmetries of their domain."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from progpolicy_envs import get_domain
from progpolicy_envs.symmetry import Permutation, Symmetry
from sb3_progpolicy import ReptilePPO
from sb3_progpolicy.programs import ProgramRunner
from sb3_progpolicy.spaces import action_spec
from sb3_progpolicy.symmetries import Group, as_data, as_symmetry, matrix_of

SMALL = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "n_epochs": 2, "seed": 0, "device": "cpu"}
DOMAINS = ["Hanoi-v0", "Stacking-v0", "HikingEgo-v0", "PandaReach-v0"]


def group_of(env_id, history=True):
    env, domain = gym.make(env_id), get_domain(env_id)
    action = action_spec(env.action_space)
    return Group(domain.symmetries, env.observation_space.shape[0] + history * action.interaction_size, action)


@pytest.mark.parametrize("history", [True, False])
@pytest.mark.parametrize("env_id", DOMAINS)
def test_tied_maps_are_exactly_the_equivariant_ones(env_id, history):
    group = group_of(env_id, history)
    ties, n = group.ties(), group.n_inputs
    rng = np.random.default_rng(0)
    tied = rng.standard_normal(ties.n_free)[ties.index] * ties.sign
    images = []
    for inputs, outputs in zip(group.inputs, group.outputs, strict=True):
        moved = np.eye(n + 1)
        moved[:n, :n] = matrix_of(inputs)
        np.testing.assert_allclose(tied @ moved, matrix_of(outputs) @ tied)
        images.append(np.kron(matrix_of(outputs), moved))
    # No equivariant map is left out: as many free numbers as the projection onto them has dimensions.
    assert ties.n_free == round(np.trace(np.mean(images, axis=0)))


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy"])
def test_trained_program_acts_in_a_mirrored_world_as_mirrored(policy, normalize):
    model = ReptilePPO(
        policy,
        "PandaReach-v0" if normalize else "Hanoi-v0",
        symmetric=True,
        normalize_observations=normalize,
        policy_kwargs={"n_conditions": 2},
        **SMALL,
    ).learn(256)
    program = model.program()
    group = group_of(program.metadata["env"])
    inputs = np.random.default_rng(1).uniform(-1, 1, (6, 50, group.n_inputs))
    conditions = []
    for moved, outputs in zip(group.inputs, group.outputs, strict=True):
        runner, original = ProgramRunner(program, 50), ProgramRunner(program, 50)
        for x in inputs:
            runner.act(moved(x))
            original.act(x)
            expected = original.outputs @ matrix_of(outputs).T
            np.testing.assert_allclose(runner.outputs, expected, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(runner.condition_values, original.condition_values, rtol=1e-4, atol=1e-5)
        conditions.append(runner.condition_values)
    assert np.ptp(conditions[0]) > 1e-3


def test_saved_and_loaded_model_stays_tied(tmp_path):
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", symmetric=True, **SMALL).learn(64)
    model.save(tmp_path / "model.zip")
    loaded = ReptilePPO.load(tmp_path / "model.zip")
    assert loaded.program() == model.program()
    assert loaded.policy.module.controllers.free.shape == model.policy.module.controllers.free.shape
    with pytest.raises(ValueError, match="symmetric=False is not accepted"):
        ReptilePPO.load(tmp_path / "model.zip", symmetric=False)


def test_orthogonal_start_is_the_symmetric_part():
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", symmetric=True, **SMALL)
    controllers = model.policy.module.controllers
    controllers.orthogonal_(1.0)
    rows = controllers.weight.unflatten(0, (-1, 6))[0]
    assert 0 < th.linalg.matrix_norm(rows, 2) <= 1 + 1e-5  # a mean of orthogonal matrices
    assert not controllers.bias.any()


def test_environment_of_ones_own_may_declare_symmetries():
    flip = Symmetry("left-right", Permutation.of(range(4), [-1] * 4), Permutation.of([1, 0]))

    class Mirrored(gym.Wrapper):
        symmetries = (flip,)

    env = Mirrored(gym.make("CartPole-v1"))
    model = ReptilePPO("ProgPolicy", env, symmetric=True, interaction_history=False, **SMALL | {"n_envs": None})
    weight = model.policy.module.controllers.weight
    assert th.equal(weight[0], -weight[1])


def test_plain_data_and_back():
    for env_id in DOMAINS:
        for symmetry in get_domain(env_id).symmetries:
            assert as_symmetry(as_data(symmetry)) == symmetry


@pytest.mark.parametrize(
    ("env", "arguments", "message"),
    [
        ("CartPole-v1", {"symmetric": True}, "CartPole-v1 declares no symmetries"),
        ("CartPole-v1", {"policy_kwargs": {"symmetries": [{"name": "x"}]}}, "symmetry {'name': 'x'} is not accepted"),
        (
            "Hanoi-v0",
            {"symmetric": True, "env_kwargs": {"context": "observed"}},
            "of 9 numbers is not accepted for 22 inputs; 9 are, or 17 with the interaction history",
        ),
        (
            "PandaReach-v0",
            {"policy_kwargs": {"symmetries": [Symmetry("x", Permutation.of(range(32)), Permutation.of([1, 0, 2, 3]))]}},
            "symmetries that exchange numbers of a Box action are not accepted",
        ),
        (
            "CartPole-v1",
            {"policy_kwargs": {"symmetries": [Symmetry("x", Permutation.of(range(4)), Permutation.of([1, 0, 2]))]}},
            "symmetries of 3 actions are not accepted for 2 outputs",
        ),
    ],
)
def test_symmetries_that_do_not_fit_are_refused(env, arguments, message):
    with pytest.raises(ValueError, match=message):
        ReptilePPO("ProgPolicy", env, **SMALL, **arguments)
