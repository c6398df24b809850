"""Pages: what they hold, that nothing of a program becomes code, and that they decide as the interpreter does."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import gymnasium as gym
import numpy as np
import pytest

from sb3_progpolicy import ReptilePPO, load_pretrained, pretrained_names
from sb3_progpolicy.pages import export_html
from sb3_progpolicy.pages.episodes import pack_numbers
from sb3_progpolicy.programs import ProgramRunner, explain
from tests.handwritten.hiking import egocentric_program, map_program
from tests.handwritten.panda import PROGRAMS
from tests.programs.hostile import with_hostile_texts, with_plain_texts
from tests.programs.node import run_node
from tests.programs.strategies import build_program, hanoi_program, small_program

MAX_BYTES = 1_000_000
FRAMES = """
    const scripts = data.scripts.join("\\n");
    const run = new Function("data", scripts + `;
        const policy = new ProgramPolicy();
        return data.episodes.map((episode) => {
            const world = WORLDS[data.world];
            const frames = world ? simulate(policy, new world(episode.start), data.cap, episode.actions)
                                 : replay(policy, episode);
            return frames.map(({ chosen, action, reward, final, success, conditionValues, outputs, branch, memory }) =>
                ({ chosen, action, reward, final, success, conditionValues, outputs, branch, memory }));
        });`);
    return run(data);
"""


class Elements(HTMLParser):
    """The elements of a page with the names of their attributes, and the contents of its scripts."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.scripts, self._inside = [], [], False
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, tuple(name for name, _ in attrs)))
        if tag == "script":
            self.scripts.append("")
            self._inside = True

    def handle_endtag(self, tag):
        self._inside = self._inside and tag != "script"

    def handle_data(self, data):
        if self._inside:
            self.scripts[-1] += data


def frames_of(page):
    """The data of a page and, for every episode in it, what its own scripts make of it."""
    data_text, *scripts = Elements(page).scripts
    data = json.loads(data_text)
    return data, run_node(FRAMES, {**data, "scripts": scripts[:3]})


def shipped_pages():
    return {name: lambda name=name: load_pretrained(name) for name in pretrained_names()}


PAGES = {
    **shipped_pages(),
    "a random recurrent program for Hanoi-v0": lambda: hanoi_program(3, "gru"),
    "Hiking-v1 by hand": map_program,
    "HikingEgo-v0 by hand": egocentric_program,
    "PandaStack-v0 by hand": PROGRAMS["PandaStack-v0"],
}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_decides_as_the_interpreter_in_every_embedded_episode(name):
    program = PAGES[name]()
    page = export_html(program)
    data, episodes = frames_of(page)
    kinds = {episode["kind"] for episode in data["episodes"]}
    assert len(page.encode()) < MAX_BYTES
    assert {"trained", "unseen"} <= kinds
    env = gym.make(program.metadata["env"])
    for episode, frames in zip(data["episodes"], episodes, strict=True):
        *steps, last = frames
        assert len(steps) == episode["steps"]
        assert last["final"]
        assert last["success"] == episode["success"]
        observation, _ = env.reset(seed=episode["seed"], options=episode["variation"])
        runner, action, reward, done = ProgramRunner(program), None, np.float32(0), False
        for frame in steps:
            step = explain(program, observation, action, float(reward), done, runner)
            assert frame["chosen"] == frame["action"] == np.asarray(step.action).tolist()
            assert frame["branch"] == step.branch
            if all(condition.cell == "affine" for condition in program.conditions):
                assert frame["conditionValues"] == list(step.condition_values)
                assert frame["outputs"] == [list(outputs) for outputs in step.outputs]
            np.testing.assert_allclose(frame["conditionValues"], step.condition_values, rtol=0, atol=1e-9)
            action = step.action
            observation, earned, terminated, truncated, _ = env.step(action)
            reward, done = np.float32(earned), terminated or truncated
            assert np.float32(frame["reward"]) == reward
    env.close()


@pytest.mark.parametrize("given", [True, False], ids=["argument", "metadata"])
def test_a_page_has_the_cap_of_its_environment(given):
    kwargs, program = {"max_episode_steps": 20}, load_pretrained("Hanoi-v0")
    own = replace(program, metadata={**program.metadata, "env_kwargs": kwargs})
    data, episodes = frames_of(export_html(program, env_kwargs=kwargs) if given else export_html(own))
    assert data["cap"] == 20
    for episode, frames in zip(data["episodes"], episodes, strict=True):
        assert len(frames) - 1 == episode["steps"] <= 20
        assert frames[-1]["success"] == episode["success"]
    assert {episode["success"] for episode in data["episodes"]} == {True, False}


def test_a_page_shows_the_environment_that_the_program_was_trained_in():
    model = ReptilePPO("PRLPolicy", "Hanoi-v0", env_kwargs={"context": "observed"}, n_envs=2, n_steps=8, seed=0)
    page = export_html(model.program())  # with the numbers of the variation in its observations
    assert json.loads(Elements(page).scripts[0])["episodes"]


def test_a_page_loads_nothing_and_has_keys_labels_and_two_colour_schemes():
    for name in pretrained_names():
        page = export_html(load_pretrained(name))
        assert not re.search(r"(?:src|href)\s*=\s*[\"']?(?:https?:)?//", page)
        assert "@import" not in page
        assert "url(" not in page
        assert "default-src 'none'" in page
        for word in ("prefers-color-scheme", "keydown", "aria-label"):
            assert word in page
        assert 'lang="en"' in page


def test_a_page_explains_the_inputs_in_the_words_of_the_environment():
    page = export_html(load_pretrained("Hanoi-v0"))
    # A row that the docstring breaks into two lines is one row here.
    assert "0 middle, 1 largest; an empty peg counts as largest" in page
    assert "Move a tower of discs" in page


def test_a_page_says_that_its_program_was_simplified():
    words = "what was learnt may differ beyond training"
    assert words in export_html(load_pretrained("HikingEgo-v0"))
    assert words not in export_html(load_pretrained("Hanoi-v0"))


def test_no_text_of_a_program_becomes_markup_or_code_of_its_page():
    rng = np.random.default_rng(0)
    for _ in range(25):
        program = small_program(rng)
        hostile, plain = (
            Elements(export_html(kind)) for kind in (with_hostile_texts(program, rng), with_plain_texts(program))
        )
        assert hostile.tags == plain.tags
        assert len(hostile.scripts) == len(plain.scripts)
        assert hostile.scripts[2:] == plain.scripts[2:]
        assert hostile.scripts[1].isascii()


def test_a_program_of_an_unknown_environment_has_a_page_without_episodes():
    program = build_program(1, ["gru", "affine"], "box", True)
    data = json.loads(Elements(export_html(program)).scripts[0])
    assert (data["world"], data["episodes"]) == (None, [])
    assert len(data["importance"]) == 2


def test_a_program_that_does_not_fit_its_environment_has_a_page_without_episodes():
    program = hanoi_program()
    data = json.loads(Elements(export_html(replace(program, metadata={"env": "Stacking-v0"}))).scripts[0])
    assert data["episodes"] == []


def test_episodes_with_the_variation_in_sight_are_recorded_and_not_stepped_in_the_page():
    fitting = program_for(gym.make("Hanoi-v0", context="observed"))
    data, episodes = frames_of(export_html(fitting, env_kwargs={"context": "observed"}))
    assert data["world"] is None
    assert len(episodes) == len(data["episodes"]) == 8
    assert all(frame["chosen"] == frame["action"] for frames in episodes for frame in frames[:-1])


def program_for(env):
    """A random program that fits a Hanoi environment with any observation."""
    program = hanoi_program()
    n_observations = env.observation_space.shape[0]
    names = tuple(f"input {index}" for index in range(n_observations))
    rng = np.random.default_rng(0)
    weights = tuple(tuple(rng.normal(size=n_observations).tolist()) for _ in range(6))
    controller = replace(program.controllers[0], weights=weights)
    return replace(program, body=controller, n_observations=n_observations, interaction=False, input_names=names)


def test_numbers_are_packed_as_they_are():
    numbers = np.float32([[0.1, -3e-7], [1e9, 0.0]])
    script = "return Array.from(new Float32Array(Uint8Array.from(atob(data), (c) => c.charCodeAt(0)).buffer));"
    assert run_node(script, pack_numbers(numbers)) == numbers.ravel().astype(float).tolist()


def test_the_page_is_written_to_a_file(tmp_path):
    program = load_pretrained("Hanoi-v0")
    assert export_html(program, tmp_path / "hanoi.html") is None
    assert (tmp_path / "hanoi.html").read_text(encoding="utf-8") == export_html(program)
