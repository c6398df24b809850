"""What commands that read, show and film programs must not pass over."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from sb3_progpolicy import evaluate_program, load_pretrained, verify
from sb3_progpolicy.cli import run
from sb3_progpolicy.surroundings import surroundings

OWN = """
import gymnasium as gym
from progpolicy_envs.hanoi import HanoiEnv

gym.register("%s-v0", entry_point=HanoiEnv, max_episode_steps=50)
"""


def hanoi(**metadata):
    """The shipped program, with other metadata."""
    program = load_pretrained("Hanoi-v0")
    return replace(program, metadata={**program.metadata, **metadata})


def own_module(tmp_path, monkeypatch, name):
    """Put a module that registers an environment into the working directory, and a program for it beside it."""
    (tmp_path / f"{name}.py").write_text(OWN % name)
    monkeypatch.chdir(tmp_path)
    env_id = f"{name}:{name}-v0"
    hanoi(env=env_id, env_kwargs={"n_discs": 2}).save(tmp_path / "program.json")
    return env_id


@pytest.fixture
def registry():
    """Take out again what a test registers."""
    before = dict(gym.registry)
    yield
    for name in set(gym.registry) - set(before):
        del gym.registry[name]


def test_a_file_that_is_read_is_not_overwritten(tmp_path, capsys):
    program = tmp_path / "program.json"
    load_pretrained("Hanoi-v0").save(program)
    before = program.read_bytes()
    for arguments, message in (
        (["show", str(program), "-o", str(program)], "it ends in .txt"),
        (["show", str(program), "-o", str(program), "--format", "text"], "it is the program itself"),
        (["show", str(program), "-o", str(tmp_path / "p.svg")], "it ends in .txt"),
        (
            ["show", str(program), "--format", "python", "--set", "n_discs=3"],
            "--set and --seed are for --format activity",
        ),
        (["render", "Hanoi-v0", "--random", "--semantics", "soft", "-o", "a.gif"], "--semantics is for programs"),
        (["simplify", str(program), "--curve", "nowhere/c.csv"], "--curve 'nowhere/c.csv' is not accepted"),
        (["evaluate", "Hanoi-v0", "--set", "n_discs=5", "--set", "n_discs=6"], "n_discs is given twice"),
        (
            ["simplify", str(program), "--curve", str(tmp_path / "c.csv"), "-o", str(tmp_path / "s.json")],
            "--curve is for",
        ),
    ):
        assert run(arguments) == 2
        assert message in capsys.readouterr().err
    assert program.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["program.json"]


def test_a_start_without_a_step_to_take_is_not_filmed(tmp_path, capsys):
    arguments = ["render", "Hanoi-v0", "--planner", "--set", "n_discs=2", "discs=[2,2]", "target=2", "-o"]
    assert run([*arguments, str(tmp_path / "s.gif")]) == 2
    assert "nothing is left to be done there" in capsys.readouterr().err


def test_activity_shows_the_program_as_it_acts(tmp_path):
    """The simplified one is the same from the starts of training, and not from others."""
    state = ["--set", "n_discs=4", "source=1", "target=0", "discs=[2,2,1,0]"]
    shown, learnt = (tmp_path / name for name in ("shown.png", "learnt.png"))
    assert run(["show", "Hanoi-v0", "--format", "activity", *state, "-o", str(shown)]) == 0
    assert run(["show", "Hanoi-v0", "--format", "activity", "--full", *state, "-o", str(learnt)]) == 0
    assert shown.read_bytes() == learnt.read_bytes()


def test_a_programs_own_arguments_hold_however_its_environment_is_named():
    capped = {"max_episode_steps": 4}
    for named, given in (("Hanoi-v0", "progpolicy_envs:Hanoi-v0"), ("progpolicy_envs:Hanoi-v0", "Hanoi-v0")):
        program = hanoi(env=named, env_kwargs=capped)
        (row,) = evaluate_program(program, given, [{"n_discs": 3}])
        assert (row.success_rate, row.steps_mean) == (0, 4)
        assert surroundings(program, given).cap == 4


@pytest.mark.usefixtures("registry")
def test_a_programs_own_arguments_hold_where_its_module_is_not_imported(tmp_path, monkeypatch, capsys):
    env_id = own_module(tmp_path, monkeypatch, "OwnArguments")
    commands = (
        ["evaluate", "program.json", "--json"],
        ["compare", "program.json", "program.json", "--json"],
        ["card", "program.json", "--no-film"],
        ["render", "program.json", "-o", "film.gif"],
        ["verify", "program.json"],
        ["simplify", "program.json"],
    )
    for command in commands:
        assert run(command) == 2
        said = capsys.readouterr().err
        assert f"names the environment {env_id}, and a file may not have the module OwnArguments imported" in said
        assert f"give --env {env_id}" in said
    for command in commands[:4]:
        assert run([*command, "--env", env_id]) == 0
        out = capsys.readouterr().out
        if "--json" in command:
            assert {row["steps_mean"] for row in json.loads(out)} == {3}  # of two discs, its own
    assert (tmp_path / "film.gif").is_file()
    assert run([*commands[2], "--env", "Hiking-v0"]) == 2
    assert f"a card is for {env_id}" in capsys.readouterr().err
    assert run(["compare", "program.json", "Hanoi-v0", "--env", env_id, "--json"]) == 0


@pytest.mark.usefixtures("registry")
def test_a_files_environment_is_not_imported_for_a_verification(tmp_path, monkeypatch):
    own_module(tmp_path, monkeypatch, "OwnVerified")
    with pytest.raises(ValueError, match="give env_id=OwnVerified:OwnVerified-v0"):
        verify(hanoi(env="OwnVerified:OwnVerified-v0"))
    assert "OwnVerified-v0" not in gym.registry


@pytest.mark.parametrize(
    ("metadata", "said"),
    [
        ({"env_kwargs": [1]}, "env_kwargs=[1] is not accepted; it is a mapping"),
        ({"wrappers": 3}, "wrappers=3 of the program is not accepted; it is a list of names"),
        ({"wrappers": "Flatten"}, "wrappers='Flatten' of the program is not accepted"),
    ],
)
def test_odd_metadata_are_named(tmp_path, capsys, metadata, said):
    hanoi(**metadata).save(tmp_path / "program.json")
    for command in (["evaluate"], ["render", "-o", str(tmp_path / "film.gif")], ["verify"], ["simplify"]):
        assert run([command[0], str(tmp_path / "program.json"), *command[1:]]) == 2
        assert said in capsys.readouterr().err


class Unseen(gym.Env):
    """Has no picture, or one that is none."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    metadata = {"render_modes": ["ansi"]}

    def __init__(self, render_mode=None):
        assert render_mode is None or render_mode in self.metadata["render_modes"]
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, True, False, {}

    def render(self):
        return None


class Unshown(Unseen):
    """Says that it has pictures, and gives none."""

    metadata = {"render_modes": ["rgb_array"]}


@pytest.mark.usefixtures("registry")
def test_an_environment_without_pictures_is_not_filmed(tmp_path, capsys):
    for name, env, said in (
        ("Unseen-v0", Unseen, "Unseen-v0 cannot be filmed; a film needs the render mode rgb_array, and it has ansi"),
        ("Unshown-v0", Unshown, "Unshown-v0 cannot be filmed; its render() returned NoneType"),
    ):
        gym.register(name, entry_point=env, max_episode_steps=5)
        assert run(["render", name, "--random", "-o", str(tmp_path / "film.gif")]) == 2
        assert said in capsys.readouterr().err


def test_compared_variations_can_be_told_apart(capsys):
    assert run(["compare", "HikingEgo-v0", "HikingEgo-v0", "--episodes", "1"]) == 0
    out = capsys.readouterr().out
    assert "n_stars" in out
    assert "layout" in out


def test_names_of_runs_are_shown_as_they_are(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    hanoi().save(tmp_path / "run[bold].json")
    assert run(["compare", "run[bold].json", "Hanoi-v0", "--episodes", "1", "--set", "n_discs=1"]) == 0
    assert "run[bold].json" in capsys.readouterr().out.replace("\n", "")
