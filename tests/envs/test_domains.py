"""The domains: which variations are trained on, which are unseen, and that every one of them is accepted."""

from dataclasses import replace

import gymnasium as gym
import pytest

import progpolicy_envs
from progpolicy_envs import DOMAINS, MAX_EPISODE_STEPS, Domain, get_domain, register_domain

SIZES = {
    "Hanoi-v0": ({1, 2, 3, 4}, {5}, {6, 7, 8}),
    **{f"Hiking-{version}": ({1, 2, 3, 4}, {5}, {6, 7, 8, 9, 10}) for version in ("v0", "v1")},
    "HikingEgo-v0": ({1, 2, 3, 4}, {5}, {5, 6, 7, 8, 9, 10}),
    "Stacking-v0": ({1, 2, 3, 4}, {5}, {6, 7, 8}),
    **{f"Panda{task}-v0": ({1, 2, 3}, {4}, {5, 6, 7, 8}) for task in ("Reach", "Push", "Slide", "Stack")},
}


@pytest.mark.parametrize("env_id", SIZES)
def test_sizes_of_the_sets_are_those_of_the_specification(env_id: str) -> None:
    domain = DOMAINS[env_id]
    parts = (domain.train, domain.validation, domain.unseen)
    train, validation, unseen = ({variation[domain.size] for variation in part} for part in parts)
    assert (train, validation, unseen) == SIZES[env_id]
    assert next(iter(domain.train))[domain.size] == min(train), "the easiest comes first"


@pytest.mark.parametrize("domain", [domain for domain in DOMAINS.values() if not domain.simulation], ids=lambda d: d.id)
def test_every_variation_is_accepted_and_has_a_plan_within_the_cap(domain: Domain) -> None:
    env = gym.make(domain.id)
    assert env.spec is not None
    assert env.spec.max_episode_steps == MAX_EPISODE_STEPS == 500
    for variation in (*domain.train, *domain.validation, *domain.unseen):
        _, info = env.reset(seed=0, options=variation)
        assert info["variation"].items() >= variation.items()
        assert 1 <= info["optimal_steps"] <= MAX_EPISODE_STEPS


def test_egocentric_hiking_is_tested_on_maps_and_numbers_of_stars_not_trained_on() -> None:
    domain = DOMAINS["HikingEgo-v0"]
    for name in ("n_stars", "layout"):
        sets = [{v[name] for v in part} for part in (domain.train, domain.validation, domain.unseen)]
        assert sum(map(len, sets)) == len(set.union(*sets)) + (name == "n_stars")  # five stars, on other maps


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


@pytest.mark.parametrize("domain", DOMAINS.values(), ids=lambda d: d.id)
def test_declared_defaults_are_those_of_the_environments(domain: Domain) -> None:
    pytest.importorskip("pybullet") if domain.simulation else None
    assert domain.space is not None
    assert gym.make(domain.id).reset(seed=0)[1]["variation"] == domain.space.defaults
    batch = gym.make_vec(domain.id, num_envs=1)
    shown = batch.reset(seed=0)[1]["variation"]
    batch.close()
    assert shown[0] == domain.space.defaults
    for name, parameter in domain.space.items():
        assert parameter.parse(parameter.default) == parameter.default
        assert parameter.kind == ("choice" if name == "layout" else "integer")


def test_training_variations_are_tested_without_what_training_draws() -> None:
    assert DOMAINS["Hanoi-v0"].trained == tuple({"n_discs": n} for n in (1, 2, 3, 4))
    ego = DOMAINS["HikingEgo-v0"]
    assert ego.trained == ego.train


def test_relation_of_a_variation_to_training() -> None:
    hanoi, ego = DOMAINS["Hanoi-v0"], DOMAINS["HikingEgo-v0"]
    assert hanoi.relation({"n_discs": 3}) == "trained"
    assert hanoi.relation({"n_discs": 6}) == "extrapolated"
    fixed = [{"n_discs": 3, "source": 0, "target": 2}]
    relations = [hanoi.relation({"n_discs": n}, fixed) for n in (2, 3, 4)]
    assert relations == ["easier", "trained", "extrapolated"]
    assert hanoi.relation({"n_discs": 3, "source": 1}, fixed) == "extrapolated"
    assert hanoi.relation({"n_discs": 3}, [{"n_discs": 2}, {"n_discs": 4}]) == "interpolated"
    assert ego.relation({"n_stars": 2, "layout": "spiral"}) == "extrapolated"


class Corridor(gym.Env):  # type: ignore[type-arg]
    observation_space = action_space = gym.spaces.Discrete(2)

    def __init__(self, length: int = 3) -> None:
        self.length = length


def test_domain_of_the_users_own() -> None:
    sets = {"train": [{"length": 2}, {"length": 3}], "validation": [{"length": 4}], "unseen": [{"length": 9}]}
    with pytest.raises(ValueError, match="id='Corridor-v0' is not registered"):
        register_domain("Corridor-v0", "length", **sets)
    gym.register("Corridor-v0", entry_point=Corridor)
    try:
        domain = register_domain("Corridor-v0", "length", **sets)
        assert get_domain("here:Corridor-v0") is domain
        assert domain.space is None
        assert register_domain("Corridor-v0", "length", **sets) == domain, "declared again by a reload"
        progpolicy_envs.register_envs()
        with pytest.raises(ValueError, match="'length': 3} is not accepted in both train and unseen"):
            register_domain("Corridor-v0", "length", **{**sets, "unseen": [{"length": 3}]})
        with pytest.raises(ValueError, match="it gives 'length', the size, as a number"):
            register_domain("Corridor-v0", "length", **{**sets, "unseen": [{"width": 3}]})
        with pytest.raises(ValueError, match=r"validation=\(\) is not accepted; Corridor-v0 needs at least one"):
            register_domain("Corridor-v0", "length", **{**sets, "validation": []})
    finally:
        del gym.registry["Corridor-v0"]
        DOMAINS.pop("Corridor-v0", None)
    with pytest.raises(ValueError, match="this package has a domain of this name"):
        register_domain("Hanoi-v0", "n_discs", [{"n_discs": 1}], [{"n_discs": 2}], [{"n_discs": 3}])


def test_variations_of_a_domain_are_within_the_bounds_of_its_environment() -> None:
    gym.register("HanoiToo-v0", entry_point="progpolicy_envs.hanoi:HanoiEnv")
    try:
        with pytest.raises(ValueError, match="n_discs=13 is not accepted; n_discs is an integer from 1 to 12"):
            register_domain("HanoiToo-v0", "n_discs", [{"n_discs": 1}], [{"n_discs": 2}], [{"n_discs": 13}])
        assert "HanoiToo-v0" not in DOMAINS
    finally:
        del gym.registry["HanoiToo-v0"]
