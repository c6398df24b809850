"""Programs as JSON files: plain data, nothing evaluated, every float kept to the last bit."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from sb3_progpolicy.programs.files import write_atomically
from sb3_progpolicy.programs.syntax import Condition, Controller, IfThenElse, Matrix, ProgramData, Vector
from sb3_progpolicy.programs.validation import MAX_CONDITIONS, check_program
from sb3_progpolicy.spaces import ActionSpec

FORMAT, VERSION = "sb3-progpolicy program", 1
MAX_BYTES = 8 * 1024 * 1024
MAX_CONTAINERS = 200_000  # bounds the memory that parsing can take
MAX_DIGITS = 400  # of a number without an exponent; the longest that repr writes has 309

_Item = TypeVar("_Item")


class ProgramFormatError(ValueError):
    """A file is not a program in this format: damaged, truncated, of another version or hostile."""


def save_program(program: ProgramData, path: str | os.PathLike[str]) -> None:
    """Write a program to a JSON file, atomically.

    :param program: what to save
    :param path: the file to create or replace
    :raises ValueError: if the program is not well formed or is too large to be loaded again
    :raises OSError: if the file cannot be written
    """
    check_program(program)
    text = _layout(_to_json(program)) + "\n"
    if len(text) > MAX_BYTES or text.count("[") + text.count("{") > MAX_CONTAINERS:
        raise ValueError(f"the program takes {len(text)} bytes as JSON; at most {MAX_BYTES} are accepted")
    write_atomically(path, text)


def program_digest(program: ProgramData) -> str:
    """Return what tells programs apart: sixteen hexadecimal digits that follow from all but its metadata.

    :param program: well formed
    """
    described = _to_json(dataclasses.replace(program, metadata={}))
    return hashlib.sha256(json.dumps(described, sort_keys=True, allow_nan=False).encode()).hexdigest()[:16]


def read_program(path: str | os.PathLike[str]) -> ProgramData:
    """Read and check a file; see :func:`~sb3_progpolicy.programs.load_program`."""
    with Path(path).open("rb") as handle:
        return parse_program(handle.read(MAX_BYTES + 1), os.fspath(path))


def parse_program(raw: bytes, name: str = "this") -> ProgramData:
    """Return the program that a file holds, checked like a file's.

    :param raw: content of the file
    :param name: of the file, for the error message
    :raises ProgramFormatError: naming the fault, if it is not a well-formed program
    """
    try:
        program = _from_json(_parse(raw))
        check_program(program)
    except RecursionError:
        raise ProgramFormatError(f"{name}: not a program file: nested too deeply") from None
    except ValueError as error:
        raise ProgramFormatError(f"{name}: not a program file: {error}") from None
    return program


def _to_json(program: ProgramData) -> dict[str, Any]:
    *then, last = program.controllers
    return {
        "format": FORMAT,
        "version": VERSION,
        "metadata": dict(program.metadata),
        "n_observations": program.n_observations,
        "interaction": program.interaction,
        "input_names": program.input_names,
        "action": vars(program.action),
        "output_names": program.output_names,
        "temperature": program.temperature,
        **({} if program.semantics == "means" else {"semantics": program.semantics}),
        "branches": [
            {"if": vars(condition), "then": vars(controller)}
            for condition, controller in zip(program.conditions, then, strict=True)
        ],
        "else": vars(last),
    }


def _layout(value: Any, indent: str = "") -> str:
    """JSON with one row of a matrix on one line."""
    deeper = indent + "  "
    if isinstance(value, dict) and value:
        items = [f"{deeper}{json.dumps(key)}: {_layout(item, deeper)}" for key, item in value.items()]
        return "{\n" + ",\n".join(items) + f"\n{indent}}}"
    if isinstance(value, (list, tuple)) and any(isinstance(item, (list, tuple, dict)) for item in value):
        return "[\n" + ",\n".join(deeper + _layout(item, deeper) for item in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False)


def _parse(raw: bytes) -> Any:
    if len(raw) > MAX_BYTES:
        raise ValueError(f"larger than the {MAX_BYTES} bytes that are accepted")
    if raw.count(b"[") + raw.count(b"{") > MAX_CONTAINERS:
        raise ValueError(f"more than {MAX_CONTAINERS} lists and objects")
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 text (byte {error.start})") from None
    if not text.strip():
        raise ValueError("the file is empty")
    try:
        return json.loads(
            text, parse_int=_parse_int, parse_constant=_refuse_constant, object_pairs_hook=_object_without_repetition
        )
    except json.JSONDecodeError as error:
        raise ValueError(f"damaged or truncated JSON, line {error.lineno} column {error.colno}: {error.msg}") from None


def _parse_int(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not accepted; numbers are finite")


def _object_without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("an object that holds the same key twice")
    return result


def _from_json(data: Any) -> ProgramData:
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ValueError(f'it does not say "format": "{FORMAT}"')
    if type(data.get("version")) is not int or data["version"] != VERSION:
        raise ValueError(
            f"version {ascii(data.get('version'))[:20]} is not accepted, this release reads version {VERSION}; "
            "a newer file needs a newer sb3-progpolicy"
        )
    known = ("n_observations", "interaction", "input_names", "action", "output_names", "temperature")
    optional = ("semantics",) if "semantics" in data else ()
    _keys("file", data, ("format", "version", "metadata", *known, *optional, "branches", "else"))
    branches = _items("branches", data["branches"])
    if len(branches) > MAX_CONDITIONS:
        raise ValueError(f"branches: {len(branches)} conditions given; at most {MAX_CONDITIONS} are accepted")
    body: Controller | IfThenElse = _controller("else", data["else"])
    for index in reversed(range(len(branches))):
        place = f"branches[{index}]"
        branch = _keys(place, branches[index], ("if", "then"))
        body = IfThenElse(_condition(f"{place}.if", branch["if"]), _controller(f"{place}.then", branch["then"]), body)
    if not isinstance(data["metadata"], dict):
        raise ValueError("metadata: an object is accepted, nothing else")
    return ProgramData(
        body=body,
        n_observations=data["n_observations"],
        action=_action(data["action"]),
        interaction=data["interaction"],
        input_names=tuple(_items("input_names", data["input_names"])),
        output_names=tuple(_items("output_names", data["output_names"])),
        temperature=_number("temperature", data["temperature"]),
        metadata=data["metadata"],
        semantics=data.get("semantics", "means"),
    )


def _action(data: Any) -> ActionSpec:
    fields = _keys("action", data, ("kind", "sizes", "low", "high", "start"))
    return ActionSpec(
        kind=_text("action.kind", fields["kind"]),
        sizes=tuple(_items("action.sizes", fields["sizes"])),
        low=_vector("action.low", fields["low"]),
        high=_vector("action.high", fields["high"]),
        start=fields["start"],
    )


def _condition(place: str, data: Any) -> Condition:
    fields = _keys(place, data, tuple(field.name for field in dataclasses.fields(Condition)))
    return Condition(
        cell=_text(f"{place}.cell", fields["cell"]),
        weight_ih=_matrix(f"{place}.weight_ih", fields["weight_ih"]),
        weight_hh=_matrix(f"{place}.weight_hh", fields["weight_hh"]),
        bias_ih=_vector(f"{place}.bias_ih", fields["bias_ih"]),
        bias_hh=_vector(f"{place}.bias_hh", fields["bias_hh"]),
        readout=_vector(f"{place}.readout", fields["readout"]),
        readout_bias=_number(f"{place}.readout_bias", fields["readout_bias"]),
    )


def _controller(place: str, data: Any) -> Controller:
    fields = _keys(place, data, ("weights", "bias"))
    return Controller(_matrix(f"{place}.weights", fields["weights"]), _vector(f"{place}.bias", fields["bias"]))


def _keys(place: str, data: Any, names: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise ValueError(f"{place}: an object is accepted, nothing else")
    if missing := [name for name in names if name not in data]:
        raise ValueError(f"{place}: {', '.join(missing)} missing")
    if unknown := sorted(set(data) - set(names)):
        raise ValueError(f"{place}: unknown {ascii(unknown[0])[:60]}; it holds {', '.join(names)}")
    return data


def _items(place: str, data: Any) -> list[Any]:
    if not isinstance(data, list):
        raise ValueError(f"{place}: a list is accepted, nothing else")
    return data


def _mapped(place: str, data: Any, convert: Callable[[str, Any], _Item]) -> tuple[_Item, ...]:
    return tuple(convert(f"{place}[{index}]", item) for index, item in enumerate(_items(place, data)))


def _matrix(place: str, data: Any) -> Matrix:
    return _mapped(place, data, _vector)


def _vector(place: str, data: Any) -> Vector:
    return _mapped(place, data, _number)


def _number(place: str, data: Any) -> float:
    if isinstance(data, bool) or not isinstance(data, (int, float)):
        raise ValueError(f"{place}: a number is accepted, nothing else")
    try:
        return float(data)
    except OverflowError:
        raise ValueError(f"{place}: a number too large for a float") from None


def _text(place: str, data: Any) -> Any:
    if not isinstance(data, str):
        raise ValueError(f"{place}: a string is accepted, nothing else")
    return data
