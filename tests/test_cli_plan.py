"""``progpolicy plan``: the planner's actions, in words and as JSON, from drawn and from given starts."""

import json
from importlib.util import find_spec

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS
from sb3_progpolicy.cli import run
from sb3_progpolicy.cli.parsing import parse_variations

needs_pybullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="pybullet is not installed")


@pytest.fixture
def plan(capsys):
    def planned(*arguments):
        code = run(["plan", *arguments])
        return code, *capsys.readouterr()

    return planned


def test_the_table_says_each_step_in_words(plan):
    code, out, err = plan("Hanoi-v0", "--set", "n_discs=2")
    assert (code, err) == (0, "")
    assert out == (
        "step  action\n   1  move 0->1\n   2  move 0->2\n   3  move 1->2\nGoal reached in 3 steps.\n"
    )  # fmt: skip


@pytest.mark.parametrize(
    "env_id",
    [pytest.param(domain.id, marks=needs_pybullet if domain.simulation else ()) for domain in DOMAINS.values()],
)
def test_the_actions_in_the_json_object_solve_every_domain(plan, env_id):
    code, out, err = plan(env_id, "--set", f"{DOMAINS[env_id].size}=2", "--seed", "5", "--json")
    assert (code, err) == (0, "")
    planned = json.loads(out)
    assert list(planned) == ["env", "options", "seed", "actions", "steps", "is_success"]
    env = gym.make(env_id)
    _, info = env.reset(seed=planned["seed"], options=planned["options"])
    assert planned["steps"] == len(planned["actions"]) == info.get("optimal_steps", planned["steps"])
    for action in planned["actions"]:
        assert not info["is_success"]
        action = np.array(action, np.float32) if isinstance(action, list) else action
        *_, info = env.step(action)
    env.close()
    assert info["is_success"] is planned["is_success"] is True
    assert planned["env"] == env_id


def test_a_start_is_given_as_a_list_in_brackets(plan):
    _, out, _ = plan("Stacking-v0", "--set", "plates=[[0,0],[3, 4]]", "gripper=[2,2]", "n_plates=2", "--json")
    planned = json.loads(out)
    assert planned["options"] == {"plates": [[0, 0], [3, 4]], "gripper": [2, 2], "n_plates": 2}
    env = gym.make("Stacking-v0")
    assert env.reset(options=planned["options"])[1]["optimal_steps"] == planned["steps"]


def test_brackets_keep_a_list_together_and_other_commas_give_variations():
    assert parse_variations(["discs=[1,0]", "n=1,2"]) == [{"discs": [1, 0], "n": 1}, {"discs": [1, 0], "n": 2}]
    assert parse_variations(["discs=[0,1],[1,0]"]) == [{"discs": [0, 1]}, {"discs": [1, 0]}]


def test_where_nothing_is_left_to_do_there_is_no_plan(plan):
    code, out, err = plan("Hanoi-v0", "--set", "n_discs=1", "discs=[2]")
    assert (code, out) == (2, "")
    assert "nothing is left to be done there" in err


@needs_pybullet
def test_continuous_actions_stand_below_their_names(plan):
    _, out, _ = plan("PandaReach-v0", "--set", "n_targets=1")
    heading, first, *_, last = out.splitlines()
    assert heading.split() == ["step", "move_x", "move_y", "move_z", "open"]
    assert len(first.split()) == 5
    assert len(first) == len(heading)
    assert all(-1 <= float(part) <= 1 for part in first.split()[1:])
    assert last.startswith("Goal reached in ")


def test_equal_seeds_give_equal_plans(plan):
    plans = [plan("Stacking-v0", "--seed", seed)[1] for seed in ("1", "1", "2")]
    assert plans[0] == plans[1] != plans[2]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["CartPole-v1"], "it has no plan(). These have: Hanoi-v0"),
        (["Hanoy-v0"], "Hanoi-v0"),
        (["Hanoi-v0", "--set", "n_discs=1,2"], "2 variations"),
        (["Hanoi-v0", "--set", "n_discs=77"], "n_discs=77"),
        (["Hanoi-v0", "--set", "discs=[1,"], "not YAML"),
    ],
)
def test_what_has_no_plan_is_refused(plan, arguments, said):
    code, out, err = plan(*arguments)
    assert (code, out) == (2, "")
    assert said in err
