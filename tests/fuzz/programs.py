"""Damaged and hostile program files: each loads as a valid program or is refused, and nothing of it is run."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sb3_progpolicy.programs import (
    Program,
    ProgramFormatError,
    check_program,
    export_graphviz,
    export_latex,
    export_text,
    load_program,
    save_program,
)
from tests.programs.formats import check_python
from tests.programs.hostile import PIECES, with_hostile_texts
from tests.programs.strategies import small_program

_JSON_TOKEN = re.compile(rb'"(?:[^"\\]|\\.)*"|-?[0-9.eE+-]+|true|false|null|[\[\]{}:,]')
_NUMBERS = (
    b"NaN", b"Infinity", b"-Infinity", b"1e999", b"-1e999", b"1e-999", b"5e-324", b"1e308", b"0", b"-0", b"-0.0", b"01",
    b"0x10", b"1_000", b"2", b"-7", b"9007199254740993", b"9" * 50, b"9" * 500, b"9" * 20_000, b"0." + b"3" * 20_000,
)  # fmt: skip
_STRINGS = (
    b'""', b'"\\ud800"', b'"\\u0000"', b'"\\n"', b'"\\u202e"', b'"\\u001b[2J"', b'"__class__"', b'"env"',
    b'"X coding: utf-7"', b'"!!python/object/apply:os.system"',
    b'"box"', b'"multi_discrete"', b'"lstm"', b'"affine"', b'"weights"', b"'x'",
)  # fmt: skip
_OTHERS = (
    b"true", b"null", b"[", b"]", b"{", b"}", b",", b":", b"[]", b"{}", b"/* */", b"\xef\xbb\xbf",
    b'{"py/object": "os.system"}', b"[" * 2_000, b'{"a":' * 2_000, b"[" * 250_000,
)  # fmt: skip
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2**31, 2**53, 2**63, 10**40, 0.5, -0.0, 1e308, 5e-324, "", "a", "\ud800", "\n",
    "\x1b[2J", "x" * 201, [], {}, [[]], [0.0], {"a": 1}, "box", "discrete", "multi_binary", "affine", "gru", "lstm",
)  # fmt: skip
_heard: list[str] = []
_listening = False


def case(rng: np.random.Generator, folder: Path) -> str:
    """Write a program, damage the file at one level, load it; what loads is printed and saved again."""
    path = folder / "program.json"
    program = small_program(rng)
    save_program(with_hostile_texts(program, rng) if rng.random() < 0.5 else program, path)
    level, damage = tuple(_LEVELS.items())[rng.integers(len(_LEVELS))]
    path.write_bytes(damage(path.read_bytes(), rng))
    try:
        with _nothing_run():
            loaded = load_program(path)
    except ProgramFormatError as error:
        message = str(error)
        assert str(path) in message
        assert message.replace(str(path), "").isprintable()
        assert len(message) < 1_000
        return f"{level}: refused"
    _use(loaded, folder / "again.json")
    return f"{level}: loaded"


def _use(program: Program, path: Path) -> None:
    check_program(program)
    save_program(program, path)
    assert load_program(path) == program
    for export in (export_text, export_graphviz, export_latex):
        assert export(program)
    compile(check_python(program), "exported.py", "exec")


def _damage_bytes(raw: bytes, rng: np.random.Generator) -> bytes:
    content = bytearray(raw)
    for _ in range(rng.choice([1, 1, 2, 4])):
        start = int(rng.integers(len(content) + 1))
        length = int(rng.integers(1, 40))
        kind = rng.integers(7)
        if kind == 0:
            del content[start:]
        elif kind == 1:
            del content[start : start + length]
        elif kind == 2:
            content[start : start + length] = rng.bytes(length)
        elif kind == 3:
            content[start:start] = content[start : start + 50 * length]
        elif kind == 4:
            content[start : start + 1] = rng.bytes(1)
        elif kind == 5 and (digits := [place for place, byte in enumerate(content) if byte in b"0123456789"]):
            content[digits[rng.integers(len(digits))]] = b"0123456789"[rng.integers(10)]
        else:
            content[start:start] = str(rng.choice(PIECES)).encode("utf-8", "surrogatepass")
    return bytes(content)


def _damage_tokens(raw: bytes, rng: np.random.Generator) -> bytes:
    tokens = _JSON_TOKEN.findall(raw)
    for _ in range(rng.choice([1, 1, 3])):
        place, other = rng.integers(len(tokens), size=2)
        alike = _STRINGS if tokens[place].startswith(b'"') else _NUMBERS if tokens[place][-1:].isdigit() else _OTHERS
        kind = rng.integers(6)
        if kind < 3:
            among = alike if kind else (*_NUMBERS, *_STRINGS, *_OTHERS)
            tokens[place] = among[rng.integers(len(among))]
        elif kind == 3:
            tokens[place], tokens[other] = tokens[other], tokens[place]
        elif kind == 4:
            tokens.insert(place, tokens[other])
        elif len(tokens) > 1:
            del tokens[place]
    return b" ".join(tokens)


def _damage_structure(raw: bytes, rng: np.random.Generator) -> bytes:
    data = json.loads(raw)
    for _ in range(rng.integers(1, 3)):
        places = list(_places(data))
        node, key = places[rng.integers(len(places))]
        kind = rng.integers(7)
        if kind == 0:
            del node[key]
        elif kind == 1:
            node[key] = [node[key]] * int(rng.choice([2, 3, 100, 5_000]))
        elif kind == 2 and isinstance(node[key], list):
            node[key] = node[key] * int(rng.choice([0, 2, 65, 5_000]))
        elif kind == 3:
            other, name = places[rng.integers(len(places))]
            node[key] = json.loads(json.dumps(other[name] if name in other or isinstance(other, list) else 0))
        elif kind == 4 and isinstance(node, dict):
            node[str(rng.choice(PIECES))] = node[key]
        elif kind == 5:
            for _ in range(rng.choice([5, 20, 300])):
                node[key] = {"a": node[key]} if rng.random() < 0.5 else [node[key]]
        else:
            node[key] = _VALUES[rng.integers(len(_VALUES))]
    return json.dumps(data, ensure_ascii=bool(rng.integers(2))).encode("utf-8", "surrogatepass")


def _places(data: Any) -> Iterator[tuple[Any, Any]]:
    keys = data if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    for key in keys:
        yield data, key
        yield from _places(data[key])


_LEVELS = {"bytes": _damage_bytes, "tokens": _damage_tokens, "structure": _damage_structure}


@contextmanager
def _nothing_run() -> Iterator[None]:
    """Hear of every import, compilation, process and opened file inside the block: one file may be read, no more."""
    global _listening
    _heard.clear()
    _listening = True
    try:
        yield
    finally:
        _listening = False
    assert _heard == ["open"], f"loading a program file did {_heard}"


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    if _listening:
        _heard.append(event if event != "open" or arguments[1] == "r" else f"open for {arguments[1]}")


sys.addaudithook(_hear)
