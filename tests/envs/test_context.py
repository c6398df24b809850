"""The variation's numbers as part of the observation, if that is asked for."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from progpolicy_envs import DOMAINS
from sb3_progpolicy import ReptilePPO, evaluate_program

DOMAIN_IDS = list(DOMAINS)


def skip_without_pybullet(env_id):
    if DOMAINS[env_id].simulation:
        pytest.importorskip("pybullet")


@pytest.mark.parametrize("env_id", DOMAIN_IDS)
def test_observed_context_ends_the_observation_and_changes_nothing_else(env_id):
    skip_without_pybullet(env_id)
    domain = DOMAINS[env_id]
    hidden, observed = gym.make(env_id), gym.make(env_id, context="observed")
    names = domain.space.context_names
    n_hidden = hidden.observation_space.shape[0]
    assert observed.observation_space.shape == (n_hidden + len(names),)
    assert observed.unwrapped.observation_names == (*hidden.unwrapped.observation_names, *names)
    for variation in (domain.train[0], domain.unseen[-1]):
        starts = [env.reset(seed=3, options=dict(variation))[0] for env in (hidden, observed)]
        context = domain.space.encode(observed.unwrapped.variation)
        np.testing.assert_array_equal(starts[1], np.concatenate([starts[0], context]))
        assert observed.observation_space.contains(starts[1])
        observed.action_space.seed(0)
        action = observed.action_space.sample()
        steps = [env.step(action) for env in (hidden, observed)]
        np.testing.assert_array_equal(steps[1][0], np.concatenate([steps[0][0], context]))
        assert steps[0][1:4] == steps[1][1:4]
    for env in (hidden, observed):
        env.close()


@pytest.mark.parametrize("env_id", DOMAIN_IDS)
def test_batch_observes_the_context_of_each_row(env_id):
    skip_without_pybullet(env_id)
    domain = DOMAINS[env_id]
    batch = gym.make_vec(
        env_id, num_envs=2, vectorization_mode="vector_entry_point", context="observed", max_episode_steps=2
    )
    assert batch.observation_names == gym.make(env_id, context="observed").unwrapped.observation_names
    sizes = [domain.train[0][domain.size], domain.train[-1][domain.size]]
    observations, _ = batch.reset(seed=0, options={domain.size: sizes})
    n_context = len(domain.space.context_names)
    expected = [domain.space.encode({**domain.space.defaults, domain.size: size}) for size in sizes]
    for _ in range(2):
        np.testing.assert_array_equal(observations[:, -n_context:], expected)
        observations, _, _, truncated, infos = batch.step(np.zeros_like(batch.action_space.sample()))
    assert truncated.all()
    np.testing.assert_array_equal(np.stack(infos["final_obs"])[:, -n_context:], expected)
    np.testing.assert_array_equal(observations[:, -n_context:], expected)
    assert batch.single_observation_space.contains(observations[0])
    batch.close()


def test_numbers_of_a_variation():
    space = DOMAINS["Hanoi-v0"].space
    assert space.context_names == ("n_discs", "source", "source=random", "target", "target=random")
    assert space.encode({"n_discs": 12, "source": 1, "target": "random"}).tolist() == [1, 0.5, 0, 0, 1]
    assert space.encode({"n_discs": 1, "source": 0, "target": 2}).tolist() == [0, 0, 0, 1, 0]
    layouts = DOMAINS["HikingEgo-v0"].space
    assert layouts.encode({"n_stars": 1, "layout": "comb"})[1:].sum() == 1


def test_environment_with_context_passes_gymnasiums_check():
    check_env(gym.make("Stacking-v0", context="observed").unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", ["Hanoi-v0", "PandaReach-v0"])
def test_other_words_are_refused(env_id):
    skip_without_pybullet(env_id)
    for make in (gym.make, lambda *a, **k: gym.make_vec(*a, num_envs=1, **k)):
        with pytest.raises(ValueError, match="context='shown' is not accepted; it is one of 'hidden', 'observed'"):
            make(env_id, context="shown")


def test_goal_form_has_no_room_for_it():
    pytest.importorskip("pybullet")
    with pytest.raises(ValueError, match="it is for one array of numbers"):
        gym.make("PandaPush-v0", observation="goal", context="observed")


def test_program_is_trained_saved_and_evaluated_with_it(tmp_path):
    model = ReptilePPO(
        "ProgPolicy", "Hanoi-v0", n_envs=4, n_steps=16, seed=0, env_kwargs={"context": "observed"}
    ).learn(128)
    program = model.program()
    assert program.n_observations == 9 + 5
    assert "n_discs" in program.input_names
    model.save(tmp_path / "model.zip")
    loaded = ReptilePPO.load(tmp_path / "model.zip", env="Hanoi-v0")
    assert loaded.observation_space == model.observation_space
    variations = [{"n_discs": 1}, {"n_discs": 2}]
    rows = evaluate_program(program, "Hanoi-v0", variations, max_steps=5, env_kwargs={"context": "observed"})
    assert [row.optimal_steps_mean for row in rows] == [1, 3]
    assert evaluate_program(program, "Hanoi-v0", variations, max_steps=5) == rows  # the program's own, by default
    with pytest.raises(ValueError, match="the program reads 14 numbers"):
        evaluate_program(program, "Hanoi-v0", variations, env_kwargs={})
