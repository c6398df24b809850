"""ReptilePPO: updates, the search for a program, schedules."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from tests.reptile_ppo.models import PARTS_OF_LOSS, POLICIES, Each, OneStep, make, weights


@pytest.mark.parametrize(("n_epochs", "batch_size"), [(2, 32), (1, 64)])
def test_updates_move_phi_and_w_in_turns(n_epochs, batch_size):
    model = make(n_epochs=n_epochs, batch_size=batch_size, search_fraction=1.0, meta_update=False, learning_rate=0.01)
    step, moves = model.policy.optimizer.step, []
    groups = {"W": model.policy.derivation_parameters(), "phi": model.policy.phi()}

    def watched():
        before = {name: [parameter.detach().clone() for parameter in group] for name, group in groups.items()}
        step()
        moves.append(
            [
                name
                for name, group in groups.items()
                if any((now != was).any() for now, was in zip(group, before[name], strict=True))
            ]
        )

    model.policy.optimizer.step = watched
    model.learn(64 * 4)
    steps_per_update = n_epochs * 64 // batch_size
    assert moves == ([["phi"]] * steps_per_update + [["W"]] * steps_per_update) * 2


def test_target_kl_ends_the_epochs_of_an_update():
    model, n_steps = make("MlpPolicy", target_kl=1e-9, learning_rate=0.01), []
    step = model.policy.optimizer.step

    def watched():
        step()
        n_steps.append(model.num_timesteps)

    model.policy.optimizer.step = watched
    model.learn(64 * 3)
    # The first step starts at the policy of the rollout, the second would start away from it.
    assert n_steps == [64, 128, 192]


def test_gradients_are_clipped_to_their_largest_norm():
    model = make("MlpPolicy", max_grad_norm=1e-30)
    before = weights(model)
    assert th.allclose(weights(model.learn(64)), before, rtol=0, atol=1e-20)


@pytest.mark.parametrize("normalize_advantage", [True, False])
def test_advantages_are_normalised_if_asked_for(normalize_advantage):
    kwargs = {"normalize_advantage": normalize_advantage, "learning_rate": 0.0, "batch_size": 64}
    model = make("MlpPolicy", **kwargs).learn(64)
    expected = 0 if normalize_advantage else -model.rollout_buffer.advantages.mean()
    # The ratio is 1, so that the loss is the mean advantage, turned round.
    assert model.logger.name_to_value["train/policy_gradient_loss"] == pytest.approx(expected, abs=1e-5)
    assert abs(model.rollout_buffer.advantages.mean()) > 1e-3


@pytest.mark.parametrize("clip_range_vf", [None, 1e-9])
def test_values_move_no_further_than_their_clip_range(clip_range_vf):
    def critic(n_epochs):
        kwargs = {"optimizer_class": th.optim.SGD}
        model = make("MlpPolicy", clip_range_vf=clip_range_vf, n_epochs=n_epochs, batch_size=64, policy_kwargs=kwargs)
        return model.learn(64).policy.value_net.bias

    assert bool(critic(1) == critic(3)) == (clip_range_vf is not None)


@pytest.mark.parametrize("meta_optimizer", ["sgd", "adam"])
def test_after_the_search_the_likeliest_program_is_selected_and_w_stands_still(meta_optimizer):
    seen = []

    def watch(model, _):
        search = model.search
        seen.append((model.num_timesteps, search.searching, search.logits.detach().clone(), int(search.selected)))

    model = make(search_fraction=0.5, inner_updates=1, meta_optimizer=meta_optimizer, meta_learning_rate=0.1)
    model.learn(64 * 8, callback=Each(watch))
    for timesteps, searching, *_ in seen:
        assert searching == (timesteps <= 64 * 4)
    during = [logits for _, searching, logits, _ in seen if searching]
    assert (during[-1] != during[0]).any()
    after = [(logits, selected) for _, searching, logits, selected in seen if not searching]
    for logits, selected in after:
        th.testing.assert_close(logits, after[0][0], rtol=0, atol=0)
        assert selected == after[0][1]
    choices = after[0][0].softmax(-1)
    probabilities = [choices[0, 0], choices[0, 1] * choices[1, 0], choices[0, 1] * choices[1, 1]]
    assert after[0][1] == int(np.argmax([float(probability) for probability in probabilities]))
    assert len(model.program().conditions) == after[0][1]
    assert (model.search.logits == after[0][0]).all()


@pytest.mark.parametrize(("meta_optimizer", "beta"), [("sgd", 0.5), ("adam", 0.05)])
def test_recurrence_stays_block_diagonal_in_training(meta_optimizer, beta):
    kwargs = {"cell": "gru", "condition_size": 2, "depth": 4}
    model = make(policy_kwargs=kwargs, meta_optimizer=meta_optimizer, meta_learning_rate=beta, inner_updates=2)
    conditions = model.policy.module.conditions
    before = conditions.rnn.weight_hh_l0.detach().clone()
    model.learn(64 * 6)
    mask = th.block_diag(*[th.ones(2, 2)] * 3).repeat(3, 1)
    assert (conditions.rnn.weight_hh_l0[mask == 0] == 0).all()
    assert (conditions.rnn.weight_hh_l0 != before)[mask == 1].any()


@pytest.mark.parametrize("length_coef", [0.0, 0.7])
def test_price_on_length_adds_the_expected_number_of_conditions_to_the_loss(length_coef):
    model = make(learning_rate=0.0, length_coef=length_coef, ent_coef=0.1, vf_coef=0.3)
    with th.no_grad():
        model.search.logits.copy_(th.tensor([[0.0, 1.0], [0.5, 0.0]]))
    model.learn(64)
    logged = {name: model.logger.name_to_value[f"train/{name}"] for name in PARTS_OF_LOSS}
    without = logged["policy_gradient_loss"] + 0.1 * logged["entropy_loss"] + 0.3 * logged["value_loss"]
    price = length_coef * model.search.expected_conditions().item()
    assert logged["loss"] - without == pytest.approx(price, abs=1e-5)


def test_high_price_on_length_leaves_a_program_without_conditions():
    model = make(length_coef=10.0, search_fraction=1.0, n_epochs=4, learning_rate=0.01).learn(64 * 12)
    assert model.search.probabilities()[0] > 0.9


def test_temperature_follows_its_schedule():
    temperatures = []
    model = make(temperature=lambda left: 0.1 + left)
    model.learn(64 * 4, callback=Each(lambda m, _: temperatures.append(float(m.policy.module.temperature))))
    assert sorted(set(temperatures), reverse=True) == pytest.approx([1.1, 0.85, 0.6, 0.35])
    assert model.program().temperature == pytest.approx(0.35)


@pytest.mark.parametrize("policy", POLICIES)
def test_deviation_of_the_actions_follows_its_schedule_and_is_not_learnt(policy):
    env = DummyVecEnv([lambda: OneStep(spaces.Box(-1, 1, (2, 3), np.float32))] * 4)
    deviations = []
    model = make(policy, env, action_std=lambda left: 0.01 + left, ent_coef=0.1, meta_update=False)
    model.learn(64 * 4, callback=Each(lambda m, _: deviations.extend(m.policy.log_std.exp().tolist())))
    assert sorted({round(deviation, 5) for deviation in deviations}, reverse=True) == [1.01, 0.76, 0.51, 0.26]
    assert model.policy.log_std.exp().tolist() == pytest.approx([0.26] * 6), "the last update left it alone"


def test_deviation_that_is_not_accepted():
    with pytest.raises(ValueError, match="for Box actions"):
        make(action_std=0.5)
    env = DummyVecEnv([lambda: OneStep(spaces.Box(-1, 1, (2,), np.float32))] * 4)
    with pytest.raises(ValueError, match="above 0"):
        make(env=env, action_std=0.0).learn(64)
