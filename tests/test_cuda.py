"""Training on a GPU, where there is one."""

import pytest
import torch as th

from sb3_progpolicy import ReptilePPO, evaluate_program

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="there is no GPU")


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy", "MlpPolicy", "MlpLstmPolicy"])
def test_policies_train_search_extract_save_and_load_on_a_gpu(policy, tmp_path):
    model = ReptilePPO(
        policy, "Hanoi-v0", n_envs=4, n_steps=16, batch_size=32, n_epochs=2, seed=0, device="cuda",
        normalize_observations=True, scale_rewards=True, search_fraction=0.5,
    )  # fmt: skip
    model.learn(64 * 16)
    assert {parameter.device.type for parameter in model.policy.parameters()} == {"cuda"}
    model.save(tmp_path / "model")
    loaded = ReptilePPO.load(tmp_path / "model", "Hanoi-v0", device="cpu")
    for mine, other in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert th.equal(mine.cpu(), other)
    if policy in ("ProgPolicy", "PRLPolicy"):
        assert model.program().body == loaded.program().body
        assert evaluate_program(model.program(), variations=[{"n_discs": 1}])[0].episodes == 1


def test_searching_program_is_extracted_where_it_is():
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=4, n_steps=16, device="cuda", seed=0)
    model.learn(64)
    for n_conditions in range(3):
        module = model.policy.module.extract(n_conditions)
        assert {parameter.device.type for parameter in module.parameters()} == {"cuda"}
    assert len(model.program().controllers) >= 1


def test_inner_loops_of_a_batch_run_on_a_gpu():
    model = ReptilePPO("ProgPolicy", "Hanoi-v0", n_envs=4, n_steps=16, device="cuda", seed=0, meta_batch_size=2)
    model.learn(64 * 16)
    assert model.meta_iteration > 0
