"""Suites are checked before anything runs."""

import json

import pytest

from sb3_progpolicy.benchmark.suite import Cell, load_suite, parse_suite
from sb3_progpolicy.experiment.methods import METHODS
from tests.benchmark.small import SMALL, SUITES


@pytest.mark.parametrize("name", ["smoke", "planning", "panda", "paper"])
def test_shipped_suites_are_accepted(name):
    suite = load_suite(SUITES / f"{name}.yml")
    assert suite.name == name
    assert len({cell.key for cell in suite.cells}) == len(suite.cells)
    if name != "paper":
        compared = {method for method, entry in METHODS.items() if entry.compared}
        assert {cell.method for cell in suite.cells} == compared
        assert len(compared) == 9


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seeds": [0, 0]}, "seeds=.* is not accepted"),
        ({"seeds": 3}, "seeds=3 is not accepted"),
        ({"methods": {"ppoo": {}}}, "unknown algorithm 'ppoo'; nearest: ppo"),
        ({"methods": {"ppo": {"n_stepps": 3}}}, "ppo on Hanoi-v0: unknown hyperparameter 'n_stepps'; nearest: n_steps"),
        ({"methods": ["ppo"]}, "methods=.* is not accepted; it is a mapping"),
        ({"domains": {"CartPole-v1": {}}}, "'CartPole-v1' is not one of this package's environments"),
        ({"episodes": 0}, "episodes=0 is not accepted; it is a whole number from 1"),
        ({"episods": 3}, "unknown entry 'episods'; nearest: episodes"),
        ({"max_minutes": "long"}, "max_minutes='long' is not accepted; it is a number from 0"),
        ({"name": None}, "name is missing"),
    ],
)
def test_mistake_in_a_suite_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        parse_suite({**SMALL, **change})


def test_variant_of_a_method_has_a_name_of_its_own():
    suite = parse_suite({**SMALL, "methods": {"long": {"algo": "ppo", "n_timesteps": 512}, "ppo": {}}})
    long, usual = suite.cells[:2]
    assert (long.method, long.config.algo, long.config.n_timesteps) == ("long", "ppo", 512)
    assert (usual.method, usual.config.n_timesteps) == ("ppo", 1_000_000)
    assert Cell.from_json(json.loads(json.dumps(long.to_json()))).key == long.key


def test_key_follows_from_all_that_decides_the_result():
    changes = [{}, {"episodes": 2}, {"max_minutes": 1}, {"domains": {"Hanoi-v0": {}}}, {"curve_points": 3}]
    changes.append({"methods": {"ppo": {"gamma": 0.9}}})
    keys = {parse_suite({**SMALL, **change}).cells[0].key for change in changes}
    assert len(keys) == len(changes)
    assert parse_suite(SMALL).cells[0].key == parse_suite({**SMALL, "name": "other"}).cells[0].key
