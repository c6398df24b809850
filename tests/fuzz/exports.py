"""Valid programs with hostile names and titles, exported to every format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from sb3_progpolicy.programs import ProgramRunner, join_inputs
from tests.programs.formats import (
    check_c,
    check_dot,
    check_javascript,
    check_latex,
    check_picture,
    check_python,
    check_text,
)
from tests.programs.hostile import with_hostile_texts
from tests.programs.strategies import small_program

matplotlib.use("Agg")


def case(rng: np.random.Generator, folder: Path) -> str:
    """Export a program; the Python file is then run, and acts as the program does."""
    program = with_hostile_texts(small_program(rng), rng)
    source = check_python(program)
    check_javascript(program)
    check_c(program)
    check_text(program)
    check_dot(program)
    check_latex(program)
    check_picture(program, draw=rng.random() < 0.1)
    namespace: dict[str, Any] = {"__name__": "exported"}
    exec(compile(source, "exported.py", "exec"), namespace)  # its syntax tree has just been checked
    observation = rng.normal(size=program.n_observations)
    action = namespace["ProgramPolicy"]().act(observation)
    expected = ProgramRunner(program).act(join_inputs(program, observation))[0]
    np.testing.assert_array_equal(np.float32(action), np.float32(expected))
    return f"{program.action.kind} exported"
