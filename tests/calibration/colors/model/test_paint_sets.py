"""Sets of paints that differ most."""

from __future__ import annotations

import itertools

import pytest
from click.testing import CliRunner

from rhot_tools.paints import as_seen, best_set, described, paints

SOME = ("cadmium yellow", "cadmium red", "magenta", "cobalt blue", "turquoise", "violet", "phthalo green")


def test_no_other_set_of_four_differs_more() -> None:
    seen = {name: rgb for name, rgb in as_seen().items() if name in SOME}
    best = best_set(4, seen)
    every = [described(chosen, seen).distance for chosen in itertools.combinations(SOME, 4)]
    assert best.distance == pytest.approx(max(every))


def test_seven_is_where_more_paints_stop_being_told_apart() -> None:
    # What the documentation says: one hand and the second hand's patch, but not two hands.
    for saturation in (0.3, 0.45):
        distance = [best_set(count, as_seen(saturation)).distance for count in (6, 7, 8, 12)]
        assert distance[1] > 0.85 * distance[0]
        assert distance[2] < 0.65 * distance[1]
        assert distance[3] < 0.45 * distance[1]


def test_given_paints_are_in_the_set() -> None:
    assert {"violet", "magenta"} <= set(best_set(6, as_seen(), ("violet", "magenta")).paints)
    with pytest.raises(ValueError, match="30 paints"):
        best_set(30, as_seen())


def test_command_prints_the_sets() -> None:
    done = CliRunner(env={"COLUMNS": "200"}).invoke(paints, ["--saturation", "0.45", "--have", "lemon yellow"])
    assert done.exit_code == 0, done.output
    assert done.output.count("lemon yellow") >= 8
