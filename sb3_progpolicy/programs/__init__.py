"""Programs: the syntax as plain data, and everything that reads, runs, prints and saves it."""

from sb3_progpolicy.programs.export import (
    export_graphviz,
    export_latex,
    export_python,
    export_text,
    plot_program,
)
from sb3_progpolicy.programs.interpreter import ProgramRunner, join_inputs
from sb3_progpolicy.programs.io import ProgramFormatError, load_program, save_program
from sb3_progpolicy.programs.syntax import (
    ActionSpec,
    Condition,
    Controller,
    Expression,
    IfThenElse,
    Program,
)
from sb3_progpolicy.programs.validation import check_program

__all__ = [
    "ActionSpec",
    "Condition",
    "Controller",
    "Expression",
    "IfThenElse",
    "Program",
    "ProgramFormatError",
    "ProgramRunner",
    "check_program",
    "export_graphviz",
    "export_latex",
    "export_python",
    "export_text",
    "join_inputs",
    "load_program",
    "plot_program",
    "save_program",
]
