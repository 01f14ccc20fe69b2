"""Steps as text: what is said is shown, and markup in it is not obeyed."""

from __future__ import annotations

from rhot.calibration_step import Figures, Remark, StepView
from rhot_viewer.panels.calibrate import bar_html, path_html, remarks_html, tables_html

NASTY = "<script>&"


def test_the_path_shows_where_each_step_stands() -> None:
    html = path_html({"One": StepView("all good", True), "Two": StepView(NASTY, False)}, "Two")
    assert html.count("✓") == 1
    assert "<b>Two</b>" in html
    assert NASTY not in html
    assert "&lt;script&gt;&amp;" in html


def test_a_problem_comes_first() -> None:
    html = remarks_html("it broke", [Remark("next " + NASTY)])
    assert html.index("it broke") < html.index("next")
    assert NASTY not in html
    assert remarks_html("", ()) == ""


def test_tables_hold_every_cell() -> None:
    html = tables_html([Figures("title", ("a", "b"), (("1", NASTY), ("3", "4")))])
    assert html.count("<td") == 4
    assert html.count("<th") == 2
    assert NASTY not in html


def test_a_bar_stays_within_its_bounds() -> None:
    assert "width:100%" in bar_html(1.7)
    assert "width:0%" in bar_html(-1.0)
