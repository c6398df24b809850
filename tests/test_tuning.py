"""The search for hyperparameters: what is tried, what counts, and that it goes on where it was."""

from dataclasses import replace

import optuna
import pytest
from optuna.trial import TrialState

from progpolicy_envs import DOMAINS
from sb3_progpolicy.cli import run
from sb3_progpolicy.evaluation import Evaluation
from sb3_progpolicy.experiment.methods import METHODS
from sb3_progpolicy.experiment.tuning import Tuning, check_space, finished, open_study, score, suggest, tune
from sb3_progpolicy.hyperparams import load_search

SEARCH = {
    "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "n_epochs": {"low": 1, "high": 3},
    "gamma": [0.9, 0.99],
    "policy_kwargs.net_arch": [[4], [8, 8]],
}


def row(n_discs, steps):
    return Evaluation("Hanoi-v0", {"n_discs": n_discs}, 1, 1.0, steps, 0.0, 31.0, None, 0.0, 0.0)


@pytest.mark.parametrize("algo", METHODS)
def test_every_method_says_what_is_searched_and_takes_it(algo):
    search = load_search(algo)
    check_space(search)
    assert len(search) >= 6
    tuning = Tuning(algo, "Stacking-v0")
    chosen = {name: tried[-1] if not isinstance(tried, dict) else tried["high"] for name, tried in tuning.space.items()}
    config = tuning.config(chosen)
    for name, value in chosen.items():
        outer, dot, inner = name.partition(".")
        assert (config.hyperparams[outer][inner] if dot else config.hyperparams[outer]) == value
    assert config.n_timesteps == tuning.config({}).n_timesteps


def test_drawn_hyperparameters_are_of_the_kinds_that_the_space_says():
    chosen = suggest(optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)).ask(), SEARCH)
    assert 1e-4 <= chosen["learning_rate"] <= 1e-2
    assert chosen["n_epochs"] in (1, 2, 3)
    assert chosen["gamma"] in (0.9, 0.99)
    assert chosen["policy_kwargs.net_arch"] in ([4], [8, 8])


@pytest.mark.parametrize("tried", [[], "0.1", 3, {"low": 1}, {"low": 2, "high": 1}, {"low": 1, "high": 2, "step": 1}])
def test_space_that_says_nothing_is_refused(tried):
    with pytest.raises(ValueError, match=r"search: gamma=.* is not accepted; it is a list of values, or low and high"):
        check_space({"gamma": tried})


def test_validation_decides_and_training_breaks_ties():
    hanoi = DOMAINS["Hanoi-v0"]
    good, worse = [row(3, 7), row(5, 31)], [row(3, 7), row(5, 500)]
    worst = [row(3, 500), row(5, 500)]
    assert score(hanoi, good, 500) < score(hanoi, worse, 500) < score(hanoi, worst, 500) == 1
    assert score(hanoi, [row(3, 500), row(5, 100)], 500) < score(hanoi, [row(3, 1), row(5, 300)], 500)


def test_study_goes_on_where_it_was(tmp_path, capsys):
    storage = f"sqlite:///{tmp_path / 'tuning.db'}"
    small = Tuning("ppo", "Hanoi-v0", n_trials=2, n_timesteps=256, episodes=1, search=SEARCH)
    study = open_study(small, storage)
    tune(small, study)
    assert len(finished(study)) == 2
    assert study.trials[0].user_attrs["hyperparams"] == {}, "the first has the file's"
    assert set(study.trials[1].user_attrs["hyperparams"]) == set(SEARCH)
    assert len(study.trials[0].user_attrs["steps_mean"]) == len(DOMAINS["Hanoi-v0"].trained) + 1

    reports = []
    more = Tuning("ppo", "Hanoi-v0", n_trials=3, n_timesteps=256, episodes=1, search=SEARCH)
    again = open_study(more, storage)
    tune(more, again, reports.append)
    assert [trial.number for trial in reports] == [2]
    for other in ({"n_timesteps": 512}, {"episodes": 2}, {"max_seconds": 1.0}, {"search": {"gamma": [0.9, 0.99]}}):
        with pytest.raises(ValueError, match=r"is of .*, not of .*; give another --study-name"):
            open_study(replace(more, **other), storage)


def test_who_opens_a_study_again_draws_other_values(tmp_path):
    storage = f"sqlite:///{tmp_path / 'tuning.db'}"
    tuning = Tuning("ppo", "Hanoi-v0", search={"learning_rate": {"low": 1e-5, "high": 1.0, "log": True}})
    drawn = [
        [suggest(study.ask(), tuning.space)["learning_rate"] for _ in range(2)]
        for study in (open_study(tuning, storage) for _ in range(3))
    ]
    assert len({value for pair in drawn for value in pair}) == 6
    first = open_study(tuning, f"sqlite:///{tmp_path / 'other.db'}")
    assert [suggest(first.ask(), tuning.space)["learning_rate"] for _ in range(2)] == drawn[0], "the seed decides"


def test_a_first_trial_that_was_stopped_is_tried_again(tmp_path):
    storage = f"sqlite:///{tmp_path / 'tuning.db'}"
    tuning = Tuning("ppo", "Hanoi-v0", search=SEARCH)
    study = open_study(tuning, storage)
    study.tell(study.ask(), state=TrialState.FAIL)
    again = open_study(tuning, storage)
    assert again.ask().user_attrs == {"defaults": True}
    assert len(open_study(tuning, storage).trials) == 2, "it is running"


def test_values_that_do_not_go_together_cost_a_trial_and_no_more():
    tuning = Tuning("ppo", "Hanoi-v0", n_trials=2, n_timesteps=256, search={"gamma": [2.0, 3.0]}, episodes=1)
    study = open_study(tuning, None)
    tune(tuning, study)
    assert study.trials[1].state.name == "PRUNED"
    assert "gamma" in study.trials[1].user_attrs["refused"]


def test_command_prints_an_entry_for_the_file(tmp_path, capsys):
    command = ["tune", "--algo", "ppo", "--env", "Hanoi-v0", "-n", "1024", "--n-trials", "2", "--eval-episodes", "1"]
    assert run([*command, "--max-seconds", "20", "--storage", f"sqlite:///{tmp_path / 't.db'}"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("# ppo.yml, trial ")
    assert "Hanoi-v0:" in said.out
    assert "trial 1: " in said.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "CartPole-v1"], "'CartPole-v1' is not one of this package's environments"),
        (["--algo", "pppo"], "unknown algorithm 'pppo'; nearest: "),
        (["--n-trials", "0"], "--n-trials"),
    ],
)
def test_mistakes_are_named(arguments, message, capsys):
    assert run(["tune", *arguments]) == 2
    assert message in capsys.readouterr().err
