"""The 2021 thesis's whole foot tracker behind the calls of `rhot_feet.foot_core.FootCore`, for comparison."""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.aruco_dictionary import R_FOOT_MARKER, marker_dictionary
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import HeadPose, Side
from rhot.rig.feet_config import FeetConfig
from rhot_bench.thesis.feet import ThesisFeet
from rhot_bench.thesis.foot_filter import ThesisFilter
from rhot_feet.filter.model import FootFilterSettings, FootState
from rhot_feet.frames import DepthFrame
from rhot_feet.head_track import HeadTrack
from rhot_feet.imu.samples import ImuSamples

_UNUSED: Final = np.eye(3)
"""The thesis's filter has noise values of its own."""


class ThesisTracker:
    """Its camera stages, and its filter for each foot; the camera is where ours is, at the picture's own time."""

    def __init__(self, config: FeetConfig) -> None:
        ids: dict[Side, int] = {side: foot.marker_id for side, foot in config.feet.items()}
        settings = FootFilterSettings(up=config.up)
        self._T_head_camera = config.camera.T_head_camera
        self._heads = HeadTrack()
        self._feet = ThesisFeet(marker_dictionary(config.dictionary), ids, config.marker_size_m)
        self._filters = {side: ThesisFilter(settings) for side in ids}

    def add_head_pose(self, pose: HeadPose) -> None:
        """Add a pose of the head."""
        self._heads.add(pose)

    def add_imu_samples(self, side: Side, samples: ImuSamples) -> None:
        """Add inertial samples of a foot."""
        self._filters[side].add_imu_samples(samples)

    def process(self, frame: DepthFrame) -> None:
        """Detect the feet in a picture and update their filters."""
        T_rig_head = self._heads.at(frame.t_ns)
        if T_rig_head is None or frame.depth_mm is None:
            return
        T = T_rig_head @ self._T_head_camera
        for side, foot in self._feet.detect(frame.color, frame.depth_mm, frame.camera).items():
            position = T[:3, :3] @ foot.position + T[:3, 3]
            if foot.stage == "depth":
                self._filters[side].update_depth(frame.t_ns, position, _UNUSED)
                continue
            R = foot.R_camera_marker
            turned = None if R is None else quaternion_from_rotation(T[:3, :3] @ R @ R_FOOT_MARKER.T)
            self._filters[side].update_marker(frame.t_ns, position, _UNUSED, turned)

    def states(self, t_ns: int) -> dict[Side, FootState]:
        """Return every foot that was ever seen; reading smooths."""
        states = {side: each.state(t_ns) for side, each in self._filters.items()}
        return {side: state for side, state in states.items() if state is not None}
