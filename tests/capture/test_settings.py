from __future__ import annotations

import pytest

from rhot.errors import ConfigError
from rhot.rig import CameraConfig
from rhot.rig.colors import nominal_colors
from rhot_capture.settings import CameraSettings


@pytest.fixture
def initial() -> CameraSettings:
    return CameraSettings.from_config(
        CameraConfig(source="v4l2"), nominal_colors({"thumb": (30, 120, 60), "ring": (40, 60, 200)})
    )


def test_settings_start_as_the_rig_says(initial: CameraSettings) -> None:
    assert initial.exposure_s == CameraConfig().exposure_s
    assert initial.tolerances == {"thumb": 1.0, "ring": 1.0}


def test_single_tolerances_change(initial: CameraSettings) -> None:
    changed = initial.changed({"tolerances": {"ring": 1.4}}, 60.0)
    assert changed.tolerances == {"thumb": 1.0, "ring": 1.4}
    assert changed.same_optics(initial)


def test_optics_change(initial: CameraSettings) -> None:
    changed = initial.changed({"exposure_s": 0.002, "gain": 2.0}, 60.0)
    assert (changed.exposure_s, changed.gain) == (0.002, 2.0)
    assert not changed.same_optics(initial)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"exposure_s": 0.05}, "longer than a frame at 60 Hz"),
        ({"exposure_s": -1.0}, "exposure_s"),
        ({"gain": float("nan")}, "gain"),
        ({"speed": 1}, "speed"),
        ({"tolerances": {"nose": 1.0}}, "nose.*thumb, ring"),
        ({"tolerances": {"ring": 0.0}}, "tolerances.ring"),
        ({"tolerances": 3}, "tolerances"),
        ({"white_balance": (0.0, 1.0)}, "white_balance"),
    ],
)
def test_bad_values_are_refused_and_nothing_changes(
    initial: CameraSettings, changes: dict[str, object], words: str
) -> None:
    before = initial.model_dump()
    with pytest.raises(ConfigError, match=words):
        initial.changed(changes, 60.0)
    assert initial.model_dump() == before
