"""Programs: the syntax as plain data, and everything that reads, runs, prints and saves it."""

from sb3_progpolicy.programs import syntax as _syntax
from sb3_progpolicy.programs.explain import ExplainedOutput, Explanation, explain
from sb3_progpolicy.programs.export import (
    export_c,
    export_graphviz,
    export_javascript,
    export_latex,
    export_onnx,
    export_python,
    export_text,
    plot_program,
)
from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs
from sb3_progpolicy.programs.io import ProgramFormatError, save_program
from sb3_progpolicy.programs.program import Program, load_program
from sb3_progpolicy.programs.syntax import (
    Condition,
    Controller,
    Expression,
    IfThenElse,
)
from sb3_progpolicy.programs.validation import check_program
from sb3_progpolicy.spaces import ActionSpec

# Where Program was in release 0.1; files of that release name this place.
_syntax.Program = Program  # type: ignore[attr-defined]

__all__ = [
    "ActionSpec",
    "Condition",
    "Controller",
    "ExplainedOutput",
    "Explanation",
    "Expression",
    "IfThenElse",
    "Program",
    "ProgramFormatError",
    "ProgramRunner",
    "check_program",
    "explain",
    "export_c",
    "export_graphviz",
    "export_javascript",
    "export_latex",
    "export_onnx",
    "export_python",
    "export_text",
    "join_inputs",
    "load_program",
    "plot_program",
    "save_program",
]
