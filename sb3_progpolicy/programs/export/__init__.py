"""Programs as text, pictures, formulas, source code and ONNX models; one module for each format."""

from sb3_progpolicy.programs.export.c import export_c
from sb3_progpolicy.programs.export.graphviz import export_graphviz
from sb3_progpolicy.programs.export.javascript import export_javascript
from sb3_progpolicy.programs.export.latex import export_latex
from sb3_progpolicy.programs.export.onnx import export_onnx
from sb3_progpolicy.programs.export.plot import plot_program
from sb3_progpolicy.programs.export.python import export_python
from sb3_progpolicy.programs.export.text import export_text

__all__ = [
    "export_c",
    "export_graphviz",
    "export_javascript",
    "export_latex",
    "export_onnx",
    "export_python",
    "export_text",
    "plot_program",
]
