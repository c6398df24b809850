"""The domains: which variations are trained on, which are unseen, and that every one of them is accepted."""

from dataclasses import replace

import gymnasium as gym
import pytest

import progpolicy_envs
from progpolicy_envs import DOMAINS, MAX_EPISODE_STEPS, Domain, get_domain

SIZES = {
    "Hanoi-v0": ({1, 2, 3, 4}, {5, 6, 7, 8}),
    "Hiking-v0": ({1, 2, 3, 4}, {5, 6, 7, 8, 9, 10}),
    "HikingEgo-v0": ({1, 2, 3, 4}, {5, 6, 7, 8, 9, 10}),
    "Stacking-v0": ({1, 2, 3, 4}, {5, 6, 7, 8}),
}


@pytest.mark.parametrize("env_id", SIZES)
def test_training_and_unseen_sizes_are_those_of_the_specification(env_id: str) -> None:
    domain = DOMAINS[env_id]
    train, unseen = ({variation[domain.size] for variation in part} for part in (domain.train, domain.unseen))
    assert (train, unseen) == SIZES[env_id]
    assert next(iter(domain.train))[domain.size] == min(train), "the easiest comes first"


@pytest.mark.parametrize("domain", [DOMAINS[env_id] for env_id in SIZES], ids=lambda d: d.id)
def test_every_variation_is_accepted_and_has_a_plan_within_the_cap(domain: Domain) -> None:
    env = gym.make(domain.id)
    assert env.spec is not None
    assert env.spec.max_episode_steps == MAX_EPISODE_STEPS == 500
    for variation in (*domain.train, *domain.unseen):
        _, info = env.reset(seed=0, options=variation)
        assert info["variation"].items() >= variation.items()
        assert 1 <= info["optimal_steps"] <= MAX_EPISODE_STEPS


def test_egocentric_hiking_is_tested_on_maps_and_numbers_of_stars_not_trained_on() -> None:
    domain = DOMAINS["HikingEgo-v0"]
    for name in ("n_stars", "layout"):
        train, unseen = ({v[name] for v in part} for part in (domain.train, domain.unseen))
        assert not train & unseen


def test_former_name_of_egocentric_hiking_is_deprecated_and_still_makes_it() -> None:
    with pytest.warns(DeprecationWarning, match=r'HIKING_EGOCENTRIC is deprecated; it is DOMAINS\["HikingEgo-v0"\]'):
        domain = progpolicy_envs.HIKING_EGOCENTRIC
    assert domain is DOMAINS["HikingEgo-v0"]
    assert gym.make(domain.id, **domain.arguments).unwrapped.observation_names[0] == "window[-4,-4]"
    with pytest.raises(AttributeError, match="HIKING_EGO"):
        progpolicy_envs.HIKING_EGO  # noqa: B018


def test_registration_reads_the_domains(monkeypatch: pytest.MonkeyPatch) -> None:
    hanoi = DOMAINS["Hanoi-v0"]
    two_discs = replace(hanoi, id="HanoiTwo-v0", arguments={"n_discs": 2})
    monkeypatch.setitem(DOMAINS, two_discs.id, two_discs)
    progpolicy_envs.register_envs()
    try:
        for env in (gym.make(two_discs.id), gym.make_vec(two_discs.id, num_envs=1)):
            assert "'n_discs': 2" in str(env.reset(seed=0)[1]["variation"])
    finally:
        del gym.registry[two_discs.id]


def test_domain_is_found_with_and_without_module_prefix() -> None:
    assert get_domain("progpolicy_envs:Hanoi-v0") is get_domain("Hanoi-v0") is DOMAINS["Hanoi-v0"]


def test_unknown_domain_is_answered_with_the_nearest() -> None:
    with pytest.raises(ValueError, match="'Hanoy-v0' is not one of this package's environments; nearest: Hanoi-v0"):
        get_domain("Hanoy-v0")
