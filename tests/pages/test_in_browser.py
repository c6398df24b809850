"""Pages in headless Chromium: no error, no request, and keys and clicks do what they say."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sb3_progpolicy import load_pretrained, pretrained_names
from sb3_progpolicy.pages import export_html
from sb3_progpolicy.programs import load_program
from tests.analysis import maze
from tests.handwritten.hiking import egocentric_program, map_program
from tests.pages.chromium import chromium
from tests.programs.hostile import with_hostile_texts
from tests.programs.strategies import build_program, hanoi_program, small_program
from tests.programs.test_grids import OTHER
from tests.programs.test_grids import program as on_a_grid
from tests.programs.test_min import grip

SMALL_STACKING = Path(__file__).parents[2] / "benchmarks" / "results" / "simplified" / "Stacking-v0.json"
PAGES = {
    **{name: lambda name=name: load_pretrained(name) for name in pretrained_names()},
    "Hiking-v1": map_program,
    "HikingEgo-v0": egocentric_program,
    "small Stacking-v0": lambda: load_program(SMALL_STACKING),
    "table": lambda: on_a_grid(OTHER, -3.0, 1.5),
    "switch": lambda: maze.program(maze.SWITCH),
    "recurrent": lambda: hanoi_program(3, "gru"),
    "min": lambda: hanoi_program(3, "min"),
    "unknown": lambda: build_program(5, ["lstm", "affine"], "multi_discrete", True),
}
T, LAST = "page.t", "page.frames.length - 1"
OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
UNNAMED = """[...document.querySelectorAll("button, input, [role=button], svg[role]")]
    .filter((element) => !element.getAttribute("aria-label") && !element.textContent.trim()).length"""
#: Elements whose text is cut off or which stick out of the page.
CLIPPED = """[...document.querySelectorAll(".name, .number, .facts li, button, .status, dt, dd")]
    .filter((element) => element.offsetParent && element.scrollWidth > element.clientWidth + 1
        && getComputedStyle(element).display !== "inline").map((element) => element.textContent)"""


@pytest.fixture(scope="module")
def tab():
    with chromium() as tab:
        yield tab


@pytest.fixture
def visit(tab, tmp_path):
    def visit(program, fragment="", **look):
        path = tmp_path / "page.html"
        export_html(program, path)
        seconds = tab.open(f"{path.as_uri()}#{fragment}", **look)
        assert seconds < 5  # a tenth of a second on an idle machine
        return path

    return visit


@pytest.mark.parametrize("look", [{}, {"dark": True}, {"width": 390, "height": 844}], ids=["wide", "dark", "narrow"])
@pytest.mark.parametrize("name", PAGES)
def test_a_page_opens_without_an_error_or_a_request_and_fits_the_screen(name, look, visit, tab):
    path = visit(PAGES[name](), **look)
    tab.press("End")
    tab.press("Home")
    tab.press("ArrowRight")
    assert tab.errors == []
    assert [url.partition("#")[0] for url in tab.requests] == [path.as_uri()]
    assert tab.evaluate(OVERFLOW) <= 0
    assert tab.evaluate(UNNAMED) == 0
    assert tab.evaluate(CLIPPED) == []
    background = tab.evaluate("getComputedStyle(document.body).backgroundColor")
    levels = [int(part) for part in background.strip("rgb()").split(",")]
    assert (max(levels) < 60) == bool(look.get("dark"))


@pytest.mark.parametrize(
    "place", ["episode=x", "episode=-1", "episode=1.5", "episode=", "step=x", "step=-3", "step=1.5"]
)
def test_an_odd_address_is_as_if_it_were_not_there(place, visit, tab):
    program = load_pretrained("Hanoi-v0")
    visit(program)
    usual = tab.evaluate("[page.index, page.t]")
    visit(program, place)
    assert tab.errors == []
    assert tab.evaluate("[page.index, page.t]") == usual
    visit(program, "episode=99&step=9999")
    assert tab.evaluate(f"page.index === page.data.episodes.length - 1 && {T} === {LAST}")


def test_keys_step_forward_back_to_the_ends_and_play(visit, tab):
    visit(load_pretrained("Hanoi-v0"))
    last = tab.evaluate(LAST)
    seen = []
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft", "End", "ArrowRight", "ArrowLeft", "Home", "ArrowLeft"):
        tab.press(key)
        seen.append(tab.evaluate(T))
    assert seen == [1, 2, 1, last, last, last - 1, 0, 0]
    tab.press(" ")
    tab.evaluate("new Promise((ready) => setTimeout(ready, 2500))")
    assert tab.evaluate(T) > 1
    tab.press(" ")
    stopped = tab.evaluate(T)
    tab.evaluate("new Promise((ready) => setTimeout(ready, 1500))")
    assert tab.evaluate(T) == stopped


def test_buttons_and_sliders_do_the_same(visit, tab):
    visit(load_pretrained("Stacking-v0"))
    tab.click('[aria-label="Step forward"]')
    tab.click('[aria-label="Step forward"]')
    tab.click('[aria-label="Step back"]')
    assert tab.evaluate(T) == 1
    tab.evaluate("""(() => { const slider = document.querySelector('[aria-label="Variation"]');
        slider.value = 7; slider.dispatchEvent(new Event("input")); })()""")
    assert "8 plates" in tab.evaluate("document.querySelector('.variation-label').textContent")
    assert "unseen" in tab.evaluate("document.querySelector('.variation-label').textContent")
    tab.evaluate("""(() => { const slider = document.querySelector('[aria-label="Step"]');
        slider.value = 9; slider.dispatchEvent(new Event("input")); })()""")
    assert tab.evaluate(T) == 9
    assert tab.evaluate("document.querySelector('.status').textContent").startswith("Step 9 of ")


def test_every_term_is_accounted_for(visit, tab):
    program = load_pretrained("Stacking-v0")
    visit(program, "step=7")
    tab.click('[data-thing="1"]')
    toggle = "document.querySelector('#reasons button.quiet')"
    if tab.evaluate(f"{toggle} !== null"):
        tab.click("#reasons button.quiet")
    numbers = "[...document.querySelectorAll('.reason:not(.total) .number')].map((cell) => cell.textContent)"
    values = [float(text.replace("\N{MINUS SIGN}", "-")) for text in tab.evaluate(numbers)]
    assert [abs(value) for value in values] == sorted(map(abs, values), reverse=True)
    total = tab.evaluate("page.frames[7].outputs[0][1]")
    assert sum(values) == pytest.approx(total, abs=0.005 * len(values) + 0.005)
    silent = tab.evaluate("document.querySelector('#reasons .note').textContent")
    (controller,) = program.controllers
    # By the table's symmetry an input may have no weight; then it is no term.
    n_terms = sum(weight != 0 for weight in (*controller.weights[1], controller.bias[1]))
    assert len(values) + int(silent.split()[0]) == n_terms >= program.n_inputs


def test_the_terms_of_a_condition_are_shown_as_those_of_a_score_are(visit, tab):
    program = hanoi_program(3, "gru")
    visit(program, "step=4")
    tab.click('[data-thing="B2"]')
    names = tab.evaluate("[...document.querySelectorAll('.reason .name')].map((name) => name.firstChild.textContent)")
    assert {name for name in names if name.startswith("memory")} == {
        f"memory h{unit + 1}" for unit, weight in enumerate(program.conditions[1].readout) if weight
    }
    values = tab.evaluate("[...document.querySelectorAll('.reason .number')].map((cell) => cell.textContent)")
    *terms, total = (float(text.replace("\N{MINUS SIGN}", "-")) for text in values)
    assert sum(terms) == pytest.approx(total, abs=0.03)
    assert total == pytest.approx(tab.evaluate("page.frames[4].conditionValues[1]"), abs=0.006)
    tab.click('[data-thing="B2"]')
    assert "move" in tab.evaluate("document.querySelector('#reasons h3 em').textContent")


def test_a_disc_is_moved_by_two_clicks_and_the_program_starts_from_there(visit, tab):
    visit(load_pretrained("Hanoi-v0"))
    tab.click('[data-key="peg0"]')
    assert tab.evaluate("page.selected") == 0
    tab.click('[data-key="peg1"]')
    assert tab.evaluate("page.frames[0].state.discs") == [1, 0, 0, 0]
    assert "Your state" in tab.evaluate("document.querySelector('.variation-label').textContent")
    tab.click('[data-key="peg0"]')
    tab.click('[data-key="peg1"]')
    assert tab.evaluate("page.frames[0].state.discs") == [1, 0, 0, 0]
    assert "larger disc" in tab.evaluate("document.getElementById('announcer').textContent")
    tab.press("End")
    assert tab.evaluate("page.frames[page.t].success") is True
    tab.click(".variation-label button")
    assert tab.evaluate("page.frames[0].state.discs") == [0, 0, 0, 0]
    assert tab.errors == []


def test_pegs_are_pressed_by_keyboard_too_and_keep_the_focus(visit, tab):
    visit(load_pretrained("Hanoi-v0"))
    tab.evaluate("document.querySelector('[data-key=peg0]').focus()")
    tab.press("Enter")
    assert tab.evaluate("[page.selected, document.activeElement.getAttribute('data-key')]") == [0, "peg0"]
    tab.evaluate("document.querySelector('[data-key=peg2]').focus()")
    tab.press(" ")
    assert tab.evaluate("page.frames[0].state.discs") == [2, 0, 0, 0]
    assert tab.evaluate("page.timer") is None


def test_gripper_and_plates_are_placed_by_clicks(visit, tab):
    visit(load_pretrained("Stacking-v0"))
    state = tab.evaluate("page.frames[0].state")
    taken = [5 * row + column for row, column in state["plates"]]
    free = next(cell for cell in range(25) if cell not in taken)
    tab.click(f'[data-key="cell{free}"]')
    assert tab.evaluate("page.frames[0].state.gripper") == list(divmod(free, 5))
    tab.click(f'[data-key="cell{taken[1]}"]')
    tab.click(f'[data-key="cell{free}"]')
    assert tab.evaluate("page.frames[0].state.plates")[1] == list(divmod(free, 5))
    tab.click(f'[data-key="cell{taken[0]}"]')
    tab.click(f'[data-key="cell{taken[0]}"]')
    assert tab.evaluate("page.frames[0].state.gripper") == list(divmod(taken[0], 5))
    assert tab.errors == []


@pytest.mark.parametrize("name", ["Hiking-v1", "HikingEgo-v0"])
def test_hiker_and_stars_are_placed_by_clicks(name, visit, tab):
    visit(PAGES[name]())
    state = tab.evaluate("page.frames[0].state")
    row, column = state["hiker"]
    index = tab.evaluate("""[...document.querySelectorAll(".path")].map((cell) => cell.dataset.key).find((key) => {
        const cell = Number(key.slice(4)), { hiker, stars } = page.frames[0].state;
        return ![hiker, ...stars].some(([row, column]) => 10 * row + column === cell);
    })""")
    tab.click(f'[data-key="{index}"]')
    place = list(divmod(int(index.removeprefix("cell")), 10))
    assert place in tab.evaluate("page.frames[0].state.stars")
    tab.click(f'[data-key="cell{10 * row + column}"]')
    tab.click(f'[data-key="{index}"]')
    after = tab.evaluate("page.frames[0].state")
    assert after["hiker"] == place
    assert place not in after["stars"]
    assert tab.errors == []


def test_inputs_of_an_unknown_environment_are_set_by_hand_and_the_program_remembers(visit, tab):
    program = build_program(6, ["gru"], "discrete", False)
    visit(program)
    set_input = """(() => { const input = document.querySelector('[data-key="number0"]');
        input.focus(); input.value = VALUE; input.dispatchEvent(new Event("input")); })()"""
    tab.evaluate(set_input.replace("VALUE", "0.75"))
    assert tab.evaluate("page.frames[0].inputs[0]") == 0.75
    first = tab.evaluate("page.frames[0].memory")
    tab.click('[aria-label="Step forward"]')
    assert tab.evaluate("page.frames.length") == 2
    assert tab.evaluate("page.frames[1].memory") != first
    tab.click('[aria-label="First step"]')
    tab.evaluate(set_input.replace("VALUE", "-0.5"))
    assert tab.evaluate("[page.frames.length, page.frames[0].inputs[0]]") == [1, -0.5]
    assert tab.errors == []


def test_a_page_of_mostly_zero_weights_shows_the_others_only(visit, tab):
    program = load_pretrained("Hanoi-v0")
    weights = np.array(program.body.weights)
    weights[np.abs(weights) < 1.5] = 0
    body = replace(program.body, weights=tuple(map(tuple, weights.tolist())), bias=(0.0,) * 6)
    visit(replace(program, body=body))
    assert tab.evaluate("document.querySelectorAll('.leaf .term').length") == np.count_nonzero(weights)
    assert tab.evaluate("document.querySelector('#tree button')") is None


SHOWN = "[...document.querySelectorAll('SELECTOR')].map((element) => element.textContent.replace(/\\s+/g, ' ').trim())"


def test_weights_on_a_grid_are_shown_as_a_function_or_as_a_table(visit, tab):
    visit(load_program(SMALL_STACKING))
    assert tab.evaluate(SHOWN.replace("SELECTOR", ".leaf dd"))[:2] == [
        "table \u00d7 (3 \u2212 2 row) + 4 gripper[row]",
        "table \u00d7 (\u22125 + 2 column) \u2212 4 gripper[column]",
    ]
    assert tab.evaluate("document.querySelector('#tree button')") is None, "nothing is left out"
    visit(on_a_grid(OTHER, -3.0, 1.5))
    assert tab.evaluate(SHOWN.replace("SELECTOR", ".leaf td")) == ["1", "2", "3", "1", "2", "\u221240"]
    assert tab.evaluate(SHOWN.replace("SELECTOR", ".leaf caption")) == ["table \u00d7"]


def test_a_switch_is_shown_as_what_turns_it_on_and_off(visit, tab):
    program = maze.program(maze.SWITCH)
    visit(program)
    assert tab.evaluate(SHOWN.replace("SELECTOR", ".test .sum")) == [
        "B1 = 0.50 while on, \u22120.50 while off",
        "on when \u22121 + 1 cue_right \u2265 0",
        "off when \u22121 + 1 cue_left \u2265 0",
    ]


def test_a_min_is_shown_with_all_its_sums_and_the_least_is_explained(visit, tab):
    visit(grip())
    assert tab.evaluate(SHOWN.replace("SELECTOR", ".test .sum .sum")) == [
        "0.50 \u2212 1 distance",
        "1 \u2212 2 height",
    ]
    visit(hanoi_program(3, "min"))
    tab.evaluate("document.querySelector('[data-thing=B1]').click()")
    heading = tab.evaluate("document.querySelector('h3 em').textContent")
    assert re.fullmatch(r"B1, its least sum \([123] of 3\)", heading)
    total = tab.evaluate("document.querySelector('.reason.total .number').textContent")
    assert total == tab.evaluate("document.querySelector('[data-thing=B1] .number').textContent")


def test_hostile_names_are_shown_as_they_are(visit, tab):
    rng = np.random.default_rng(1)
    for _ in range(5):
        program = with_hostile_texts(small_program(rng), rng)
        names = ('<img src=x onerror="document.title=1">', "</script ><script>document.title=2</script >")
        program = replace(program, input_names=(*names, *program.input_names[2:])[: program.n_inputs])
        visit(program)
        assert tab.errors == []
        assert tab.evaluate("document.title") not in ("1", "2")
        shown = tab.evaluate("[...document.querySelectorAll('#inputs th')].map((cell) => cell.textContent)")
        assert shown[: len(names)] == list(program.input_names[: len(names)])
