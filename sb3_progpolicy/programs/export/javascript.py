"""A program as one JavaScript file that needs nothing but the language."""

from __future__ import annotations

import json
import os
from importlib.resources import files
from typing import Any

from sb3_progpolicy.programs.export.visitor import deliver, title
from sb3_progpolicy.programs.syntax import Condition, Controller, ProgramData
from sb3_progpolicy.programs.validation import check_program

_HEAD = """\
// Written by sb3-progpolicy. ES2020, for Node and browsers; needs nothing else.
//
//     const { ProgramPolicy } = require("./policy.js"); // in a page: <script src="policy.js">
//     const policy = new ProgramPolicy();
//     let action = policy.act(observation, null, 0, false); // the first step
//     action = policy.act(observation, action, reward, done); // every later step
//     policy.explain(observation, action, reward, done); // a step with all that led to its action
"""
# "<" could begin "</script"; the two others could begin an entity or end a comment in a page.
_ESCAPES = {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026"}


def export_javascript(program: ProgramData, out_file: str | os.PathLike[str] | Any | None = None) -> str | None:
    """Write a program as one JavaScript source (ES2020, no dependencies), for Node or a web page.

    Its class ``ProgramPolicy`` has ``reset()`` and ``act(observation, previousAction, previousReward, previousDone)``
    and chooses the same actions as :class:`~sb3_progpolicy.programs.interpreter.ProgramRunner` with crisp semantics.
    Sums are taken in the same order, so that an affine program's numbers are the same to the last bit. A recurrent
    condition's may differ by the last bit of ``Math.tanh``, which no standard fixes.
    ``explain(...)`` takes the same step and returns all that led to the action, as
    :func:`~sb3_progpolicy.programs.explain` does.

    No text of a program becomes code, whoever made it: names are JSON strings in ASCII without ``<``, ``>`` and ``&``,
    so that the source may stand in a ``<script>`` too.

    :param program: what to write
    :param out_file: a path or an open text file to write to
    :return: the source if ``out_file`` is ``None``, else ``None``
    :raises ValueError: if the program is not well formed
    """
    check_program(program)
    runtime = (files(__package__) / "policy.js").read_text(encoding="utf-8")
    return deliver(f'{_HEAD}"use strict";\n\nconst PROGRAM = {_literal(_data(program))};\n\n{runtime}', out_file)


def escaped_json(value: Any) -> str:
    """Return JSON in ASCII that may stand in a script of a web page.

    :param value: plain data
    """
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(", ", ": "))
    for character, escape in _ESCAPES.items():
        text = text.replace(character, escape)
    return text


def _data(program: ProgramData) -> dict[str, Any]:
    action = program.action
    return {
        "title": title(program),
        "nObservations": program.n_observations,
        "interaction": program.interaction,
        "inputNames": list(map(str, program.input_names)),
        "outputNames": list(map(str, program.output_names)),
        "action": {
            "kind": action.kind,
            "sizes": action.sizes,
            "low": action.low,
            "high": action.high,
            "start": action.start,
        },
        "conditions": [_condition(condition) for condition in program.conditions],
        "controllers": [_controller(controller) for controller in program.controllers],
    }


def _condition(condition: Condition) -> dict[str, Any]:
    return {
        "cell": condition.cell,
        "weightIh": condition.weight_ih,
        "weightHh": condition.weight_hh,
        "biasIh": condition.bias_ih,
        "biasHh": condition.bias_hh,
        "readout": condition.readout,
        "readoutBias": condition.readout_bias,
    }


def _controller(controller: Controller) -> dict[str, Any]:
    return {"bias": controller.bias, "weights": controller.weights}


def _literal(value: Any, indent: str = "") -> str:
    """JSON with a line for each key and each row of a matrix."""
    deeper = f"{indent}  "
    if isinstance(value, dict):
        lines = [f"{deeper}{escaped_json(key)}: {_literal(item, deeper)}," for key, item in value.items()]
        return "\n".join(["{", *lines, f"{indent}}}"])
    if isinstance(value, (list, tuple)) and any(isinstance(item, (dict, list, tuple)) for item in value):
        return "\n".join(["[", *(f"{deeper}{_literal(item, deeper)}," for item in value), f"{indent}]"])
    return escaped_json(value)
