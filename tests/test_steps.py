"""The pure steps of Reptile on plain tensors, and an inner loop that follows from its arguments alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th

from sb3_progpolicy import ReptilePPO, TaskDistribution
from sb3_progpolicy.reptile.steps import begin_task, meta_step
from sb3_progpolicy.reptile_ppo import Theta

THETA = [th.tensor([1.0, 2.0]), th.tensor([[3.0]])]
THETA_HAT = [th.tensor([3.0, 2.0]), th.tensor([[-1.0]])]


def test_plain_step_goes_a_share_of_the_way():
    new, _ = meta_step(THETA, THETA_HAT, 0.25)
    assert [tensor.tolist() for tensor in new] == [[1.5, 2.0], [[2.0]]]
    assert [tensor.tolist() for tensor in THETA] == [[1.0, 2.0], [[3.0]]], "the arguments stay as they are"


def test_first_step_of_adam_has_the_length_of_beta_and_its_state_carries_momentum():
    new, state = meta_step(THETA, THETA_HAT, 0.1, "adam")
    assert new[0].tolist() == pytest.approx([1.1, 2.0])
    assert new[1].item() == pytest.approx(2.9)
    kept = state["state"][0]["exp_avg"].clone()
    onwards, _ = meta_step(new, new, 0.1, "adam", state)
    assert onwards[0][0] > new[0][0], "it moves on without a pseudo-gradient"
    assert th.equal(state["state"][0]["exp_avg"], kept), "the state given stays as it is"


def begin(number=0, seed=7, rng=None, n_tasks=2):
    tasks = TaskDistribution({"n_discs": [1, 2, 3, 4]})
    rng = np.random.default_rng(0) if rng is None else rng
    return begin_task(THETA, tasks, 4, n_tasks=n_tasks, number=number, progress=0.0, seed=seed, rng=rng)


def test_task_is_dealt_out_and_theta_is_a_copy():
    theta, task, _ = begin()
    assert all(th.equal(copy, tensor) and copy is not tensor for copy, tensor in zip(theta, THETA, strict=True))
    assert task.indices[0] == task.indices[2] != task.indices[1] == task.indices[3]
    assert [variation["n_discs"] for variation in task.variations] == [1 + index for index in task.indices]


def test_task_follows_from_seed_and_number_alone():
    tasks = [begin(number=3, rng=np.random.default_rng(seed)) for seed in (1, 2)]
    (_, first, rng), (_, second, other) = tasks
    assert first == second
    assert rng.random() == other.random()
    assert len({begin(number=number)[1].seed for number in range(5)}) == 5


def test_task_without_a_seed_comes_from_the_generator():
    drawn = {begin(seed=None, rng=np.random.default_rng(seed), n_tasks=1)[1].indices for seed in range(30)}
    assert len(drawn) == 4
    assert begin(seed=None)[1].seed is None


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy", "MlpLstmPolicy"])
def test_inner_loop_follows_from_its_arguments_alone(policy):
    def make():
        return ReptilePPO(
            policy, "Hanoi-v0", n_envs=4, n_steps=16, batch_size=32, n_epochs=2, seed=0, device="cpu",
            inner_updates=3, normalize_observations=True, scale_rewards=True, learning_rate=0.01,
        )  # fmt: skip

    model = make()
    model.learn(64 * 6)
    theta = replace(Theta.of(model), total_timesteps=64 * 20)
    arguments = {"n_tasks": 2, "number": 1, "progress": 0.5, "seed": 0, "rng": model.rng}

    def inner_loop(other):
        _, task, rng = begin_task(other.policy.parameters(), other.tasks, other.n_envs, **arguments)
        return other.inner_loop(theta, task, rng)

    # By the same model twice, by another, and after other training: always the same.
    results = [inner_loop(model), inner_loop(model), inner_loop(make())]
    other = make()
    other.learn(64 * 9)
    results.append(inner_loop(other))
    assert any(not th.equal(results[0].policy[name], tensor) for name, tensor in theta.policy.items())
    for result in results[1:]:
        assert set(result.policy) == set(results[0].policy)
        for name, tensor in result.policy.items():
            assert th.equal(tensor, results[0].policy[name]), name
        assert result.num_timesteps == results[0].num_timesteps == 64 * 9
