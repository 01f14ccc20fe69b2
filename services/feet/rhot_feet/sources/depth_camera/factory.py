"""Choosing a depth camera by its kind in `rig.toml`; each kind is imported only when it is asked for."""

from __future__ import annotations

from collections.abc import Callable

from rhot.errors import ConfigError
from rhot.plugins import load_simulated
from rhot.rig import Rig
from rhot_feet.frames import DepthSource


def open_depth_source(rig: Rig, now_ns: Callable[[], int]) -> DepthSource:
    """Return the depth camera of a rig, not yet opened.

    Args:
        rig: the loaded rig.
        now_ns: rig time.

    Raises:
        ConfigError: the rig has no feet.
    """
    feet = rig.config.feet
    if feet is None:
        raise ConfigError(f"{rig.path / 'rig.toml'} has no [feet]; add [feet.left] or [feet.right] with marker_id")
    camera = feet.camera
    if camera.source == "realsense":
        from rhot_feet.sources.depth_camera.realsense import RealSenseSource  # noqa: PLC0415

        return RealSenseSource(camera, now_ns)
    if camera.source == "recorded":
        from rhot_feet.sources.depth_camera.recorded import RecordedDepthSource  # noqa: PLC0415
        from rhot_feet.sources.depth_camera.recorded_frames import load_depth_recording  # noqa: PLC0415

        path = rig.resolve(camera.path or "")
        return RecordedDepthSource(lambda: load_depth_recording(path), now_ns, loop=camera.loop)
    source: DepthSource = load_simulated("depth_camera").from_rig(rig, now_ns)
    return source
