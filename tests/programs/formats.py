"""Checks of exported programs: a hostile program's file holds what a plain program's holds, apart from the names."""

from __future__ import annotations

import ast
import io
import re
import tokenize
import warnings

import matplotlib.pyplot as plt

from sb3_progpolicy.programs import (
    Program,
    export_c,
    export_graphviz,
    export_javascript,
    export_latex,
    export_python,
    export_text,
    plot_program,
)
from tests.programs.hostile import with_plain_texts


def plain_tree(program: Program) -> ast.Module:
    """The syntax tree of the program with plain texts."""
    return ast.parse(export_python(with_plain_texts(program)))


def check_python(program: Program, expected: ast.Module | None = None) -> bytes:
    """The tree that Python makes of the file's bytes is that of a plain program, names apart; return the bytes."""
    source = export_python(program).encode()
    assert source.isascii()
    assert tokenize.detect_encoding(io.BytesIO(source).readline)[0] == "utf-8"
    names = (*program.input_names, *program.output_names)
    variables: dict[str, str] = {}  # from a plain name to the name in the file
    fixed: set[str] = set()
    expected = expected or plain_tree(program)
    for node, plain in zip(ast.walk(ast.parse(source)), ast.walk(expected), strict=True):
        assert type(node) is type(plain)
        for field, value in ast.iter_fields(plain):
            given = getattr(node, field)
            if isinstance(value, str) and value.startswith("plain_"):
                if isinstance(node, ast.Constant):
                    assert given == names[int(value.removeprefix("plain_"))]
                else:
                    assert variables.setdefault(value, given) == given
            elif isinstance(value, list):
                assert len(given) == len(value)
            elif not isinstance(value, ast.AST):
                assert given == value
                if field == "id":
                    fixed.add(given)
    assert len({*variables.values(), *fixed}) == len(variables) + len(fixed)
    return source


def check_javascript(program: Program) -> str:
    """Outside of its string literals the source is that of a plain program, and in a page it stays one script."""
    source, plain = (export_javascript(p) for p in (program, with_plain_texts(program)))
    literal = re.compile(r'"(?:[^"\\]|\\.)*"')
    assert source.isascii()
    assert literal.sub('""', source) == literal.sub('""', plain)
    data = source.partition("const PROGRAM = ")[2].partition("\n};")[0]
    assert not set("<>&") & set(data)
    return source


def check_c(program: Program) -> None:
    """The code, without comments and with the functions' prefix made plain, is that of a plain program."""
    assert c_code(export_c(program)) == c_code(export_c(with_plain_texts(program)))


def c_code(source: str) -> str:
    """What a C compiler reads of an exported header."""
    assert source.isascii()
    assert "\\" not in source
    assert "??" not in source
    comments = re.findall(r"/\*.*?\*/", source, flags=re.DOTALL)
    assert not any("/*" in comment[2:] for comment in comments)
    bare = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    match = re.search(r"(\w+)_state;", bare)
    assert match
    assert re.fullmatch(r"[a-z][a-z0-9_]{0,47}", match[1])
    bare = re.sub(rf"\b{match[1]}_(state|reset|act)\b", r"plain_\1", bare)
    return bare.replace(f"{match[1].upper()}_PROGRAM_H", "PLAIN_PROGRAM_H")


def check_text(program: Program) -> None:
    """The lines that are not indented, up to their first sum, are those of a plain program."""
    lines, plain = (export_text(p).split("\n")[1:] for p in (program, with_plain_texts(program)))
    assert all(line.isprintable() for line in lines)
    # A condition stands in the line of its branch where it fits, which depends on the names, or in a line of its own.
    heads, expected = (
        [
            re.split(r" = | >= ", line)[0]
            for line in part
            if line.strip() and line[0] != " " and not re.match(r"B\d+ = ", line)
        ]
        for part in (lines, plain)
    )
    assert heads == expected


def check_dot(program: Program) -> None:
    """The tokens, by the DOT grammar, are those of a plain program."""
    tokens, plain = (_dot_tokens(export_graphviz(p)) for p in (program, with_plain_texts(program)))
    assert tokens == plain


def _dot_tokens(source: str) -> list[str]:
    token = re.compile(r'\s*("(?:[^"\\]|\\.)*"|->|[\w.]+|[\[\]{}=;,])')
    position, tokens = 0, []
    while match := token.match(source, position):
        text, position = match[1], match.end()
        assert text[0] != '"' or not re.search(r"\\[^\\\"nl]|&(?!amp;)", text.replace("\\\\", ""))
        tokens.append('""' if text[0] == '"' else text)
    assert source[position:].strip() == ""
    return tokens


def check_latex(program: Program) -> None:
    """Outside of its names the source is that of a plain program; a name holds escaped characters only."""
    source, plain = export_latex(program), export_latex(with_plain_texts(program))
    command = r"\\text(?:backslash|asciitilde|asciicircum|less|greater|bar)\{\}|\\symbol\{\d+\}|\\[#$%&_{}]"
    name = re.compile(rf"\\text\{{(?:{command}|[^\\{{}}#$%&_~^<>|\"`\n])*\}}")
    assert name.sub("", source) == name.sub("", plain)


def check_picture(program: Program, draw: bool = True) -> None:
    """Every text is drawn as it is, by matplotlib itself."""
    axes = plot_program(program)
    try:
        assert not any(text.get_parse_math() or text.get_usetex() for text in axes.texts if text.get_text())
        if draw:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Glyph .* missing")
                axes.figure.canvas.draw()
    finally:
        plt.close(axes.figure)
