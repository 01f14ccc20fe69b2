"""Whether a run judged the tracker or the machine that drew for it."""

from __future__ import annotations

from rhot_sim.comparison.figures import machine_verdict

REPORT = {"cameras": {"left": {}, "right": {}}, "camera_rate_hz": 60.0, "rate_hz": 118.0}


def test_a_machine_that_draws_all_pictures_kept_up() -> None:
    assert machine_verdict(REPORT) == (True, "This machine kept up (118 of 120 poses a second).")


def test_a_slow_machine_is_told_apart_from_a_bad_tracker() -> None:
    kept_up, why = machine_verdict({**REPORT, "pictures_hz": 40.0})
    assert not kept_up
    assert "40 of 120 pictures" in why
    assert "--rate 30" in why


def test_nothing_at_all_is_not_keeping_up() -> None:
    kept_up, why = machine_verdict({"camera_rate_hz": 60.0})
    assert not kept_up
    assert why.startswith("Nothing was tracked (0 of 60 poses a second)")
