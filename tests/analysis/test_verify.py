"""What a program does from every start."""

import dataclasses
import json

import gymnasium as gym
import numpy as np
import pytest

from progpolicy_envs import DOMAINS
from sb3_progpolicy import ReptilePPO, evaluate_program, load_pretrained
from sb3_progpolicy.analysis.simplify import simplify
from sb3_progpolicy.analysis.verify import success_bound, verify
from sb3_progpolicy.cli import run
from sb3_progpolicy.programs import ProgramRunner, join_inputs
from sb3_progpolicy.programs.io import program_digest
from sb3_progpolicy.surroundings import surroundings
from tests.analysis.idle import idle


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path = tmp_path_factory.mktemp("small") / "small.json"
    simplify(load_pretrained("Hanoi-v0")).program.save(path)
    return str(path)


def test_four_terms_are_optimal_from_all_pegs_with_up_to_twelve_discs(small, capsys):
    assert run(["verify", small, "--set", "n_discs=1-12", "--all-starts", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["variation"] for row in rows] == [{"n_discs": n} for n in range(1, 13)]
    assert all((row["starts"], row["solved"], row["optimal"], row["worst_ratio"]) == (6, 6, 6, 1.0) for row in rows)
    assert all(row["exhaustive"] and row["counterexample"] is None and row["success_bound"] is None for row in rows)


def play(program, env_id, reset, cap=2000):
    """Run an episode in the single environment and return its steps, or ``None``."""
    env = gym.make(env_id, max_episode_steps=cap)
    observation, _ = env.reset(**reset)
    runner, previous, reward = ProgramRunner(program), None, 0.0
    for step in range(1, cap + 1):
        previous = runner.act(join_inputs(program, observation, previous, np.float32(reward), False))
        observation, reward, terminated, _, _ = env.step(previous[0])
        if terminated:
            return step
    return None


def test_counterexample_is_a_reset_that_fails_and_the_shortest(small, capsys, tmp_path):
    film = tmp_path / "failure.gif"
    arguments = ["verify", small, "--set", "n_discs=4", "--from-any-state"]
    assert run([*arguments, "--json", "-o", str(film)]) == 1
    (row,) = json.loads(capsys.readouterr().out)
    assert row["starts"] == 6 * 81
    assert row["solved"] < row["starts"]
    program = (
        load_pretrained("Hanoi-v0") if small is None else __import__("sb3_progpolicy").programs.load_program(small)
    )
    assert play(program, "Hanoi-v0", row["counterexample"]) is None
    assert film.read_bytes()[:4] == b"GIF8"
    assert run(arguments) == 1
    assert '"discs": [' in capsys.readouterr().out


def test_batched_runs_are_those_of_single_environments():
    program = load_pretrained("Stacking-v0")
    (row,) = verify(program, variations=[{"n_plates": 1}])
    assert (row.starts, row.exhaustive) == (625, True)
    venv = gym.make_vec("Stacking-v0", num_envs=625, vectorization_mode="vector_entry_point").unwrapped
    venv.reset_to({"n_plates": 1}, np.arange(625))
    optimal = venv.optimal_steps()
    steps = [play(program, "Stacking-v0", {"options": venv.state_of(i)}) for i in range(0, 625, 25)]
    assert row.solved == 625
    assert row.worst_ratio >= max(step / best for step, best in zip(steps, optimal[::25], strict=True))


def test_too_many_starts_are_drawn_and_the_share_has_a_bound():
    (row,) = verify(load_pretrained("Stacking-v0"), variations=[{"n_plates": 8}], n_starts=200)
    assert (row.starts, row.exhaustive) == (200, False)
    assert row.solved == 200
    assert row.success_bound == pytest.approx(0.05 ** (1 / 200))


def test_physics_is_tested_and_not_verified(capsys):
    assert run(["verify", "PandaReach-v0", "--set", "n_targets=1", "--starts", "3"]) == 0
    out = capsys.readouterr().out
    assert "tested on drawn starts" in out
    assert "every start" not in out
    assert run(["verify", "PandaReach-v0", "--set", "n_targets=1", "--all-starts"]) == 2
    assert "cannot be counted" in capsys.readouterr().err


@pytest.mark.parametrize(("solved", "starts", "bound"), [(0, 10, 0.0), (10, 10, 0.05**0.1), (50, 100, 0.4136)])
def test_bound_is_that_of_clopper_and_pearson(solved, starts, bound):
    assert success_bound(solved, starts) == pytest.approx(bound, abs=1e-3)


def test_certificate_names_program_versions_and_command(small, tmp_path, capsys):
    path = tmp_path / "certificate.json"
    assert run(["verify", small, "--set", "n_discs=1,2", "-o", str(path)]) == 0
    written = json.loads(path.read_text())
    assert set(written) == {"program", "env", "command", "versions", "rows"}
    assert written["env"] == "Hanoi-v0"
    assert len(written["rows"]) == 2
    assert len(written["program"]) == 16
    assert "every start" in capsys.readouterr().out
    assert [file.name for file in tmp_path.iterdir()] == ["certificate.json"], "its state is removed"


def test_digest_tells_programs_apart_and_looks_away_from_metadata():
    programs = [load_pretrained(name) for name in ("Hanoi-v0", "Stacking-v0")]
    assert len({program_digest(program) for program in programs}) == 2
    assert program_digest(dataclasses.replace(programs[0], metadata={"a": 1})) == program_digest(programs[0])


@pytest.mark.parametrize("n_batches", [1, 3, 6])
def test_interrupted_verification_goes_on_to_the_same_rows(n_batches, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_progpolicy.analysis.verify.BATCH", 64)
    monkeypatch.setattr("sb3_progpolicy.analysis.checkpoint.INTERVAL", 0.0)
    program, path = load_pretrained("Hanoi-v0"), tmp_path / "state.json"
    arguments = {"variations": [{"n_discs": 2}, {"n_discs": 4}], "from_any_state": True, "max_steps": 20}
    whole = verify(program, **arguments)
    assert 0 < whole[1].solved < whole[1].starts == 486
    made = []

    def interrupt(done, total):
        made.append(done)
        if len(made) == n_batches:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        verify(program, **arguments, progress=interrupt, checkpoint=path)
    assert verify(program, **arguments, progress=interrupt, checkpoint=path) == whole
    assert made == [54, *range(64, 486, 64), 486], "no batch is made twice"
    assert verify(program, **arguments, progress=interrupt, checkpoint=path) == whole
    assert made[-1] == 486, "all of it was done already"
    assert len(made) == 9


def test_state_of_another_verification_is_refused(tmp_path):
    program, path = load_pretrained("Hanoi-v0"), tmp_path / "state.json"
    verify(program, variations=[{"n_discs": 1}], checkpoint=path)
    with pytest.raises(ValueError, match="another variations; give the same arguments"):
        verify(program, variations=[{"n_discs": 2}], checkpoint=path)
    path.write_text("{}")
    with pytest.raises(ValueError, match=r"not the state of a verification.*remove it"):
        verify(program, variations=[{"n_discs": 1}], checkpoint=path)


def test_drawn_starts_are_the_same_after_an_interruption(tmp_path, monkeypatch):
    program, path = load_pretrained("Stacking-v0"), tmp_path / "state.json"
    arguments = {"variations": [{"n_plates": 3}, {"n_plates": 2}], "n_starts": 40, "seed": 4}
    whole = verify(program, **arguments)

    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        verify(program, **arguments, progress=interrupt, checkpoint=path)
    assert verify(program, **arguments, checkpoint=path) == whole


@pytest.mark.parametrize(("arguments", "message"), [
    ({"n_starts": 0}, "n_starts=0"),
    ({"n_starts": 5, "all_starts": True}, "not accepted together"),
    ({"from_any_state": True, "env_id": "Stacking-v0"}, "reads 9 numbers"),
    ({"variations": [{"n_discs": 40}]}, "n_discs=40"),
])  # fmt: skip
def test_arguments_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        verify(load_pretrained("Hanoi-v0"), **arguments)


def test_states_that_no_domain_counts_are_named():
    with pytest.raises(ValueError, match="legal states cannot be counted"):
        verify(load_pretrained("PandaReach-v0"), from_any_state=True)
    with pytest.raises(ValueError, match=r"states of .* cannot be counted"):
        verify(load_pretrained("Stacking-v0"), variations=[{"n_plates": 1}], from_any_state=True)


def test_maps_that_are_drawn_are_sampled():
    domain = DOMAINS["Hiking-v0"]
    assert domain.simulation is False
    (row,) = verify(idle("Hiking-v0"), "Hiking-v0", [{"n_stars": 1, "layout": "random"}], n_starts=4, max_steps=20)
    assert (row.starts, row.exhaustive) == (4, False)


def test_the_environment_is_made_as_in_training():
    program = load_pretrained("Hiking-v0")
    elsewhere = dataclasses.replace(program, metadata={**program.metadata, "env_kwargs": {"layout": "comb"}})
    (own,) = verify(elsewhere, variations=[{"n_stars": 1}], n_starts=20)
    (given,) = verify(program, variations=[{"n_stars": 1, "layout": "comb"}], n_starts=20)
    (default,) = verify(program, variations=[{"n_stars": 1}], n_starts=20)
    assert own == given
    assert own.variation == {"layout": "comb", "n_stars": 1}
    assert own.solved < default.solved == 20
    (row,) = evaluate_program(elsewhere, variations=[{"n_stars": 1}], n_episodes=5)
    assert row.success_rate < 1
    (chosen,) = verify(elsewhere, variations=[{"n_stars": 1, "layout": "valley"}], n_starts=20)
    assert chosen.solved == 20, "what is set is in force"


def test_a_cap_of_ones_own_and_other_arguments_are_in_force():
    program = load_pretrained("Hiking-v0")
    capped = dataclasses.replace(program, metadata={**program.metadata, "env_kwargs": {"max_episode_steps": 3}})
    assert surroundings(capped, "Hiking-v0").cap == 3
    assert surroundings(program, "Hiking-v0").cap == 500
    observed = dataclasses.replace(program, metadata={**program.metadata, "env_kwargs": {"context": "observed"}})
    with pytest.raises(ValueError, match=r"the program reads 80 numbers .* has 8\d numbers"):
        verify(observed, variations=[{"n_stars": 1}], n_starts=2)


@pytest.mark.parametrize(
    ("env_id", "variation", "message"),
    [
        ("CartPole-v1", {}, "CartPole-v1 does not say whether its goal is reached"),
        ("CartPole-v1", {"nonsense": 4}, "nonsense"),
        ("Acrobot-v1", {}, "the program reads 4 numbers .* Acrobot-v1 has 6 numbers"),
    ],
)
def test_environments_that_are_not_of_a_domain_are_checked(env_id, variation, message):
    model = ReptilePPO("ProgPolicy", "CartPole-v1", n_steps=8, batch_size=8, seed=0, device="cpu")
    with pytest.raises(ValueError, match=message):
        verify(model.program(), env_id, [variation], n_starts=2)
