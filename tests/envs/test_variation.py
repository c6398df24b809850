"""Variations are validated in one place, and what is refused is said."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS
from progpolicy_envs.variation import ChoiceParameter, IntParameter, VariationSpace

SPACE = VariationSpace(
    IntParameter("n_discs", 1, 12, 3, "number of discs"),
    ChoiceParameter("layout", ("fork", "bends"), "fork", "the map"),
)


@pytest.mark.parametrize("value", [0, 13, -1, 2.0, "3", None, True, [3]])
def test_integer_that_is_not_accepted_is_named_with_its_range(value: Any) -> None:
    with pytest.raises(ValueError, match=r"n_discs=.* is not accepted; n_discs is an integer from 1 to 12") as error:
        SPACE.update({}, {"n_discs": value})
    assert repr(value) in str(error.value)


@pytest.mark.parametrize("value", ["Fork", "", 3, None])
def test_choice_that_is_not_accepted_is_named_with_the_choices(value: Any) -> None:
    with pytest.raises(ValueError, match=r"layout=.* is not accepted; layout is one of 'fork', 'bends'"):
        SPACE.update({}, {"layout": value})


def test_unknown_name_is_answered_with_the_nearest_and_all_known() -> None:
    with pytest.raises(
        ValueError, match=r"'n_disks' \(did you mean 'n_discs'\?\).*n_discs: an integer.*layout: one of"
    ):
        SPACE.update({}, {"n_disks": 3})


def test_values_are_put_in_and_the_rest_is_kept() -> None:
    before = {"n_discs": 3, "layout": "fork"}
    after = SPACE.update(before, {"n_discs": np.int64(5)})
    assert after == {"n_discs": 5, "layout": "fork"}
    assert type(after["n_discs"]) is int
    assert before == {"n_discs": 3, "layout": "fork"}
    assert SPACE.update(before, None) == before


def extremes(env_id: str) -> list[tuple[str, Any]]:
    """Return every smallest and largest whole number of a task of a domain, and every choice."""
    values: list[tuple[str, Any]] = []
    for name, parameter in gym.make(env_id).unwrapped.variations.items():
        if isinstance(parameter, IntParameter) and parameter.of_start:  # not of the task, and bounded by its size
            continue
        both = (parameter.low, parameter.high) if isinstance(parameter, IntParameter) else parameter.choices
        values += [(name, value) for value in both]
    return values


PLANNING = [domain.id for domain in DOMAINS.values() if not domain.simulation]


@pytest.mark.parametrize("env_id", PLANNING)
def test_spaces_do_not_depend_on_the_variation(env_id: str) -> None:
    reference = gym.make(env_id)
    for name, value in extremes(env_id):
        variation = {name: value}
        if env_id == "Hanoi-v0" and name in ("source", "target"):
            variation = {"source": value, "target": 2 - value} if name == "source" else {"source": 1, "target": value}
        by_constructor = gym.make(env_id, **variation)
        assert by_constructor.observation_space == reference.observation_space
        assert by_constructor.action_space == reference.action_space
        _, by_reset = reference.reset(seed=4, options=variation)
        assert by_reset["variation"].items() >= variation.items()
        _, later = reference.reset()
        assert later["variation"] == by_reset["variation"]


@pytest.mark.parametrize("env_id", PLANNING)
def test_values_out_of_range_are_refused_by_constructor_and_by_reset(env_id: str) -> None:
    env = gym.make(env_id)
    for name, parameter in env.unwrapped.variations.items():
        bad = parameter.high + 1 if isinstance(parameter, IntParameter) else "no such choice"
        for refuse in (lambda: gym.make(env_id, **{name: bad}), lambda: env.reset(options={name: bad})):  # noqa: B023
            with pytest.raises(ValueError, match=rf"{name}=.*{bad}.* is not accepted; {name} is "):
                refuse()


@pytest.mark.parametrize("env_id", PLANNING)
def test_unknown_option_is_refused_and_changes_nothing(env_id: str) -> None:
    env = gym.make(env_id)
    _, before = env.reset(seed=0)
    with pytest.raises(ValueError, match="unknown variation parameter 'size'; known: "):
        env.reset(options={"size": 3})
    _, after = env.reset()
    assert after["variation"] == before["variation"]
