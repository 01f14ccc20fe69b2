"""A patch that comes out from behind the other hand: another part of it is hidden from either camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from marker_streams import EPOCH_NS, MARKERS, Motion, Seen, pinhole_cameras, watch

from rhot.messages import PointSet
from rhot.rig import Rig
from rhot_fusion.core import FusionCore

MakeRig = Callable[..., Rig]

STILL = Motion(amplitude_m=(0.0, 0.0, 0.0))
WHOLE_PX, TIP_PX, NEAR_TIP_PX = 520.0, 100.0, 300.0
WIDTH_PX = 26.0


def behind(seen: list[Seen], visible: dict[str, float], from_s: float, to_s: float) -> list[Seen]:
    """Return frames with areas, in which only a share of the patch, its left part, is visible from a moment on.

    For half a second before that it is hidden altogether.
    """
    frames = []
    for one in seen:
        markers = {name: each.model_copy(update={"area": TIP_PX}) for name, each in one.frame.markers.items()}
        base = markers["base"].model_copy(update={"area": WHOLE_PX})
        share = visible[one.frame.camera]
        left = {"u": base.u - 0.5 * (1.0 - share) * WIDTH_PX, "area": share * WHOLE_PX}
        t_s = one.arrival_s
        markers["base"] = base if t_s < from_s - 0.5 or t_s > to_s else base.model_copy(update=left)
        if from_s - 0.5 <= t_s < from_s:
            del markers["base"]
        frames.append(replace(one, frame=one.frame.model_copy(update={"markers": markers})))
    return frames


@pytest.mark.parametrize("visible", [{"camera0": 0.34, "camera1": 0.12}, {"camera0": 0.6, "camera1": 0.3}])
def test_what_either_camera_sees_of_it_does_not_become_depth(make_rig: MakeRig, visible: dict[str, float]) -> None:
    rig = make_rig(pinhole_cameras(2), fusion='method = "filter"\nhold_s = 0.2')
    truth = STILL.at(0.0)[0, MARKERS.index("base")]
    off_mm = []
    core = FusionCore(rig)
    for one in behind(watch(rig, STILL, 1.6), visible, 1.2, 2.0):
        for _, points in core.feed(one.frame):
            assert isinstance(points, PointSet)
            base = points.points.get("base")
            if points.t_ns > EPOCH_NS + 1_200_000_000 and base is not None and base.state == "measured":
                off_mm.append(1e3 * (np.array(base.position) - truth)[2])
    # The middles of what they see are 3 or 4 px further apart than those of the whole: 50 mm of depth.
    assert np.abs(off_mm).max(initial=0.0) < 20.0


def test_a_tip_of_which_little_is_left_is_less_certain_live_and_looked_back_at(make_rig: MakeRig) -> None:
    """Both cameras lose most of its paint alike, so they agree on where it is; its middle may be elsewhere."""
    rig = make_rig(pinhole_cameras(2), fusion='method = "filter"')
    core = FusionCore(rig, record=True)
    live = []
    for one in watch(rig, STILL, 2.0):
        share = 0.1 if one.arrival_s > 1.0 else 1.0
        areas = {"index": share * NEAR_TIP_PX, "base": WHOLE_PX}
        seen = one.frame.markers.items()
        markers = {name: each.model_copy(update={"area": areas.get(name, NEAR_TIP_PX)}) for name, each in seen}
        live += [points for _, points in core.feed(one.frame.model_copy(update={"markers": markers}))]
    for every in (live, core.smoothed()):
        before, after = [], []
        for points in every:
            assert isinstance(points, PointSet)
            t_s = (points.t_ns - EPOCH_NS) * 1e-9
            if 0.5 < t_s < 0.9:
                before.append(points.points["index"])
            elif 1.2 < t_s < 1.9:
                after.append(points.points["index"])
        assert {point.state for point in before} == {"measured"}
        assert {point.state for point in after} == {"predicted"}
        assert min(point.sigma for point in after) > 0.008 > max(point.sigma for point in before)
