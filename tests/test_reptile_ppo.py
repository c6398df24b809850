"""ReptilePPO: rollouts, whole-rollout training, the search for a program, and SB3's manners."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_progpolicy import InteractionHistory, ReptilePPO, VecInteractionHistory
from sb3_progpolicy.normalization import RewardScaler
from sb3_progpolicy.programs import ProgramRunner
from sb3_progpolicy.reptile_ppo.rollout import PolicyActor
from sb3_progpolicy.vec_env import make_fast_vec_env

POLICIES = ("ProgPolicy", "PRLPolicy", "MlpPolicy", "MlpLstmPolicy")
PARTS_OF_LOSS = ("loss", "policy_gradient_loss", "entropy_loss", "value_loss")


def make(policy="ProgPolicy", env="Hanoi-v0", **kwargs):
    if isinstance(env, str):
        kwargs.setdefault("n_envs", 4)
    return ReptilePPO(
        policy, env, device="cpu", **{"n_steps": 16, "batch_size": 32, "n_epochs": 2, "seed": 0, **kwargs}
    )


def weights(model):
    return th.cat([tensor.flatten().double() for tensor in model.policy.state_dict().values()])


class Each(BaseCallback):
    """Calls a function at every step."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        self.function(self.model, self.locals)
        return True


class OneStep(gym.Env):
    """Every episode is one step long; the right action is the sign of the observation."""

    observation_space = spaces.Box(-1, 1, (3,), np.float64)

    def __init__(self, action_space=None):
        self.action_space = action_space or spaces.Discrete(2, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seen = self.np_random.uniform(-1, 1, size=3)
        return self.seen, {}

    def step(self, action):
        assert self.action_space.contains(action), action
        right = isinstance(self.action_space, spaces.Discrete) and action - self.action_space.start == (
            self.seen[0] > 0
        )
        return self.reset()[0], float(right), True, False, {"is_success": bool(right)}


# Rollouts


@pytest.mark.parametrize("policy", ["ProgPolicy", "MlpLstmPolicy"])
def test_hidden_state_survives_episode_end_but_not_task_switch(policy):
    kwargs = {"n_steps": 8, "batch_size": 16, "inner_updates": 2, "search_fraction": 1.0}
    model = make(policy, DummyVecEnv([OneStep] * 2), **kwargs)
    at_start = []

    class Watch(BaseCallback):
        def _on_rollout_start(self):
            at_start.append(bool((self.model._last_lstm_states.pi[0] == 0).all()))

        def _on_step(self):
            assert self.locals["dones"].all()
            return True

    model.learn(64, callback=Watch())
    assert at_start == [True, False, True, False]
    # Every episode ends after one step: a state that did not survive would depend on the last X alone.
    buffer = model.rollout_buffer
    x = th.as_tensor(buffer.observations.reshape(8, 2, -1)[-1])
    alone = model.policy.predict(x.numpy(), None)[1][0]
    assert np.abs(model._last_lstm_states.pi[0].numpy() - alone).max() > 1e-4


def log_ratios(model):
    """Of all the transitions in the first epoch, before any parameter has moved."""
    captured = []
    evaluate = model.adapter.evaluate

    def watched(batch):
        values, log_prob, entropy = evaluate(batch)
        # An update of W evaluates no values.
        difference = th.zeros(1) if values is None else batch["values"].flatten() - values.flatten()
        captured.append((batch["log_probs"].flatten() - log_prob.detach(), difference))
        return values, log_prob, entropy

    model.learning_rate, model.lr_schedule = 0.0, lambda _: 0.0
    model.adapter.evaluate = watched
    model.learn(2 * model.n_steps * model.n_envs)
    del model.adapter.evaluate
    assert sum(len(ratio) for ratio, _ in captured) == 2 * model.n_steps * model.n_envs
    return captured


@pytest.mark.parametrize("batch_size", [64, 8])
@pytest.mark.parametrize("env_id", ["Hanoi-v0", "Pendulum-v1"])
@pytest.mark.parametrize(
    ("policy", "policy_kwargs"),
    [
        *(("ProgPolicy", {"cell": cell, "condition_size": 2}) for cell in ("gru", "lstm", "rnn", "affine")),
        ("PRLPolicy", {}),
        ("MlpLstmPolicy", {"lstm_hidden_size": 4}),
    ],
)
def test_first_epoch_starts_at_the_log_probabilities_of_the_rollout(policy, policy_kwargs, env_id, batch_size):
    model = make(policy, env_id, n_steps=32, batch_size=batch_size, n_epochs=1, policy_kwargs=policy_kwargs)
    for ratio, values in log_ratios(model):
        assert ratio.abs().max() < 1e-5
        assert values.abs().max() < 1e-4


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch")
def test_where_the_batch_size_does_not_divide_the_rollout_sequences_are_shorter_and_a_warning_says_so():
    with pytest.warns(UserWarning, match="n_steps=16: gradient steps are made on 1 sequences of 8 steps"):
        model = make(batch_size=12, n_epochs=1)
    ratios = [ratio for ratio, _ in log_ratios(model)]
    assert {len(ratio) for ratio in ratios} == {8}
    assert max(ratio.abs().max() for ratio in ratios) < 1e-5


@pytest.mark.parametrize("cell", ["gru", "lstm", "rnn"])
def test_rollout_of_the_sampler_is_that_of_the_policy_stepped_by_hand(cell):
    model = make(policy_kwargs={"cell": cell}, inner_updates=1, n_epochs=1, learning_rate=0.0)
    model.learn(64)
    buffer, state = model.rollout_buffer, model.policy.module.initial_state(4)
    observations = th.as_tensor(buffer.observations.reshape(16, 4, -1))
    actions = th.as_tensor(buffer.actions.reshape(16, 4))
    for t in range(16):
        distribution, state = model.policy.get_distribution(observations[t], state, th.ones(4))
        expected = distribution.log_prob(actions[t]).detach()
        th.testing.assert_close(th.as_tensor(buffer.log_probs.reshape(16, 4)[t]), expected, atol=1e-5, rtol=1e-5)
    th.testing.assert_close(model._last_lstm_states.pi[0], state[0].detach(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("policy", "cell", "space"),
    [
        *(("ProgPolicy", cell, spaces.Discrete(2, start=5)) for cell in ("gru", "lstm", "rnn", "affine")),
        ("ProgPolicy", "gru", spaces.Box(-1, 1, (2,))),
        ("ProgPolicy", "gru", spaces.MultiDiscrete([2, 3])),
        ("ProgPolicy", "gru", spaces.MultiBinary(2)),
        ("PRLPolicy", "affine", spaces.Discrete(2, start=5)),
    ],
)
def test_policies_train_without_the_sampler(policy, cell, space):
    env = DummyVecEnv([lambda: OneStep(space)] * 4)
    model = make(policy, env, n_epochs=1, search_fraction=1.0, policy_kwargs={"cell": cell})
    # As on a GPU, where the policy itself acts in rollouts.
    model.adapter.make_actor = lambda states, buffer, n_steps, rng: PolicyActor(model.policy, states, buffer)
    # Rollouts for an update of phi and one of W, each from parameters that have not moved since.
    for ratio, values in log_ratios(model):
        assert ratio.abs().max() < 1e-5
        assert values.abs().max() < 1e-4
    assert isinstance(model._actor, PolicyActor)
    before = weights(model)
    model.lr_schedule = lambda _: 0.01
    model.learn(model.n_steps * model.n_envs * 2)
    assert (weights(model) != before).any()


@pytest.mark.parametrize(
    ("env", "bootstrapped"),
    [
        (lambda: make_fast_vec_env("Pendulum-v1", 2), [199]),  # cut off after 200 steps
        (lambda: DummyVecEnv([OneStep] * 2), []),  # every step ends an episode
    ],
)
def test_truncated_episodes_are_bootstrapped_and_ended_ones_are_not(env, bootstrapped):
    model = make(env=env(), n_steps=256, batch_size=256, gamma=0.5, n_epochs=1)
    raw = []
    model.learn(512, callback=Each(lambda _, local: raw.append(local["rewards"].copy())))
    extra = model.rollout_buffer.rewards.reshape(256, 2) - np.array(raw)
    assert np.flatnonzero(np.abs(extra).sum(1)).tolist() == bootstrapped


# The search for a program


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
    model = make("MlpPolicy", max_grad_norm=0.0)
    before = weights(model)
    assert th.equal(weights(model.learn(64)), before)


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


# What is accepted


@pytest.mark.parametrize("policy", POLICIES)
def test_all_policies_train_and_are_evaluated(policy):
    model = make(policy, DummyVecEnv([OneStep] * 8), n_steps=8, learning_rate=0.01, n_epochs=4, scale_rewards=True)
    before = weights(model)
    model.learn(64 * 25)
    assert (weights(model) != before).any()
    env = VecInteractionHistory(DummyVecEnv([OneStep] * 4))
    # Actions of a Discrete space that starts at 5: the environment asserts that they are in it.
    assert evaluate_policy(model, env, 200, warn=False)[0] > 0.8


@pytest.mark.parametrize(
    "space", [spaces.Box(-1, 1, (2, 3), np.float32), spaces.MultiBinary(3), spaces.MultiDiscrete([2, 4])]
)
@pytest.mark.parametrize("interaction_history", [True, False])
@pytest.mark.parametrize("cell", ["gru", "lstm"])
def test_all_action_spaces_and_double_precision_observations(space, interaction_history, cell):
    env = DummyVecEnv([lambda: OneStep(space)] * 4)
    model = make(env=env, interaction_history=interaction_history, policy_kwargs={"cell": cell}).learn(128)
    env = VecInteractionHistory(env) if interaction_history else env
    evaluate_policy(model, env, 8, warn=False)  # the environment asserts that actions are in its space
    assert model.program().action.n_outputs == sum(model.policy.spec_of_actions.sizes)


def test_environments_of_every_form_are_accepted():
    venv = make_fast_vec_env("Hanoi-v0", 3)
    for env, n_envs in (("progpolicy_envs:Hanoi-v0", 2), (gym.make("Hanoi-v0"), 1), (venv, 3)):
        model = make(env=env, **({"n_envs": 2} if isinstance(env, str) else {}))
        assert model.n_envs == n_envs
        assert [variation["n_discs"] for variation in model.tasks.variations] == [1, 2, 3, 4]
        model.learn(64)
    assert ReptilePPO("ProgPolicy", "Hanoi-v0", seed=0).n_envs == 32


@pytest.mark.parametrize("tasks", [{"n_discs": [2]}, [{"n_discs": 2}]])
def test_tasks_are_given_as_mapping_or_list(tasks):
    model = make(tasks=tasks, env_kwargs={"source": 1})
    model.learn(64)
    assert {v["n_discs"] for v in model.get_env().get_attr("row_variations")[0]} == {2}
    assert {v["source"] for v in model.get_env().get_attr("row_variations")[0]} == {1}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"policy": "ProgramPolicy"}, "ProgramPolicy"),
        ({"search_fraction": 1.5}, "search_fraction=1.5"),
        ({"length_coef": -1.0}, "length_coef=-1.0"),
        ({"n_envs": 0}, "n_envs=0"),
        ({"tasks": []}, "at least one variation"),
        ({"inner_updates": 0}, "inner_updates=0"),
        ({"meta_optimizer": "lion"}, "known: sgd, adam"),
        ({"env": "FrozenLake-v1"}, "FlattenObservation"),
        ({"policy_kwargs": {"cell": "mamba"}}, "known cells"),
        ({"env_kwargs": {"n_discs": 99}}, "n_discs=99"),
    ],
)
def test_values_that_are_not_accepted_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_environments_that_are_made_already_take_no_arguments():
    with pytest.raises(ValueError, match="n_envs and env_kwargs"):
        make(env=gym.make("Hanoi-v0"), n_envs=3)
    with pytest.raises(ValueError, match="appends the history itself"):
        make(env=InteractionHistory(gym.make("Hanoi-v0")))


def test_a_network_is_no_program():
    with pytest.raises(TypeError, match="is not a program"):
        make("MlpPolicy").program()


# Seeds, saving, options


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy", "MlpLstmPolicy"])
def test_equal_seeds_give_equal_runs(policy):
    runs = [weights(make(policy, seed=seed).learn(192)) for seed in (3, 3, 4)]
    assert th.equal(runs[0], runs[1])
    assert not th.equal(runs[0], runs[2])


@pytest.mark.parametrize("policy", POLICIES)
def test_saved_and_loaded_model_is_the_same_and_trains_on(policy, tmp_path):
    options = {"normalize_observations": True, "scale_rewards": True, "meta_optimizer": "adam"}
    model = make(policy, **options, meta_learning_rate=0.01).learn(192)
    model.save(tmp_path / "folder" / "model")
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["model.zip"]
    loaded = ReptilePPO.load(tmp_path / "folder" / "model", "Hanoi-v0")
    assert th.equal(weights(loaded), weights(model))
    assert loaded.reward_scaler.statistics.var == model.reward_scaler.statistics.var
    assert loaded.meta_iteration == model.meta_iteration > 0
    assert loaded.n_envs == model.n_envs
    observation = np.ones((4, 17), np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )
    other = make(policy, **options, seed=9)
    other.set_parameters(model.get_parameters())
    assert th.equal(weights(other), weights(model))
    if policy in ("ProgPolicy", "PRLPolicy"):
        assert loaded.program().body == model.program().body
    # Both go on alike, the meta-optimizer included.
    for going_on in (model, loaded):
        going_on.learn(128, reset_num_timesteps=False)
    assert th.equal(weights(loaded), weights(model))


def test_model_without_an_environment_predicts(tmp_path):
    make().learn(64).save(tmp_path / "model")
    model = ReptilePPO.load(tmp_path / "model")
    assert model.get_env() is None
    states, observation = None, np.ones(17, np.float32)
    for start in (True, False, True):
        action, states = model.predict(observation, states, np.array([start]), deterministic=True)
        assert action in range(6)
    fresh = model.predict(observation, None)[1]
    assert (states[0] != fresh[0]).any(), "the state survives the start of an episode"


@pytest.mark.parametrize("policy", ["ProgPolicy", "PRLPolicy"])
def test_normaliser_folds_into_the_program_that_is_extracted(policy):
    model = make(policy, "Pendulum-v1", normalize_observations=True, search_fraction=0.0).learn(192)
    assert float((model.policy.features_extractor.mean).abs().max()) > 0.01
    env = model.get_env()
    observation, states = env.reset(), None
    runner = ProgramRunner(model.program(), env.num_envs, "soft")
    for _ in range(20):
        actions, states = model.predict(observation, states, deterministic=True)
        np.testing.assert_allclose(runner.act(observation), actions, atol=1e-5)
        observation, *_ = env.step(actions)


def test_scaled_rewards_are_trained_on_and_true_ones_are_seen():
    raw = []
    model = make(env="Pendulum-v1", scale_rewards=True, n_epochs=1)
    model.learn(64, callback=Each(lambda _, local: raw.append(local["rewards"].copy())))
    scaled, raw = model.rollout_buffer.rewards.reshape(16, 4), np.array(raw)
    assert (np.abs(scaled) < np.abs(raw)).all()
    x = model.rollout_buffer.observations.reshape(16, 4, -1)
    np.testing.assert_allclose(x[1:, :, -2], raw[:-1], rtol=1e-5)


def test_returns_by_which_rewards_are_scaled_start_anew_with_a_task():
    model, expected = make(env="Pendulum-v1", scale_rewards=True, inner_updates=1), RewardScaler(0.99)

    def take_in(_, local):
        last = (model.num_timesteps // 4) % model.n_steps == 0
        expected(local["rewards"].copy(), np.full(4, last))

    model.learn(64 * 3, callback=Each(take_in))
    assert model.reward_scaler.statistics.mean == pytest.approx(expected.statistics.mean)
    assert model.reward_scaler.statistics.var == pytest.approx(expected.statistics.var)


def test_program_has_the_names_of_the_environment():
    program = make().program(note="hi")
    assert program.input_names[:3] == ("rank[0]", "colour[0]", "empty[0]")
    assert program.output_names[0] == "move 0->1"
    assert program.interaction
    assert program.n_observations == 9
    assert program.metadata["env"] == "Hanoi-v0"
    assert program.metadata["note"] == "hi"


def test_everything_that_is_promised_is_logged(tmp_path):
    model = make(tasks=[{"n_discs": 1}], n_steps=128, tensorboard_log=str(tmp_path), inner_updates=1)
    model.set_logger(configure(str(tmp_path / "csv"), ["csv"]))
    model.learn(1024)
    keys = set((tmp_path / "csv" / "progress.csv").read_text().splitlines()[0].split(","))
    label = model.tasks.label(0)
    promised = {f"success/{label}", f"steps/{label}", "reptile/meta_step_norm", "program/search_entropy"}
    promised |= {f"program/prob_{n}_conditions" for n in range(3)}
    promised |= {f"program/branch_{name}" for name in ("then_1", "then_2", "last_1", "last_2", "last_3")}
    promised |= {"train/approx_kl", "train/value_loss", "rollout/ep_len_mean", "time/total_timesteps"}
    assert promised <= keys


def test_tensorboard_progress_bar_and_callbacks_work_as_in_sb3(tmp_path):
    pytest.importorskip("tensorboard")
    initialised = []

    class Count(BaseCallback):
        def _init_callback(self):
            initialised.append(self)

        def _on_step(self):
            return True

    model = make(tensorboard_log=str(tmp_path / "logs"))
    model.learn(128, callback=[Count(), CheckpointCallback(16, str(tmp_path / "saved"))], progress_bar=True)
    assert list((tmp_path / "logs").glob("ReptilePPO_1/events*"))
    assert list((tmp_path / "saved").glob("*.zip"))
    assert len(initialised) == 1
    model.learn(128, callback=lambda local, _: False)
    assert model.num_timesteps == 4, "a callback ends the training"


def test_set_env_appends_the_history():
    model = make()
    model.set_env(make_vec_env("Hanoi-v0", 4))
    assert isinstance(model.get_env(), VecInteractionHistory)
    model.learn(64)
