"""Whole imitations in small: teachers, visited states, checkpoints and the command line."""

import dataclasses
import json
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from threadpoolctl import threadpool_info, threadpool_limits

from progpolicy_envs.panda import PandaStackEnv
from sb3_progpolicy import compare_with_teacher, evaluate_program, imitate, load_pretrained
from sb3_progpolicy.cli import run
from sb3_progpolicy.imitation import algorithm, make_teacher, rounds
from sb3_progpolicy.imitation.augmentation import begun_towers, taller_towers
from sb3_progpolicy.imitation.decision_list import DecisionList
from sb3_progpolicy.imitation.learner import Settings
from sb3_progpolicy.imitation.rollouts import Pool, play
from sb3_progpolicy.imitation.stalls import Patience
from sb3_progpolicy.imitation.tasks import training_variations
from sb3_progpolicy.imitation.visits import STALL_WEIGHT, Collector, Witness
from sb3_progpolicy.interaction import VecInteractionHistory
from sb3_progpolicy.programs import Program, ProgramRunner

SMALL = {"n_timesteps": 2000, "n_envs": 8, "n_episodes": 8, "max_conditions": 1}


def balance(observations):
    """A controller of CartPole that is one affine rule."""
    return (observations @ [0.1, 0.5, 1.0, 1.0] > 0).astype(np.int64)


@pytest.fixture(scope="module", autouse=True)
def few_gradient_steps():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(algorithm, "Settings", partial(Settings, round_steps=20, final_steps=100))
        yield


@pytest.fixture(scope="module")
def balanced(few_gradient_steps):
    return imitate(balance, "CartPole-v1", seed=1, **SMALL)


def test_program_balances_as_its_teacher_does(balanced):
    compared = compare_with_teacher(balance, balanced, "CartPole-v1", n_episodes=8)
    assert compared.teacher["return"] == 500
    assert compared.program["return"] >= 490
    assert compared.distance < 0.3


def test_program_says_how_it_was_learned(balanced, tmp_path):
    assert balanced.metadata["learned_by"] == "imitation"
    assert balanced.metadata["teacher"] == "balance"
    assert balanced.metadata["env"] == "CartPole-v1"
    balanced.save(tmp_path / "program.json")
    assert Program.load(tmp_path / "program.json") == balanced


def test_show_says_how_a_program_was_learned(balanced, tmp_path, capsys):
    balanced.save(tmp_path / "program.json")
    for name, learned in ((str(tmp_path / "program.json"), "imitation"), ("Hanoi-v0", "reinforcement")):
        assert run(["show", name]) == 0
        assert f"Learned by {learned}." in capsys.readouterr().err
    forged = dataclasses.replace(balanced, metadata={"learned_by": "a genius"})
    assert forged.learned_by == "unknown"


def test_taller_towers_are_labelled_by_the_scripted_controller():
    names = PandaStackEnv.observation_names
    place = {name: index for index, name in enumerate(names)}
    low = np.zeros((400, len(names)), np.float32)
    low[:, [place["distance"], place["target_dx"]]] = 0.2
    raised = taller_towers(names)(low, np.random.default_rng(0))
    assert (raised[:, place["target_z"]] > 0.03).all()
    moved = {names[column] for column in np.flatnonzero((raised != low).any(axis=0))}
    assert moved == {"gripper_z", "target_z", "target_dz", "object_dz"}
    for way, thing in (("target_dz", "target_z"), ("object_dz", "object_z")):
        difference = raised[:, place[thing]] - raised[:, place["gripper_z"]]
        np.testing.assert_allclose(raised[:, place[way]], difference, atol=1e-6)
    low[:, place["distance"]] = 0.0  # a block in its place goes with the tower
    raised = taller_towers(names)(low, np.random.default_rng(0))
    assert (raised[:, place["object_z"]] == raised[:, place["target_z"]]).all()
    low[:, place["target_dx"]] = 0.0  # near the tower there are more of them, and the hand over it goes with it
    raised = taller_towers(names)(low, np.random.default_rng(0))
    assert len(raised) == 3 * len(low)
    assert {names[column] for column in np.flatnonzero(raised.any(axis=0))} == {"gripper_z", "target_z", "object_z"}
    with pytest.raises(ValueError, match="has no gripper_z"):
        imitate("planner", "Stacking-v0", augment="taller_towers")
    with pytest.raises(ValueError, match="is asked about states of an episode"):
        imitate("planner", "Stacking-v0", augment=lambda observations, rng: observations, **SMALL)


def test_begun_towers_are_finished_and_the_blocks_of_the_variation_are_not():
    with Pool("PandaStack-v0", 12, begin=begun_towers) as pool:
        done = []
        for row in range(12):
            pool.reset(row, 300 + row, {"n_objects": 2})
            finished = pool.envs[row].unwrapped.task.finished
            assert finished[-2:] == [False, False]
            assert all(finished[:-2])
            done.append(len(finished) - 2)
        assert {0, 5} <= set(done) <= {0, 1, 2, 3, 4, 5}
        heights = pool.observations[:, list(PandaStackEnv.observation_names).index("target_z")]
        np.testing.assert_allclose(heights, 0.02 + 0.04 * np.array(done), atol=1e-6)
        first = pool.observations[0].copy()
        pool.reset(0, 300, {"n_objects": 2})
        np.testing.assert_array_equal(pool.observations[0], first)
        hands = pool.observations[:, list(PandaStackEnv.observation_names).index("gripper_z")]
        above = hands > 0.04 * np.array(done) + 0.02
        assert above[np.array(done) == 5].all()
        pool.reset(0, 101, {"n_objects": 1})
        with pytest.raises(ValueError, match="n_done=7 is not accepted"):
            pool.envs[0].unwrapped.begin_tower(7)
    with pytest.raises(ValueError, match="only PandaStack has towers"):
        imitate("planner", "PandaPush-v0", augment="begun_towers", **SMALL)
    with pytest.raises(ValueError, match="begun_towers"):
        imitate("planner", "PandaPush-v0", augment="begun_tower", **SMALL)


def test_same_seed_gives_the_same_program(balanced):
    assert imitate(balance, "CartPole-v1", seed=1, **SMALL) == balanced


def test_box_actions_are_in_the_unit_of_the_environment():
    def swing(observations):
        return np.clip(-3.0 * observations[:, 1:2] - 0.5 * observations[:, 2:], -2, 2)

    program = imitate(swing, "Pendulum-v1", **{**SMALL, "max_conditions": 0})
    observations = np.random.default_rng(0).uniform(-1, 1, size=(50, 3))
    acted = ProgramRunner(program, 50).act(observations)
    np.testing.assert_allclose(acted, swing(observations), atol=0.15)


def test_interrupted_imitation_goes_on_as_if_nothing_had_happened(balanced, tmp_path):
    state, seen = tmp_path / "state.npz", []

    def interrupt(so_far):
        seen.append(so_far.round)
        if so_far.round in (2, 6, 11):
            raise KeyboardInterrupt

    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            imitate(balance, "CartPole-v1", seed=1, callback=interrupt, checkpoint=state, **SMALL)
    program = imitate(balance, "CartPole-v1", seed=1, callback=interrupt, checkpoint=state, **SMALL)
    assert seen == [*range(1, 13)]
    assert program == balanced
    assert program.metadata["labelled_states"] == 13 * (2000 // 13)
    with pytest.raises(ValueError, match="remove it to begin anew"):
        imitate(balance, "CartPole-v1", seed=9, checkpoint=state, **SMALL)
    more = {**SMALL, "score_tolerance": 0.1, "max_conditions": 2}
    with pytest.raises(ValueError, match="another max_branches, score_tolerance;"):
        imitate(balance, "CartPole-v1", seed=1, checkpoint=state, **more)


def test_branches_that_hardly_ever_act_go_while_episodes_stay_as_good():
    with Pool("CartPole-v1", 8) as pool:
        run = rounds.Run(pool, balance, "CartPole-v1", None, Settings(3, 0), (), 8, (0.015, None), None)
        states = np.random.default_rng(0).normal(scale=0.1, size=(500, 4)).astype(np.float32)
        run.learner.add(states, run.codec.encode(balance(states)), np.ones(500))
        rule = np.array([[-0.1, -0.5, -1, -1, 0], [0.1, 0.5, 1, 1, 0]]) * 20
        rare = DecisionList(np.array([[0, 0, 0, 0, -1.0], [0, 0, 0, 0, 1.0]]), np.array([rule, rule, rule]))
        selection = run.selection
        selection.best = selection.score(rare), rare
        selection.drop_rare_branches()
    assert run.learner.rare_branches(rare, 0.03) == [0, 2]
    assert selection.best[1].n_branches == 1
    assert selection.result["return"] == 500


def test_planner_is_imitated_on_training_variations_only(monkeypatch):
    seen = set()
    reset = Pool.reset

    def spy(self, row, seed, variation):
        seen.add(tuple(variation.items()))
        reset(self, row, seed, variation)

    monkeypatch.setattr(Pool, "reset", spy)
    program = imitate("planner", "Stacking-v0", **{**SMALL, "max_conditions": 2})
    assert seen == {(("n_plates", n),) for n in (1, 2, 3, 4)}
    assert program.metadata["teacher"] == "planner"
    assert program.metadata["trained_on"] == [{"n_plates": n} for n in (1, 2, 3, 4)]


def test_imitation_takes_one_thread_of_blas_and_leaves_the_others_as_they_were():
    pytest.importorskip("scipy.linalg")  # has a BLAS of its own, which is loaded then

    def threads():
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    seen = []

    def stop(progress):
        seen.append(threads())
        raise KeyboardInterrupt

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with pytest.raises(KeyboardInterrupt):
            imitate(balance, "CartPole-v1", **SMALL, callback=stop)
        assert threads() == before
    assert seen == [[1] * len(before)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"teacher": "expert"}, "'expert' is not accepted; it is 'planner'"),
        ({"teacher": 3}, "teacher=3 is not accepted"),
        ({"teacher": "planner"}, "CartPole-v1 has no planner"),
        ({"cell": "lstm"}, "cell='lstm' is not accepted"),
        ({"n_timesteps": 5}, "n_timesteps=5"),
        ({"score_tolerance": -0.1}, "score_tolerance=-0.1 and"),
        ({"plain_tolerance": float("nan")}, "plain_tolerance=nan are not accepted"),
        ({"tasks": []}, "at least one variation"),
        ({"env_id": "CartPol-v1"}, "unknown environment"),
        ({"teacher": lambda observations: np.zeros(1)}, "for 24 observations"),
    ],
)
def test_what_is_not_accepted_is_said(arguments, message):
    with pytest.raises(ValueError, match=message):
        imitate(**{"teacher": balance, "env_id": "CartPole-v1", **arguments})


class Buttons(gym.Env):
    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.MultiDiscrete([2, 2])

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), 0.0, False, False, {}


def test_several_discrete_actions_at_once_are_refused():
    gym.register("Buttons-v0", entry_point=Buttons, max_episode_steps=5)
    try:
        with pytest.raises(ValueError, match="multi_discrete actions are not accepted"):
            imitate(lambda observations: np.zeros((len(observations), 2)), "Buttons-v0")
    finally:
        gym.registry.pop("Buttons-v0")


def steps_of(model, env_id, n_envs=3, n_steps=4):
    """The actions of a model in an environment of its own, as SB3 runs it."""
    venv = model.get_env()
    venv.seed(7)
    observations, state, dones, actions = venv.reset(), None, np.zeros(n_envs, bool), []
    for _ in range(n_steps):
        action, state = model.predict(observations, state, dones, deterministic=True)
        observations, _, dones, _ = venv.step(action)
        actions.append(action)
    return np.array(actions)


@pytest.mark.parametrize("kind", ["normalised", "recurrent", "history"])
def test_model_sees_what_it_saw_in_training(kind):
    venv = DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 3)
    if kind != "recurrent":
        venv = VecNormalize(venv, norm_reward=False)
    if kind == "history":
        venv = VecInteractionHistory(venv)
    model_class, policy = (RecurrentPPO, "MlpLstmPolicy") if kind == "recurrent" else (PPO, "MlpPolicy")
    model = model_class(policy, venv, seed=0, n_steps=32, batch_size=32).learn(96)
    if kind != "recurrent":
        model.get_vec_normalize_env().training = False
    expected = steps_of(model, "Pendulum-v1")
    pool = Pool("Pendulum-v1", 3)
    teacher = make_teacher(model, pool.envs[0])
    for row in range(3):
        pool.reset(row, 7 + row, {})
    for wanted in expected:
        actions = teacher.label(pool.situation())
        np.testing.assert_allclose(actions, wanted, atol=1e-5)
        pool.actions = actions
        for row in range(3):
            pool.step(row, actions[row])


def test_program_is_a_teacher_too():
    pool = Pool("Hanoi-v0", 2)
    episodes = play(pool, [{"n_discs": 2}], 2, 0, None, make_teacher(load_pretrained("Hanoi-v0"), pool.envs[0]))
    assert episodes.successes.all()
    assert episodes.steps.tolist() == [3, 3]


def test_state_in_which_the_student_stands_still_weighs_more_and_the_teacher_takes_over():
    pool = Pool("Stacking-v0", 4)
    variations, ranks = training_variations("Stacking-v0", None)
    collector = Collector(pool, make_teacher("planner", pool.envs[0]), variations, ranks, seed=0)
    collector.begin()

    def stubborn(observations):
        return np.zeros(len(observations), dtype=np.int64)

    visits = collector.collect(150, stubborn, share=0.0)
    assert visits.n_stalls > 0
    assert set(visits.weights.tolist()) == {1.0, STALL_WEIGHT}
    assert any(success for success, _ in visits.ended)


def test_all_first_actions_of_shortest_solutions_are_labels():
    pool = Pool("Stacking-v0", 4)
    collector = Collector(
        pool, make_teacher("planner", pool.envs[0]), *training_variations("Stacking-v0", None), seed=0
    )
    collector.begin()
    visits = collector.collect(20, None, share=1.0)
    assert visits.good.shape == (80, 5)
    assert visits.good[np.arange(80), visits.actions].all()
    assert (visits.good.sum(axis=1) == 2).any()


def test_program_may_read_its_previous_action():
    program = imitate("planner", "Hanoi-v0", tasks=[{"n_discs": 1}], interaction=True, **SMALL)
    assert program.interaction
    assert program.input_names[-2:] == ("previous reward", "previous done")
    (row,) = evaluate_program(program, "Hanoi-v0", [{"n_discs": 1}], n_episodes=5)
    assert row.success_rate == 1
    compared = compare_with_teacher("planner", program, "Hanoi-v0", [{"n_discs": 1}], n_episodes=4)
    assert compared.program["success"] == 1


def test_each_size_is_drawn_twice_as_often_as_the_one_before():
    variations, ranks = training_variations("HikingEgo-v0", None)
    collector = Collector(Pool("HikingEgo-v0", 1), None, variations, ranks, seed=0)
    shares = [sum(collector.chances[np.array(ranks) == rank]) for rank in range(4)]
    np.testing.assert_allclose(shares, np.array([1, 2, 4, 8]) / 15)


def test_command_line_distills_a_planner(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(rounds, "N_ROUNDS", 3)
    output = tmp_path / "program.json"
    arguments = ["distill", "--from", "planner", "--env", "Stacking-v0", "--set", "n_plates=1", "-n", "1000"]
    assert run([*arguments, "--max-conditions", "2", "--episodes", "4", "-o", str(output)]) == 0
    printed = capsys.readouterr().out
    assert "Program for Stacking-v0" in printed
    assert "of its actions are the teacher's" in printed
    assert [path.name for path in tmp_path.iterdir()] == ["program.json"]
    again = ["distill", "--from", str(output), "--set", "n_plates=1", "-n", "1000", "--max-conditions", "1"]
    assert run([*again, "--episodes", "4", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == {"env", "n_conditions", "teacher", "program", "distance"}


def test_command_line_says_what_is_missing(capsys):
    assert run(["distill", "--from", "planner"]) == 2
    assert "needs --env" in capsys.readouterr().err


def test_what_loses_an_episode_weighs_more():
    pool = Pool("PandaPush-v0", 2)
    collector = Collector(pool, make_teacher("planner", pool.envs[0]), [{"n_objects": 1}], [0], seed=0)
    collector.begin()

    def away(observations):
        """Push the block off the table."""
        toward = 20 * observations[:, 7:10]
        near = np.abs(observations[:, 7:9]).max(axis=1) < 0.02
        return np.column_stack([np.where(near, -1.0, toward[:, 0]), toward[:, 1:], -np.ones(len(near))]).clip(-1, 1)

    collector.collect(2, None, share=1.0)
    visits = collector.collect(150, away, share=0.0)
    assert any(not success and steps < collector.limit for success, steps in visits.ended)
    assert (visits.weights > 1).sum() > visits.n_stalls


def test_states_of_judged_episodes_are_labelled_half_of_them_where_the_candidate_does_otherwise():
    with Pool("PandaPush-v0", 3) as pool:
        teacher, space = make_teacher("planner", pool.envs[0]), pool.envs[0].action_space
        turn, seen = iter(range(10**6)), []

        def sometimes_wrong(observations):
            labels = teacher.label_alone(observations, pool.envs[0])
            seen.append((observations.copy(), labels, next(turn) % 5 == 0))
            return -labels if seen[-1][2] else labels

        witness = Witness(space)
        play(pool, [{"n_objects": 1}], 3, 7, sometimes_wrong, teacher, watcher=witness)
        visits = witness.visits(20, np.random.default_rng(0))
        assert len(visits.inputs) == len(visits.actions) == len(visits.weights) == 20
        assert (visits.weights == 1).all()  # no episode was lost
        labels = {row.tobytes(): (label, wrong) for step in seen for row, label, wrong in _rows(*step)}
        for row, action in zip(visits.inputs, visits.actions, strict=True):
            np.testing.assert_allclose(action, labels[row.tobytes()][0])
        assert sum(labels[row.tobytes()][1] for row in visits.inputs) == 10

        def never_closes(observations):
            return np.zeros((len(observations), 4), dtype=np.float32)

        patience = Patience(3, 12)
        play(pool, [{"n_objects": 1}], 3, 70, never_closes, teacher, patience=patience, watcher=witness)
        visits = witness.visits(1000, np.random.default_rng(0))
        assert 3 * 10 <= len(visits.inputs) <= 3 * 12
        assert (visits.weights == STALL_WEIGHT).any()
        assert not (set(labels) & {row.tobytes() for row in visits.inputs[visits.weights > 1]})


def _rows(observations, labels, wrong):
    return [(row, label, wrong) for row, label in zip(observations, labels, strict=True)]
