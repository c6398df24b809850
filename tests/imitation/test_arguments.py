"""What ``imitate`` is given: arguments and teachers that are not accepted, and files of other imitations."""

import shutil
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_progpolicy import compare_with_teacher, imitate, load_pretrained
from sb3_progpolicy.cli import run
from sb3_progpolicy.imitation import algorithm, rounds
from sb3_progpolicy.imitation.learner import Settings
from sb3_progpolicy.imitation.rollouts import VALIDATION_SEED, Pool
from sb3_progpolicy.imitation.teachers import checked_labels, make_teacher
from sb3_progpolicy.imitation.visits import Collector
from sb3_progpolicy.programs import Program
from sb3_progpolicy.spaces import ActionSpec

SMALL = {"n_timesteps": 1000, "n_envs": 4, "n_episodes": 4, "max_conditions": 0}


@pytest.fixture(scope="module", autouse=True)
def few_gradient_steps():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(algorithm, "Settings", partial(Settings, round_steps=5, final_steps=10))
        for name, number in {"N_ROUNDS": 3, "N_PLAIN_ROUNDS": 3, "N_SPARSE_ROUNDS": 1}.items():
            patch.setattr(rounds, name, number)
        yield


def balance(observations):
    return (observations @ [0.1, 0.5, 1.0, 1.0] > 0).astype(np.int64)


def straight(observations):
    """To the middle, in steps of a tenth at most."""
    return np.clip(-10 * observations, -1, 1)


def changed(observations, rng):
    return observations


class Forwards(gym.Env):
    """Moves to the middle of a square by actions of the space that it is given."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, space):
        self.action_space = space

    def reset(self, *, seed=None, options=None):
        self.place = np.random.default_rng(seed).uniform(-1, 1, 2).astype(np.float32)
        return self.place, {}

    def step(self, action):
        assert action in self.action_space
        self.place = (self.place + 0.1 * action[:2].ravel()[:2]).clip(-1, 1).astype(np.float32)
        reached = bool(np.abs(self.place).max() < 0.05)
        return self.place, -1.0, reached, False, {"is_success": reached}


@pytest.fixture(scope="module")
def forwards():
    gym.register("Forwards-v0", entry_point=Forwards, max_episode_steps=30)
    yield
    gym.registry.pop("Forwards-v0")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env_id": gym.make("CartPole-v1")}, "it is the id of an environment, such as 'CartPole-v1'"),
        ({"tasks": {"n_discs": 3}}, "it is a sequence of at least one variation"),
        ({"tasks": ["n_discs"]}, "it is a sequence of at least one variation"),
        ({"tasks": [{"lenght": 1}]}, "the reset option lenght has no effect; CartPole-v1 does not read it"),
        ({"n_timesteps": 6e3}, r"n_timesteps=6000\.0 is not accepted; it is a whole number of at least"),
        ({"n_envs": 0}, "n_envs=0 is not accepted; it is a whole number of at least 1"),
        ({"max_conditions": 1.5}, r"max_conditions=1\.5"),
        ({"max_conditions": -1}, "max_conditions=-1"),
        ({"n_episodes": 2.5}, r"n_episodes=2\.5"),
        ({"n_episodes": 0}, "n_episodes=0"),
        ({"seed": -1}, "seed=-1 is not accepted"),
        ({"seed": None}, "seed=None is not accepted"),
        ({"seed": True}, "seed=True is not accepted"),
        ({"ignore": "left"}, "ignore='left' is not accepted; it is a sequence of names"),
        ({"ignore": ("pole_velocity",)}, "there is no input pole_velocity; the inputs are"),
        ({"ignore": tuple(f"x{index}" for index in range(4))}, "it leaves no input"),
        ({"plain_tolerance": 0.1}, r"plain_tolerance=0\.1 is not accepted for discrete actions"),
        ({"plain_tolerance": 0.1, "cell": "gru", "max_conditions": 1}, "there are no plain ones"),
        ({"augment": 5}, "augment=5 is not accepted; it is a name or a function"),
        ({"augment": changed, "interaction": True}, "an observation that was changed has no previous action"),
        ({"checkpoint": "no/such/folder/state.npz"}, "there is no folder no/such/folder"),
        ({"env_kwargs": {"lenght": 1}}, "lenght"),
    ],
)
def test_argument_that_is_not_accepted_is_named(arguments, message):
    names = {"ignore": "x", **arguments}
    if arguments.get("ignore", ("",))[0] == "x0":
        with Pool("CartPole-v1", 1) as pool:
            names["ignore"] = rounds.names_of(pool.envs[0], 2, False)[0]
    else:
        names = arguments
    with pytest.raises((ValueError, TypeError), match=message):
        imitate(**{"teacher": balance, "env_id": "CartPole-v1", **SMALL, **names})


def test_names_and_numbers_of_episodes_of_others_are_checked(tmp_path):
    program = load_pretrained("Hanoi-v0")
    with pytest.raises(ValueError, match="n_episodes=0 is not accepted"):
        compare_with_teacher("planner", program, "Hanoi-v0", n_episodes=0)
    with pytest.raises(ValueError, match="tasks='n_discs' is not accepted"):
        compare_with_teacher("planner", program, "Hanoi-v0", "n_discs")
    with pytest.raises(ValueError, match="unknown pretrained program 'None'"):
        load_pretrained(None)


NAN = np.array([[0.0], [np.nan], [0.0], [0.0]])


@pytest.mark.parametrize(
    ("env_id", "answer", "accepted"),
    [
        ("CartPole-v1", 1, "arrays of 4 actions, each a whole number from 0 to 1"),
        ("CartPole-v1", None, "whole number"),
        ("CartPole-v1", np.zeros(3, np.int64), "whole number"),
        ("CartPole-v1", np.zeros((4, 2), np.int64), "whole number"),
        ("CartPole-v1", np.zeros(4), "whole number"),
        ("CartPole-v1", np.array([0, 1, 2, 0]), "whole number"),
        ("CartPole-v1", np.array([0, 1, -1, 0]), "whole number"),
        ("Pendulum-v1", np.zeros((4, 2)), "each 1 finite numbers"),
        ("Pendulum-v1", NAN, "finite"),
        ("Pendulum-v1", np.full(4, np.inf), "finite"),
        ("Pendulum-v1", np.array([["a"]] * 4), "finite"),
    ],
)
def test_answer_of_a_teacher_that_is_no_action_is_shown(env_id, answer, accepted):
    with pytest.raises(ValueError, match=f"the teacher <lambda> returned .* for 4 observations; .*{accepted}"):
        imitate(lambda observations: answer, env_id, **SMALL)


@pytest.mark.parametrize(
    ("spec", "answer", "expected"),
    [
        (ActionSpec("discrete", (2,)), np.array([True, False]), [1, 0]),
        (ActionSpec("discrete", (3,), start=-1), np.array([[-1], [1]], np.int8), [-1, 1]),
        (ActionSpec("discrete", (2,)), [0, 1], [0, 1]),
        (ActionSpec("box", (1,), (-2.0,), (2.0,)), np.array([0.5, 3.0]), [[0.5], [3.0]]),
        (ActionSpec("box", (1,), (-2.0,), (2.0,)), np.array([1, 2]), [[1.0], [2.0]]),
        (
            ActionSpec("box", (4,), (0.0,) * 4, (2.0,) * 4),
            np.arange(8.0).reshape(2, 2, 2),
            np.arange(8).reshape(2, 4),
        ),
    ],
)
def test_answers_that_are_actions_in_another_form_are_taken(spec, answer, expected):
    taken = checked_labels(answer, spec, 2, "teacher")
    np.testing.assert_array_equal(taken, expected)
    assert taken.dtype.kind == ("f" if spec.kind == "box" else "i")


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(0, np.inf, (1,), np.float32),
        spaces.Box(np.array([0, 1], np.float32), np.array([1, 1], np.float32)),
    ],
)
def test_box_without_bounds_or_width_is_refused_at_once(forwards, space):
    asked = []
    with pytest.raises(ValueError, match="each number has finite bounds, the lower one below the upper one"):
        imitate(asked.append, "Forwards-v0", env_kwargs={"space": space}, **SMALL)
    assert not asked


def test_box_of_two_dimensions_is_imitated(forwards):
    space = spaces.Box(-1, 1, (2, 2), np.float32)

    def teacher(observations):
        return np.stack([observations, -observations], axis=2)

    program = imitate(teacher, "Forwards-v0", env_kwargs={"space": space}, **SMALL)
    compared = compare_with_teacher(teacher, program, "Forwards-v0", env_kwargs={"space": space}, n_episodes=4)
    assert compared.distance < 0.05


def test_checkpoint_of_another_teacher_or_environment_is_refused(tmp_path):
    state = tmp_path / "state.npz"

    def stop(so_far):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        imitate(balance, "CartPole-v1", callback=stop, checkpoint=str(state), **SMALL)
    opposite = {"balance": lambda observations: 1 - balance(observations)}["balance"]
    opposite.__name__ = "balance"
    with pytest.raises(ValueError, match="another behaviour of the teacher;"):
        imitate(opposite, "CartPole-v1", checkpoint=state, **SMALL)
    with pytest.raises(ValueError, match="another env_kwargs;"):
        imitate(balance, "CartPole-v1", checkpoint=state, env_kwargs={"sutton_barto_reward": True}, **SMALL)


@pytest.mark.parametrize(("teacher", "env_id"), [("planner", "Hanoi-v0"), (straight, "Forwards-v0")])
def test_imitation_interrupted_after_each_round_ends_as_one_that_is_not(forwards, teacher, env_id, tmp_path):
    seen, states = {}, {}

    def keep(so_far):
        seen[so_far.round] = so_far
        states[so_far.round] = shutil.copy(tmp_path / "whole.npz", tmp_path / f"{so_far.round}.npz")

    space = spaces.Box(-1, 1, (2,), np.float32)
    small = {**SMALL, "n_timesteps": 400, "seed": 3, "env_kwargs": {"space": space} if teacher is straight else None}
    whole = imitate(teacher, env_id, callback=keep, checkpoint=tmp_path / "whole.npz", **small)

    def stop(so_far):
        assert so_far == seen[so_far.round]
        with np.load(state) as own, np.load(states[so_far.round]) as other:
            assert own.files == other.files
            for name in own.files:
                np.testing.assert_array_equal(own[name], other[name])
        raise KeyboardInterrupt

    state = tmp_path / "state.npz"
    for _ in seen:
        with pytest.raises(KeyboardInterrupt):
            imitate(teacher, env_id, callback=stop, checkpoint=state, **small)
    assert imitate(teacher, env_id, callback=stop, checkpoint=state, **small) == whole


def test_episodes_of_no_seed_are_those_of_the_validations():
    with Pool("CartPole-v1", 1) as pool:
        teacher = make_teacher(balance, pool.envs[0])
        first = [Collector(pool, teacher, [{}], [0], seed).next_seed for seed in (0, 1, 498, 499, 500)]
    assert first == [100_000, 200_000, 49_900_000, 50_100_000, 50_200_000]
    assert VALIDATION_SEED == 50_000_000


def test_program_that_was_there_stays_until_all_is_done(tmp_path, capsys, monkeypatch):
    output = tmp_path / "stack.json"
    load_pretrained("Hanoi-v0").save(output)
    before = output.read_bytes()
    after_round, n_rounds = rounds.Run._progress, []

    def interrupt(self, number, total):
        n_rounds.append(number)
        if len(n_rounds) == 3:
            raise KeyboardInterrupt
        return after_round(self, number, total)

    monkeypatch.setattr(rounds.Run, "_progress", interrupt)
    arguments = ["distill", "--from", "planner", "--env", "Stacking-v0", "--set", "n_plates=1", "-n", "1000"]
    arguments += ["--max-conditions", "0", "-o", str(output)]
    assert run(arguments) == 130
    assert output.read_bytes() == before
    assert Program.load(tmp_path / "stack.part.json").metadata["env"] == "Stacking-v0"
    assert run(arguments) == 0
    assert n_rounds[3] == 4  # goes on
    assert Program.load(output).metadata["env"] == "Stacking-v0"
    assert {path.name for path in tmp_path.iterdir()} == {"stack.json"}
