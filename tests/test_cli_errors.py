"""What the command line says of mistakes and of errors that nobody expected."""

import re
from pathlib import Path

import pytest
import yaml

from sb3_progpolicy.cli import run
from sb3_progpolicy.experiment.config import RunConfig, parse_config
from sb3_progpolicy.hyperparams import read_yaml

GOOD = {"algo": "ppo", "env": "CartPole-v1", "seed": 0, "hyperparams": {"policy": "MlpPolicy", "n_timesteps": 10}}


@pytest.fixture
def failing(monkeypatch):
    """``progpolicy envs`` with a fault in it."""

    def fail(*_):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("rich.table.Table.add_column", fail)
    return ["envs"]


def test_unexpected_error_is_one_line_that_names_its_report(failing, capsys):
    assert run(failing) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    report = Path(re.search(r"its report is in (\S+)", said)[1])
    assert "Traceback" in report.read_text()
    assert "['envs']" in report.read_text()
    report.unlink()


def test_traceback_is_shown_where_it_is_asked_for(failing, monkeypatch, capsys):
    monkeypatch.setenv("PROGPOLICY_TRACEBACK", "1")
    assert run(failing) == 1
    assert "Traceback" in capsys.readouterr().err
    assert run(["evaluate", "nowhere.json"]) == 2
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("PROGPOLICY_TRACEBACK", "0")
    assert run(["train", "--env", "Nope-v0", "--verbose", "2"]) == 2
    assert "Traceback" in capsys.readouterr().err
    assert run(["train", "--env", "Nope-v0", "--verbose", "1"]) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"env_kwargs": None}, "env_kwargs=None is not accepted; it is a mapping"),
        ({"hyperparams": {**GOOD["hyperparams"], "n_envs": None}}, "n_envs=None"),
        ({"hyperparams": {"policy": "MlpPolicy"}}, "n_timesteps is missing"),
        ({"hyperparams": {**GOOD["hyperparams"], "n_envs": 10**6}}, "at most 65536"),
        ({"hyperparams": {**GOOD["hyperparams"], "n_envs": 2**15, "n_steps": 2**20}}, "n_envs times n_steps"),
        ({"seed": -1}, "seed=-1"),
        ({"seed": True}, "seed=True"),
        ({"env": [1]}, "it is a text"),
        ({"algo": {"a": 1}}, "it is a text"),
        ({"device": 3}, "it is a text"),
        ({"extra": 1}, "unknown field 'extra'"),
    ],
)
def test_damaged_configuration_is_refused(changes, said):
    assert isinstance(parse_config(GOOD), RunConfig)
    with pytest.raises(ValueError, match=said):
        parse_config({**GOOD, **changes})


@pytest.mark.parametrize("described", [None, [1], "text", 3, {}])
def test_what_is_no_configuration_is_refused(described):
    with pytest.raises(ValueError, match=r"is not accepted|is missing"):
        parse_config(described)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 3000, "nested too deeply"),
        ("[" * 30 + "]" * 30, "nested too deeply"),
        ("&a [*a]", "nested too deeply"),
        ("a: [", "is not YAML"),
        ("!!bool x", "is not YAML"),
        ("2020-13-45", "is not YAML"),
        ("2020-01-01", "holds a date"),
        (".nan", "numbers are finite"),
        ("3: 4", "not a text"),
        ("\0", "is not YAML"),
        ("x" * 10**6 + "x", "at most 1000000"),
        (yaml.safe_dump([0] * 20_000), "more than 10000 items"),
        ("a: &a [1,1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b]\nd: [*c,*c,*c]\n"
         "e: [*c,*c,*c,*c,*c,*c,*c,*c,*c,*c,*c,*c,*c,*c,*c]", "more than 10000 items"),
    ],
)  # fmt: skip
def test_text_that_is_no_plain_yaml_is_refused(text, said):
    with pytest.raises(ValueError, match=said):
        read_yaml(text)
