import subprocess
import sys

import pytest

import sb3_progpolicy.pretrained as pretrained
from sb3_progpolicy import load_pretrained, pretrained_names
from tests.handwritten.hanoi import hanoi_program


@pytest.fixture
def one_program(tmp_path, monkeypatch):
    hanoi_program().save(tmp_path / "Hanoi-v0.json")
    monkeypatch.setattr(pretrained, "files", lambda package: tmp_path)


def test_program_is_loaded_by_its_environment(one_program):
    assert pretrained_names() == ["Hanoi-v0"]
    assert load_pretrained("Hanoi-v0") == load_pretrained("progpolicy_envs:Hanoi-v0") == hanoi_program()


def test_unknown_name_is_answered_with_the_nearest(one_program):
    with pytest.raises(ValueError, match="'Hanoi-v1'; nearest: Hanoi-v0"):
        load_pretrained("Hanoi-v1")


def test_every_shipped_program_loads():
    for name in pretrained_names():
        assert load_pretrained(name).metadata["env"] == name


def test_loading_needs_no_torch():
    code = "import sys, sb3_progpolicy as s; s.pretrained_names(); s.load_pretrained; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
