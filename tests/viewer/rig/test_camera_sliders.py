"""Sliders move exactly one setting of a camera, by exactly as much as they say."""

from __future__ import annotations

import pytest

from rhot.service.configuration import changed
from rhot_capture.settings import CameraSettings
from rhot_viewer.rig.capture_settings import camera_sliders, merged_change

SETTINGS = CameraSettings(exposure_s=0.006, gain=4.0, white_balance=(1.6, 1.8), tolerances={"thumb": 1.0, "index": 1.2})
SLIDERS = camera_sliders(SETTINGS.tolerances)


@pytest.mark.parametrize("slider", SLIDERS, ids=[slider.label for slider in SLIDERS])
def test_what_is_set_is_what_the_slider_shows(slider) -> None:  # type: ignore[no-untyped-def]
    before = SETTINGS.model_dump(mode="json")
    value = slider.low + 0.25 * (slider.high - slider.low)
    after = changed(SETTINGS, slider.change_to(value, before)).model_dump(mode="json")
    assert slider.value_in(after) == pytest.approx(value)
    others = [other for other in SLIDERS if other is not slider]
    assert [other.value_in(after) for other in others] == [other.value_in(before) for other in others]


def test_a_value_outside_its_limits_stands_at_the_end() -> None:
    exposure = SLIDERS[0]
    assert exposure.value_in({"exposure_s": 0.5}) == exposure.high
    for strange in ({}, {"exposure_s": "x"}, {"exposure_s": None}):
        assert exposure.value_in(strange) is None
    assert SLIDERS[2].value_in({"white_balance": []}) is None


def test_changes_are_put_together_marker_by_marker() -> None:
    first = {"gain": 2.0, "tolerances": {"thumb": 1.1}}
    then = {"tolerances": {"index": 0.9}, "exposure_s": 0.001}
    assert merged_change(first, then) == {
        "gain": 2.0,
        "exposure_s": 0.001,
        "tolerances": {"thumb": 1.1, "index": 0.9},
    }
    assert merged_change(first, {"gain": 3.0})["gain"] == 3.0
