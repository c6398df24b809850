"""Plain lists: the pieces of a list that is known, found again and put in order."""

import dataclasses
import shutil

import numpy as np
import pytest

from sb3_progpolicy.analysis.rules import count_numbers
from sb3_progpolicy.imitation import imitate, rounds
from sb3_progpolicy.imitation import judge as judge_module
from sb3_progpolicy.imitation.actions import ActionCodec
from sb3_progpolicy.imitation.candidates import Plain as PlainList
from sb3_progpolicy.imitation.conditions import fit_priced_condition, refit_condition
from sb3_progpolicy.imitation.decision_list import Data, DecisionList, rest_losses
from sb3_progpolicy.imitation.judge import Judge
from sb3_progpolicy.imitation.learner import Learner, Settings, _drawn
from sb3_progpolicy.imitation.losses import BoxLoss
from sb3_progpolicy.imitation.ordering import Order, Ordering
from sb3_progpolicy.imitation.pieces import PieceFinder, PieceLoss
from sb3_progpolicy.imitation.rollouts import Episodes, Pool, play
from sb3_progpolicy.imitation.rounds import N_ROUNDS, Run
from sb3_progpolicy.imitation.selection import Selection
from sb3_progpolicy.imitation.tasks import names_of, validation_variations
from sb3_progpolicy.imitation.teachers import make_teacher
from sb3_progpolicy.spaces import ActionSpec

ALL, N_INPUTS = np.array([True, True, True]), 8
PIECES = np.zeros((3, 3, N_INPUTS + 1))
PIECES[0, 0, 0], PIECES[0, 1, 1], PIECES[0, 2, -1] = 0.7, 0.7, 0.3  # to a place, the third number constant
PIECES[1, 0, -1], PIECES[1, 1, -1], PIECES[1, 2, 2] = 0.0, 0.5, -1.5
PIECES[2, 0, 3], PIECES[2, 1, 4], PIECES[2, 2, -1] = -1.0, 0.8, -0.2
CONDITIONS = np.zeros((2, N_INPUTS + 1))
CONDITIONS[0, 5], CONDITIONS[0, -1] = 1.0, -0.4
CONDITIONS[1, 6], CONDITIONS[1, 7] = 1.0, -1.0
KNOWN = DecisionList(CONDITIONS, PIECES)


def shortened(outputs, columns=(0, 1)):
    """Shorten a vector so that it keeps its direction, and clip the rest."""
    fitted, vector = outputs.copy(), outputs[:, list(columns)]
    fitted[:, list(columns)] = vector / np.maximum(np.abs(vector).max(axis=1, keepdims=True), 1.0)
    return np.clip(fitted, -1, 1)


def labelled(n=4000, seed=0):
    rng = np.random.default_rng(seed)
    inputs = np.column_stack([rng.normal(size=(n, N_INPUTS)), np.ones(n)])
    return Data(inputs, shortened(KNOWN.outputs(inputs)), np.ones(n))


def test_loss_of_pieces_is_that_of_what_the_teacher_shortens():
    data, loss = labelled(), PieceLoss(ALL, (0, 1))
    acting = KNOWN.branches(data.inputs)
    matrix = loss.matrix(data, PIECES)
    np.testing.assert_allclose(matrix[np.arange(len(data)), acting], 0, atol=1e-12)
    clipped = BoxLoss(ALL).matrix(data, PIECES)[np.arange(len(data)), acting]
    assert clipped.max() > 0.1  # clipping each number alone turns the vector
    alone = Data(data.inputs, np.clip(KNOWN.outputs(data.inputs), -1, 1), data.weights)
    np.testing.assert_allclose(PieceLoss(ALL).matrix(alone, PIECES)[np.arange(len(data)), acting], 0, atol=1e-12)


def test_labels_are_lengthened_to_what_a_piece_gives():
    data = labelled().take(KNOWN.branches(labelled().inputs) == 0)
    longer = PieceLoss(ALL, (0, 1)).lengthened(data, PIECES[0])
    np.testing.assert_allclose(longer.targets[:, :2], (data.inputs @ PIECES[0].T)[:, :2], atol=1e-9)
    np.testing.assert_array_equal(longer.targets[:, 2], data.targets[:, 2])
    assert longer.weights.min() < 0.2 < longer.weights.max() == 1.0


@pytest.fixture(scope="module")
def found():
    data = labelled()
    finder = PieceFinder(PieceLoss(ALL, (0, 1)), data, np.random.default_rng(0))
    return data, finder, finder.find()


def test_pieces_are_found_with_their_inputs_and_numbers(found):
    _, finder, pieces = found
    assert len(pieces) == 3
    assert finder.explained(pieces) > 0.98
    for known in PIECES:
        nearest = min(pieces, key=lambda piece: np.abs(piece - known).sum())
        np.testing.assert_array_equal(nearest[:, :-1] != 0, known[:, :-1] != 0)
        np.testing.assert_allclose(nearest, known, atol=0.05)
    assert finder.explained(pieces[:0]) == 0.0
    assert finder.explained(finder.find(known=list(pieces))) > 0.98


def test_noise_is_not_made_of_pieces(found):
    data, _, _ = found
    rng = np.random.default_rng(0)
    noise = Data(data.inputs, rng.uniform(-1, 1, data.targets.shape), data.weights)
    finder = PieceFinder(PieceLoss(ALL), noise, rng)
    assert finder.explained(finder.find()) < 0.2


def test_order_has_the_known_conditions(found):
    data, finder, pieces = found
    ordering = Ordering(data, finder.loss.matrix(data, pieces), most=6)
    order = ordering.fit()
    assert 2 <= len(order.conditions) <= 4
    for known in CONDITIONS:
        nearest = max(order.conditions, key=lambda sums: _cosine(sums[0], known))
        assert _cosine(nearest[0], known) > 0.98
    fresh = labelled(seed=1)
    own = order.as_list(pieces)
    losses = finder.loss.matrix(fresh, own.controllers)
    assert losses[np.arange(len(fresh)), own.branches(fresh.inputs)].mean() < 0.02
    again = ordering.fit(order)
    assert ordering.cost(again) <= ordering.cost(order)
    assert len(ordering.fit(Order((), (0,))).conditions) >= 2
    assert Ordering(data, finder.loss.matrix(data, pieces), most=1).fit().conditions == ()


def _cosine(one, other):
    return one @ other / np.linalg.norm(one) / np.linalg.norm(other)


def test_order_grows_and_shrinks():
    order = Order((np.array([[1.0]]), np.array([[2.0]])), (4, 5, 6))
    assert order.insert(2, np.array([[3.0]]), 7).pieces == (4, 5, 7, 6)
    assert [[float(c[0, 0]) for c in one.conditions] for one in map(order.without, range(3))] == [[2], [1], [1]]
    assert [one.pieces for one in map(order.without, range(3))] == [(5, 6), (4, 6), (4, 5)]


def test_losses_of_the_rest_are_those_of_the_branch_that_acts():
    losses, holds = np.array([[1.0, 2, 3], [1, 2, 3], [1, 2, 3]]), np.array([[1, 1], [0, 1], [0, 0]], dtype=bool)
    np.testing.assert_array_equal(rest_losses(losses, holds), [[1, 2, 3], [2, 2, 3], [3, 3, 3]])


def test_condition_has_the_inputs_that_are_worth_their_price():
    rng = np.random.default_rng(0)
    inputs = np.column_stack([rng.normal(size=(2000, 6)), np.ones(2000)])
    gains = np.where(inputs[:, 1] + 0.1 * inputs[:, 3] > 0.2, 1.0, -1.0) / 2000
    start = np.ones(7)
    cheap, gained = fit_priced_condition(inputs, gains, start, price=1e-4)
    dear, less = fit_priced_condition(inputs, gains, start, price=0.1)
    assert np.flatnonzero(cheap[:-1]).tolist() == [1, 3]
    assert np.flatnonzero(dear[:-1]).tolist() == [1]
    assert gained == pytest.approx(gains[gains > 0].sum() - 2e-4, abs=2e-3)
    assert less < gained
    assert fit_priced_condition(inputs, -np.abs(gains), start, price=0.0) == (None, 0.0)


def test_condition_that_is_fitted_again_keeps_its_inputs():
    rng = np.random.default_rng(0)
    inputs = np.column_stack([rng.normal(size=(2000, 6)), np.ones(2000)])
    gains = np.where(inputs[:, 1] + 0.1 * inputs[:, 3] > 0.2, 1.0, -1.0) / 2000
    start = np.array([0.0, 1.0, 0.0, 0.0, 0.5, 0.0, 0.4])
    condition, gained = refit_condition(inputs, gains, start)
    assert np.flatnonzero(condition).tolist() == [1, 4, 6]
    assert abs(condition[4]) < 0.05 * condition[1]
    assert condition[6] / condition[1] == pytest.approx(-0.2, abs=0.02)
    assert gained == pytest.approx(gains[inputs @ condition >= 0].sum())
    nothing = -np.abs(gains)
    assert refit_condition(inputs, nothing, start)[1] <= 0


def test_learner_makes_a_plain_list_of_box_labels_alone():
    spec = ActionSpec("box", (3,), (-1.0,) * 3, (1.0,) * 3)
    codec = ActionCodec(spec, ("move_x", "move_y", "open"))
    learner = Learner(codec, np.ones(N_INPUTS, dtype=bool), Settings(max_branches=6, seed=0))
    data = labelled()
    learner.add(data.inputs[:, :-1].astype(np.float32), data.targets, data.weights)
    [plain] = learner.plain([], anew=False)
    assert 3 <= plain.n_branches <= 5
    onward, pruned, other = learner.plain([plain, plain], anew=True)
    assert onward.n_branches == plain.n_branches
    assert max(learner.loss_of(one) for one in (onward, pruned, other)) < 0.1
    discrete = Learner(ActionCodec(ActionSpec("discrete", (3,)), ("a", "b", "c")), np.ones(4, bool), Settings(3, 0))
    assert discrete.plain([], anew=False) == []


@pytest.mark.parametrize(("n_losing", "weight"), [(2, 60.0), (100, 0.3 / 0.7 * 9), (990, 1.0)])
def test_states_in_which_a_student_loses_have_a_share_of_the_weight_at_most(n_losing, weight):
    learner = Learner(ActionCodec(ActionSpec("box", (1,), (-1.0,), (1.0,)), ("x",)), np.ones(2, bool), Settings(2, 0))
    weights = np.ones(1000)
    weights[:n_losing] = 3.0
    learner.add(np.zeros((1000, 2), np.float32), np.zeros((1000, 1)), weights)
    found = learner._losing_weighted()
    np.testing.assert_allclose(found[:n_losing], weight)
    np.testing.assert_array_equal(found[n_losing:], 1.0)


def test_reaching_is_imitated_by_a_few_numbers_and_the_same_after_an_interruption(monkeypatch, tmp_path):
    seen, reset = set(), Pool.reset

    def spy(self, row, seed, variation):
        seen.add(tuple(variation.items()))
        reset(self, row, seed, variation)

    monkeypatch.setattr(Pool, "reset", spy)
    monkeypatch.setattr(rounds, "N_PLAIN_ROUNDS", 2)
    arguments = {"n_timesteps": 2500, "n_episodes": 6, "max_conditions": 0, "n_envs": 6}
    state, early = tmp_path / "state.npz", tmp_path / "early.npz"

    def keep(progress):
        if progress.round == N_ROUNDS + 1:
            shutil.copy(state, early)

    whole = imitate("planner", "PandaReach-v0", **arguments, callback=keep, checkpoint=state)
    assert len(whole.conditions) == 0
    assert count_numbers(whole) <= 10
    assert seen == {(("n_targets", n),) for n in (1, 2, 3, 4)}  # trained on 1 to 3; 4 are the validation's
    resumed = imitate("planner", "PandaReach-v0", **arguments, checkpoint=early)
    assert resumed.body == whole.body


@pytest.mark.parametrize("beyond", [1.0, 0.92, 0.85], ids=["as good beyond", "a little worse", "worse beyond"])
def test_plain_list_is_taken_only_if_it_is_as_good_on_validation_variations(monkeypatch, beyond):
    with Pool("PandaReach-v0", 4) as pool:
        codec = ActionCodec(pool.spec, ("move_x", "move_y", "move_z", "open"))
        judge = Judge(pool, [{"n_targets": 1}], 4, 0.015, make_teacher("planner", pool.envs[0]))
    best, worse, plain = (DecisionList(np.zeros((0, 33)), np.full((1, 4, 33), value)) for value in range(3))

    class Plain:
        raw = best

        def plain(self, known, anew):
            return [plain, worse]

    selection = Selection(Plain(), judge, validation_variations("PandaReach-v0"), codec, None, 0.05)
    selection.best, selection.reference = (1.0, best), 1.0
    scores, asked = iter([0.9, 0.8]), []
    monkeypatch.setattr(judge, "score", lambda act, needed=None, series=0, watcher=None: next(scores, 1.0))
    judge.last_result = {"success": 1.0}

    def at_length(act, variations=(), needed=None):
        asked.append(dict(variations[0]) if variations else None)
        return beyond if len(asked) <= 4 and variations else 1.0

    monkeypatch.setattr(judge, "score_at_length", at_length)
    selection.make_plain(1)
    assert selection.learner.raw is plain
    assert [one.candidate for one in selection.plain] == [plain, worse]
    selection.choose_plain()
    assert asked == [None, {"n_targets": 4}] * 3
    assert selection.is_plain == (beyond > 0.9)  # the mean of training and validation may cost a twentieth
    assert selection.best[1] is (plain if beyond > 0.9 else best)
    assert selection.learner.raw is plain  # the states that it visits are those to learn from
    selection.plain = [dataclasses.replace(one, scores=(1.0,) * 5) for one in selection.plain]
    assert selection.is_sure == selection.is_plain  # lists that were refused are not compared again
    selection.plain.append(PlainList(plain, (1.0,) * 5))
    assert selection.is_sure  # a new one is


def test_next_plain_list_is_made_of_the_one_of_the_best_episodes_and_is_seen_to_be_far_worse_in_a_few(monkeypatch):
    with Pool("PandaReach-v0", 4) as pool:
        codec = ActionCodec(pool.spec, ("move_x", "move_y", "move_z", "open"))
        judge = Judge(pool, [{"n_targets": 1}], 6, 0.015, make_teacher("planner", pool.envs[0]))
    straight = np.zeros((1, 4, 33))
    names = names_of(pool.envs[0], 4, False)[0]
    straight[0, range(3), [names.index(f"target_d{axis}") for axis in "xyz"]] = 20.0
    straight[0, 3, -1] = -1.0
    good, idle = (DecisionList(np.zeros((0, 33)), factor * straight) for factor in (1.0, 0.0))
    given, added = [], []

    class Plain:
        raw, rng = None, np.random.default_rng(0)

        def plain(self, known, anew):
            given.append((known, anew))
            return [good, idle]

        def add(self, inputs, targets, weights):
            added.append((inputs, targets, weights))

    played = []

    def counted(*arguments, **more):
        played.append(arguments[2])
        return play(*arguments, **more)

    monkeypatch.setattr(judge_module, "play", counted)
    selection = Selection(Plain(), judge, (), codec, None, 0.05)
    with Pool("PandaReach-v0", 4) as judge.pool:
        selection.make_plain(1)
        selection.make_plain(2)
        selection.label_seen(50)
        ((inputs, targets, weights),) = added
        labels = codec.encode(judge.teacher.label_alone(inputs, judge.pool.envs[0]))
    assert given == [([], False), ([good, idle], True)]
    assert [len(plain.scores) for plain in selection.plain] == [2, 1, 2]
    assert selection.learner.raw is good
    assert played == [6, 2, 6, 2, 2, 4, 2]
    assert judge.last_result["success"] == 0.0
    assert judge.last_result["steps"] == judge.pool.cap
    assert len(inputs) == 50
    assert (weights > 1).any()  # the idle list has lost its episodes
    np.testing.assert_allclose(targets, labels)


def test_pieces_that_explain_nothing_are_looked_for_in_three_rounds_only():
    class NoPieces:
        asked = 0

        def plain(self, known, anew):
            self.asked += 1
            return []

    with Pool("PandaReach-v0", 2) as pool:
        judge = Judge(pool, [{"n_targets": 1}], 2, 0.015, make_teacher("planner", pool.envs[0]))
    selection = Selection(NoPieces(), judge, (), None, None, 0.05)
    for series in range(1, 11):
        selection.make_plain(series)
        selection.label_seen(50)
    assert selection.learner.asked == 3


@pytest.mark.parametrize(
    ("env_id", "variation", "expected"),
    [("Hanoi-v0", {"n_discs": 1}, 96), ("PandaReach-v0", {"n_targets": 1}, 24), ("CartPole-v1", {}, 96)],
)
def test_fewer_episodes_compare_candidates_where_each_step_is_a_simulation(env_id, variation, expected):
    with Pool(env_id, 12) as pool:
        teacher = make_teacher("planner" if variation else lambda seen: (seen[:, 2] > 0).astype(np.int64), pool.envs[0])
        judge = Judge(pool, [variation], None, 0.015, teacher)
        at_once = play(pool, [variation], expected, judge_module.VALIDATION_SEED, None, teacher)
    assert judge.n_episodes == expected
    np.testing.assert_array_equal(judge.teacher_episodes.returns, at_once.returns)


def test_last_comparison_plays_few_episodes_with_what_is_far_worse(monkeypatch):
    with Pool("PandaReach-v0", 4) as pool:
        judge = Judge(pool, [{"n_targets": 1}], 6, 0.015, make_teacher("planner", pool.envs[0]))
    results = iter([0.9, 0.3, 0.95, 0.9, 0.2])
    played = []

    def told(pool, variations, n_episodes, *arguments, **more):
        played.append(n_episodes)
        value = next(results)
        return Episodes(np.zeros(n_episodes), np.ones(n_episodes), np.full(n_episodes, value))

    monkeypatch.setattr(judge_module, "play", told)
    monkeypatch.setattr(Episodes, "score", lambda self, steps: float(self.successes.mean()))
    assert judge.score_at_length(None) == 0.9
    assert judge.score_at_length(None, needed=0.9) == 0.3
    assert judge.score_at_length(None, needed=0.9) == pytest.approx((4 * 0.95 + 8 * 0.9) / 12)
    assert judge.score_at_length(None, ({"n_targets": 4},), needed=0.9) == 0.2
    assert played == [12, 4, 4, 8, 4]


def test_states_that_are_drawn_stand_for_all():
    rng = np.random.default_rng(0)
    weights = np.where(rng.random(4000) < 0.05, 40.0, 1.0)
    data = Data(np.arange(8000.0).reshape(4000, 2), np.zeros((4000, 1)), weights)
    few = _drawn(data, 1000, rng)
    assert abs(len(few) - 1000) < 100
    assert few.weights.sum() == pytest.approx(weights.sum(), rel=0.05)
    heavy = {row.tobytes() for row in data.inputs[weights > 1]}
    assert heavy < {row.tobytes() for row in few.inputs}
    assert set(few.weights[few.weights > 20]) == {40.0}
    assert _drawn(data, 4000, rng) is data


def test_only_states_that_no_episode_comes_to_count_beside_the_episodes():
    with Pool("PandaStack-v0", 2) as pool:
        arguments = (pool, "planner", "PandaStack-v0", [{"n_objects": 1}], Settings(3, 0), (), 2, (0.015, 0.05))
        runs = {augment: Run(*arguments, augment) for augment in (None, "begun_towers", "taller_towers")}
    assert [run.selection.augment is not None for run in runs.values()] == [False, False, True]
    assert [len(run.selection.beyond) for run in runs.values()] == [0, 0, 0]  # given tasks have no validation set


@pytest.mark.parametrize(
    ("reached", "expected"), [({2: 1.0}, [1, 2]), ({1: 1.0, 7: 1.0}, [1]), ({}, [1, 2, 4, 7])], ids=["2", "1", "none"]
)
def test_shortest_list_that_suffices_is_taken_whatever_longer_ones_do(monkeypatch, reached, expected):
    with Pool("PandaReach-v0", 2) as pool:
        judge = Judge(pool, [{"n_targets": 1}], 2, 0.015, make_teacher("planner", pool.envs[0]))
    asked = []

    class Lists:
        raw = None

        def short(self, n_branches):
            asked.append(n_branches)
            return DecisionList(np.zeros((n_branches - 1, 3)), np.zeros((n_branches, 1, 3)))

        def loss_of(self, raw):
            return 0.0

    codec = ActionCodec(ActionSpec("box", (1,), (-1.0,), (1.0,)), ("x",))
    selection = Selection(Lists(), judge, (), codec, None, 0.05)
    selection.best, selection.reference = (1.0, DecisionList(np.zeros((9, 3)), np.zeros((10, 1, 3)))), 1.0
    monkeypatch.setattr(selection, "score", lambda raw, needed=None: reached.get(raw.n_branches, 0.5))
    selection.make_short()
    assert asked == expected
    assert selection.best[1].n_branches == (expected[-1] if reached else 10)
