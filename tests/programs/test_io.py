import json
import os
import stat
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_progpolicy.programs import Program, ProgramFormatError, check_program, load_program, save_program
from sb3_progpolicy.programs import io as program_io
from tests.programs.strategies import hanoi_program, programs


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "program.json"
    save_program(hanoi_program(), path)
    return path


def load_text(tmp_path, text):
    path = tmp_path / "text.json"
    path.write_text(text, encoding="utf-8")
    return load_program(path)


@given(program=programs)
@settings(max_examples=60, deadline=None)
def test_loaded_program_equals_saved_program_to_the_last_bit(program, tmp_path_factory):
    path = tmp_path_factory.mktemp("io") / "program.json"
    program.save(path)
    loaded = Program.load(path)
    assert loaded == program
    assert repr(loaded) == repr(program)  # tells -0.0 from 0.0, which == does not


def test_one_row_of_a_matrix_is_one_line(saved):
    data = json.loads(saved.read_text())
    row = json.dumps(data["else"]["weights"][0])
    assert any(line.strip().rstrip(",") == row for line in saved.read_text().splitlines())


@given(data=st.data())
@settings(max_examples=300, deadline=None)
def test_mutated_file_loads_as_a_valid_program_or_says_what_is_wrong(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("io") / "program.json"
    save_program(data.draw(programs), path)
    raw = bytearray(path.read_bytes())
    kind = data.draw(st.sampled_from(["truncate", "replace", "delete", "insert"]))
    start = data.draw(st.integers(0, len(raw) - 1))
    if kind == "truncate":
        del raw[start:]
    elif kind == "replace":
        raw[start] = data.draw(st.integers(0, 255))
    elif kind == "delete":
        del raw[start : start + data.draw(st.integers(1, 40))]
    else:
        raw[start:start] = data.draw(st.sampled_from([b"[", b"]", b"NaN", b"1e999", b'"', b"-", b"9" * 50, b"\x00"]))
    path.write_bytes(raw)
    loads_or_names_the_file(path)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda children: st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=5), children, max_size=3),
    max_leaves=6,
)


@given(data=st.data())
@settings(max_examples=300, deadline=None)
def test_any_field_may_hold_anything_without_another_kind_of_error(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("io") / "program.json"
    save_program(data.draw(programs), path)
    content = json.loads(path.read_text())
    node = content
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = data.draw(st.sampled_from(keys))
        if not (isinstance(node[key], (dict, list)) and node[key] and data.draw(st.booleans())):
            break
        node = node[key]
    if data.draw(st.booleans()):
        node[key] = data.draw(json_values)
    else:
        del node[key]
    path.write_text(json.dumps(content))
    loads_or_names_the_file(path)


def loads_or_names_the_file(path):
    try:
        program = load_program(path)
    except ProgramFormatError as error:
        message = str(error)
    else:
        message = ""
    if message:
        assert str(path) in message
        assert len(message.splitlines()) == 1
        return
    check_program(program)
    again = path.with_name("again.json")
    save_program(program, again)
    assert load_program(again) == program


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "empty"),
        ("{}", "format"),
        ("[]", "format"),
        ("null", "format"),
        ('{"format": "sb3-progpolicy program", "version": 2}', "version 2"),
        ('{"format": "sb3-progpolicy program", "version": true}', "version True"),
        ('{"format": "sb3-progpolicy program", "version": 1}', "missing"),
        ('{"format": "sb3-progpolicy program", "version": "\\u001b[2J\\n"}', r"version '\\x1b\[2J\\n' is"),
        ('{"format": 1, "format": 1}', "twice"),
        ("[" * 150_000, "nested too deeply"),
        ("[" * 300_000, "lists and objects"),
        ('{"a":' * 150_000, "nested too deeply"),
        ("9" * 100_000, "digits"),
        ("NaN", "NaN"),
        ("cos\nsystem\n(S'true'\ntR.", "damaged or truncated JSON"),
    ],
)
def test_hostile_text_is_refused_with_its_fault(text, fault, tmp_path):
    with pytest.raises(ProgramFormatError, match=fault):
        load_text(tmp_path, text)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda d: d.update(surprise=1), "unknown 'surprise'"),
        (lambda d: d["else"]["bias"].pop(), r"else.bias: 5 numbers given; a tuple of 6"),
        (lambda d: d["else"]["weights"].pop(), "else.weights: 5 rows given"),
        (lambda d: d["branches"][1]["if"].update(cell="transformer"), "transformer"),
        (lambda d: d["branches"][1]["if"]["weight_hh"][0].pop(), r"branches\[1\].if.weight_hh\[0\]"),
        (lambda d: d["branches"][0]["if"].update(readout=[]), "0 hidden units"),
        (lambda d: d.update(branches=d["branches"] * 40), "at most 64"),
        (lambda d: d.update(temperature=0.0), "temperature"),
        (lambda d: d.update(temperature=True), "temperature"),
        (lambda d: d.update(interaction=1), "interaction"),
        (lambda d: d["input_names"].pop(), "16 names given"),
        (lambda d: d["input_names"].__setitem__(0, "x\nimport os"), "printable"),
        (lambda d: d["action"].update(sizes=[10**30]), "sizes"),
        (lambda d: d["action"].update(sizes=[-6]), "sizes"),
        (lambda d: d["action"].update(kind="text"), "text"),
        (lambda d: d["action"].update(kind="x" * 10_000), r"action.kind='x{56}\.\.\. is not"),
        (lambda d: d["action"].update(start=10**30), "action.start=1"),
        (lambda d: d["else"]["bias"].__setitem__(0, 10**400), "a number of 401 digits"),
        (lambda d: d["else"]["bias"].__setitem__(0, 10**350), "too large"),
        (lambda d: d["else"]["bias"].__setitem__(0, "1"), r"else.bias\[0\]"),
        (lambda d: d.update(metadata=[]), "metadata"),
    ],
)
def test_fault_in_a_field_is_named(change, fault, saved):
    data = json.loads(saved.read_text())
    change(data)
    saved.write_text(json.dumps(data))
    with pytest.raises(ProgramFormatError, match=fault):
        load_program(saved)


def test_other_encodings_large_files_and_endless_devices_are_refused(tmp_path):
    path = tmp_path / "program.json"
    path.write_bytes(b"\xff\xfe{}")
    with pytest.raises(ProgramFormatError, match="UTF-8"):
        load_program(path)
    path.write_bytes(b" " * (program_io.MAX_BYTES + 1))
    with pytest.raises(ProgramFormatError, match="larger"):
        load_program(path)
    with pytest.raises(ProgramFormatError, match="larger"):
        load_program("/dev/zero")


def test_missing_file_is_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_program(tmp_path / "none.json")


def test_failed_save_leaves_the_old_file_and_no_other(saved, monkeypatch):
    before = saved.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_program(hanoi_program(1), saved)
    assert saved.read_bytes() == before
    assert os.listdir(saved.parent) == [saved.name]


def test_saved_file_has_the_permissions_of_any_other_file(saved):
    other = saved.with_name("other")
    other.touch()
    assert stat.S_IMODE(saved.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"metadata": {"when": (1, 2)}}, "tuple"),
        ({"metadata": {"score": np.float32(1)}}, "float32"),
        ({"metadata": {"score": float("nan")}}, "nan"),
        ({"temperature": float("inf")}, "temperature"),
        ({"output_names": ("a",)}, "output_names: 1 names given"),
        ({"interaction": False}, "input_names: 17 names given; a tuple of 9"),
    ],
)
def test_malformed_program_is_not_saved(change, fault, tmp_path):
    with pytest.raises(ValueError, match=fault):
        save_program(replace(hanoi_program(), **change), tmp_path / "program.json")
    assert os.listdir(tmp_path) == []
