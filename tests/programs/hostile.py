"""Valid programs whose names and titles aim at the weak places of every output format."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sb3_progpolicy.programs import Program
from sb3_progpolicy.programs.validation import MAX_NAME_LENGTH

_PYTHON = (
    '"', "'", '"""', "'''", "\\", r"\\", r"\"", r"\N{LATIN SMALL LETTER A}", r"\N", "{0}", "%s", "%(x)s", "#",
    "# type: ignore", "*(print('ran') or ()),#", "__import__('os').system('true')", "import os", "lambda: 0", ":=",
    "; ", "):", "self", "scores", "reward", "max", "eval", "None", "class", "inf", "nan", "1e999",
    "h1_1", "new_h1_1", "p_0", "action_0", "x_", "_v2", "_", "a", "9", " ",
)  # fmt: skip
_ENCODINGS = (
    "# -*- coding: utf-7 -*-", "coding=utf_16", "+AAo-", r"\n", r"\x0a", r"\12", r"\u000a", r"\U0000000a", r"\ud800",
)  # fmt: skip
_MARKUP = (
    "$", "$x$", r"$\frac", "^", "^^5c", "~", "&", "%", r"%\\", "{", "}", "|", "`", "``", ",,", "--", "?`",
    r"\input{/etc/passwd}", r"\end{array}", r"\)", r"\]", r"\write18{true}", r"\message{ran}", r"\def\text",
    r"\end{document}",
    "&amp;", "&#10;", "<b>", "</table>>", "<!--", "-->", "*/", "]]>", r"\G", r"\l", "];", "];}", "->", "[label=x]",
    "[", "]", " = ", "] - 5.00*[",
)  # fmt: skip
# The first eleven cannot be printed, so no valid name holds them.
_UNICODE = (
    "\t", "\n", "\r", "\x00", "\x1b[2J", "\x85", "\u2028", "\u202e", "\u2066", "\ud800", "\ufeff",
    "é", "Ð", "→", "中", "א", "😀", "\ufb01", "\uff45\uff56\uff41\uff4c", "\u0301", "\u3164",
)  # fmt: skip
PIECES = (*_PYTHON, *_ENCODINGS, *_MARKUP, *_UNICODE)
TITLES = (
    "Hanoi-v0 coding:raw_unicode_escape", "Hanoi-v0 coding:unicode_escape", "X coding=utf-7", "-*- coding: utf_16 -*-",
    "vim: set fileencoding=rot13 :", "a\nimport os", "\u2028import os", "../../x", "", 3, None, ["Hanoi-v0"],
)  # fmt: skip


def hostile_name(rng: np.random.Generator) -> str:
    """One piece many times over, a run that is slow to match, or some pieces joined; a valid name in the end."""
    kind = rng.integers(10)
    if kind == 0:
        text = str(rng.choice(PIECES)) * int(rng.integers(1, MAX_NAME_LENGTH))
    elif kind == 1:
        run = "0_"[rng.integers(2)] * int(rng.integers(1, 60))
        text = ("b", "h1_", "_")[rng.integers(3)] + run + "x]"[rng.integers(2)]
    else:
        text = "".join(rng.choice(PIECES, size=rng.integers(1, 7)))
    return "".join(filter(str.isprintable, text))[:MAX_NAME_LENGTH] or "x"


def with_hostile_texts(program: Program, rng: np.random.Generator) -> Program:
    """The same program with a hostile title and hostile names, which now and then are all equal."""
    n_inputs, n_outputs = program.n_inputs, program.action.n_outputs
    equal = rng.random() < 0.1
    names = [hostile_name(rng)] * (n_inputs + n_outputs) if equal else []
    names = names or [hostile_name(rng) for _ in range(n_inputs + n_outputs)]
    title = TITLES[rng.integers(len(TITLES))] if rng.random() < 0.5 else hostile_name(rng)
    return _with_texts(program, names, title)


def with_plain_texts(program: Program) -> Program:
    """The same program with a title and names that need no escape in any format."""
    return _with_texts(program, [f"plain_{k}" for k in range(program.n_inputs + program.action.n_outputs)], "Plain-v0")


def _with_texts(program: Program, names: list[str], title: object) -> Program:
    inputs, outputs = names[: program.n_inputs], names[program.n_inputs :]
    metadata = {**program.metadata, "env": title}
    return replace(program, input_names=tuple(inputs), output_names=tuple(outputs), metadata=metadata)
