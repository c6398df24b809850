"""Why SB3's ``test_continuous`` is among the differences: with what differs set alike, its thousand steps suffice."""

import pytest
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.evaluation import evaluate_policy

from tests.sb3_suites.variants import PRL, ReptileMlp, ReptileProgWithoutHistory


def reward(algorithm, **changes):
    env = IdentityEnvBox(eps=0.5)
    arguments = {"n_steps": 256, "n_epochs": 4, "seed": 0, "learning_rate": 1e-3, **changes}
    model = algorithm("MlpPolicy", env, device="cpu", **arguments).learn(1000)
    return evaluate_policy(model, env, 5, warn=False)[0]


def test_a_network_needs_the_meta_step_switched_off():
    assert reward(ReptileMlp) < 90 <= reward(ReptileMlp, meta_update=False)


@pytest.mark.parametrize(
    ("algorithm", "changes"),
    [(PRL, {}), (ReptileProgWithoutHistory, {"meta_update": False, "search_fraction": 0.0})],
)
def test_a_program_needs_larger_steps_for_its_few_numbers(algorithm, changes):
    assert reward(algorithm, **changes) < 90 <= reward(algorithm, learning_rate=0.05, **changes)
