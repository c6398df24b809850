"""How numbers are printed: whole ones are exact, and look so."""

import matplotlib

from sb3_progpolicy.programs import export_graphviz, export_latex, export_text, plot_program
from tests.programs.test_export import program_by_hand

matplotlib.use("Agg")


def test_whole_numbers_keep_their_form_beside_others_and_what_only_rounds_to_one_has_a_point():
    for weight, printed in ((-0.5, "0.50*"), (-2.999, "3.00*"), (-3.0, "3*"), (-1.001, "1.00*"), (-1.0, "")):
        text = export_text(program_by_hand(weight))
        assert f"    left  = -5*[previous left] - {printed}angle[0]\n" in text
        assert "    right = -1 + 3*angle[0]\n" in text
    assert "0 & -0.50 & 0 & 0 & -5 & 0" in export_latex(program_by_hand(-0.5))
    assert "left = 0  -5 previous left  -0.50 angle[0]\\l" in export_graphviz(program_by_hand(-0.5))
    axes = plot_program(program_by_hand(-0.5), decimals=2)
    texts = {text.get_text() for text in axes.texts}
    matplotlib.pyplot.close(axes.figure)
    assert {"\N{MINUS SIGN}0.50 angle[0]", "\N{MINUS SIGN}5 previous left", "+3 angle[0]"} <= texts
