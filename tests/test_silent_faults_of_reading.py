"""What commands that read, show and film programs must not pass over."""

from sb3_progpolicy import load_pretrained
from sb3_progpolicy.cli import run


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


def test_a_plan_without_a_step_is_filmed(tmp_path, capsys):
    arguments = ["render", "Hanoi-v0", "--planner", "--set", "n_discs=2", "discs=[2,2]", "target=2", "-o"]
    assert run([*arguments, str(tmp_path / "s.gif")]) == 0


def test_activity_shows_the_program_as_it_acts(tmp_path):
    """The simplified one is the same from the starts of training, and not from others."""
    state = ["--set", "n_discs=4", "source=1", "target=0", "discs=[2,2,1,0]"]
    shown, learnt = (tmp_path / name for name in ("shown.png", "learnt.png"))
    assert run(["show", "Hanoi-v0", "--format", "activity", *state, "-o", str(shown)]) == 0
    assert run(["show", "Hanoi-v0", "--format", "activity", "--full", *state, "-o", str(learnt)]) == 0
    assert shown.read_bytes() == learnt.read_bytes()
