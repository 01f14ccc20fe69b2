"""Bumped cameras are reported; well calibrated ones are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from marker_streams import Motion, Seen, pinhole_cameras, watch

from rhot.rig import Rig
from rhot_fusion.core import FusionCore

MakeRig = Callable[..., Rig]


def lowered(seen: Seen, camera: str, by_px: float) -> Seen:
    """Return a frame as a camera sees it that nods by some pixels."""
    if seen.frame.camera != camera:
        return seen
    markers = {name: marker.model_copy(update={"v": marker.v + by_px}) for name, marker in seen.frame.markers.items()}
    return replace(seen, frame=seen.frame.model_copy(update={"markers": markers}))


def problem_after(rig: Rig, seen: list[Seen]) -> str:
    core = FusionCore(rig)
    for one in seen:
        core.feed(one.frame)
    return core.problem


def test_a_bumped_camera_is_reported(make_rig: MakeRig) -> None:
    rig = make_rig(pinhole_cameras(2))
    assert rig.calibrated
    seen = [lowered(one, "camera1", 6.0) for one in watch(rig, Motion(), 12.0)]
    problem = problem_after(rig, seen)
    assert "has moved since the calibration" in problem
    assert "rhot calibrate cameras" in problem


def test_a_well_calibrated_rig_is_not_accused_in_a_minute(make_rig: MakeRig) -> None:
    rig = make_rig(pinhole_cameras(2), rate_hz=30.0)
    core = FusionCore(rig)
    for one in watch(rig, Motion(), 60.0, rate_hz=30.0, noise_px=0.3):
        core.feed(one.frame)
        assert core.problem == ""


def test_swapped_cameras_that_look_ahead_are_reported_while_they_run(make_rig: MakeRig) -> None:
    """Their views meet on their epipolar lines, but behind the cameras."""
    left = pinhole_cameras(1)["camera0"]
    T = np.eye(4)
    T[0, 3] = 0.075
    rig = make_rig({"left": left, "right": left.model_copy(update={"T_rig_camera": T.tolist()})})
    assert rig.calibrated
    assert problem_after(rig, watch(rig, Motion(), 12.0)) == ""
    names = list(rig.config.cameras)
    other = dict(zip(names, reversed(names), strict=True))
    swapped = [
        replace(one, frame=one.frame.model_copy(update={"camera": other[one.frame.camera]}))
        for one in watch(rig, Motion(), 12.0)
    ]
    assert "probably swapped: exchange their plugs or folders" in problem_after(rig, swapped)
