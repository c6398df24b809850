"""What the command line says of mistakes and of errors that nobody expected."""

import re
from pathlib import Path

import pytest
import torch
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


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "-n", "0"],
        ["train", "-n", "-5"],
        ["train", "--seed", str(2**32)],
        ["train", "--device", "meta"],
        ["train", "--env", "not_a_module:Nope-v0"],
        *(
            ["train", "-n", "64", "--hyperparams", pair]
            for pair in (
                "learning_rate:-1",
                "learning_rate:nan",
                "learning_rate:.inf",
                "learning_rate:lin_-1",
                "learning_rate:lin_nan",
                "gamma:2",
                "gae_lambda:-0.1",
                "clip_range:-0.1",
                "action_std:0",
                "search_fraction:1.5",
                "length_coef:-1",
                "n_epochs:0",
                "ent_coef:inf",
                "policy_kwargs:{depth: 0}",
                "policy_kwargs:{depth: 1000000000}",
                "policy_kwargs:dict(init_temperature=1e999)",
                "n_envs:100000000",
                "tasks:3",
                "timeouts:failure",
            )
        ),
        ["train", "-n", "64", "--env-kwargs", "n_discs:nan"],
        ["train", "-n", "64", "--env-kwargs", "n_discs:[1]"],
        *(["evaluate", "Hanoi-v0", "--set", pair] for pair in ("n_discs=nan", "n_discs=1.5", "n_discs={}", "n_discs=")),
        *(["evaluate", "Hanoi-v0", "--set", pair] for pair in ("n_discs=null", "source=[0]", "source=9", "a=b=c", "3")),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_trained(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sb3_progpolicy.experiment.run.train", lambda *_: pytest.fail("it trains"))
    assert run(arguments) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_device_that_is_not_there_is_refused(tmp_path, capsys):
    assert run(["train", "--device", "cuda", "-n", "64", "-f", str(tmp_path)]) == 2
    assert "device='cuda' is not accepted here" in capsys.readouterr().err


def test_version_and_help(capsys):
    assert run(["--version"]) == 0
    assert re.fullmatch(r"progpolicy \d+\.\d+\.\d+\S*\n", capsys.readouterr().out)
    assert run([]) == 0
    printed = capsys.readouterr().out
    assert all(command in printed for command in ("train", "evaluate", "--version"))


@pytest.mark.parametrize(
    ("name", "start"),
    [("a.py", b"#"), ("a.tex", b"{\\scriptsize"), ("a.dot", b"digraph"), ("a.PNG", b"\x89PNG"), ("a", b"Program")],
)
def test_format_follows_the_suffix_unless_it_is_given(name, start, tmp_path):
    assert run(["show", "Hanoi-v0", "-o", str(tmp_path / name)]) == 0
    assert (tmp_path / name).read_bytes().startswith((start, b'"""'))
    assert run(["show", "Hanoi-v0", "-o", str(tmp_path / name), "--format", "text"]) == 0
    assert (tmp_path / name).read_bytes().startswith(b"Program")
