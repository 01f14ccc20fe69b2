"""What is true of a simulated rig: its cameras, when they exposed their frames, and its focal length times baseline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rhot.errors import CalibrationError, ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame
from rhot.rig import Rig
from rhot_capture.timing import row_time_ns
from rhot_sim.rig.folder import true_cameras
from rhot_sim.rig.schedule import FrameSchedule
from rhot_tools.rig.heard import Heard


@dataclass(frozen=True, slots=True)
class SimulatedTruth:
    """What is true of a simulated rig beside what `rhot/truth` says.

    Attributes:
        cameras: by name, as they truly stand.
        schedules: by name, when their frames are exposed.
        start_ns: rig time of the world's start; 0 = not known.
        rig: whose configuration the cameras have.
    """

    cameras: Mapping[str, CameraModel]
    schedules: Mapping[str, FrameSchedule]
    start_ns: int
    rig: Rig

    def exposed_ns(self, frame: MarkerFrame) -> int | None:
        """Return when a frame's middle row was exposed, rig clock; None where the world's start is not known."""
        if not self.start_ns or frame.camera not in self.schedules:
            return None
        config = self.rig.config.cameras[frame.camera]
        first_ns = self.start_ns + round(1e9 * self.schedules[frame.camera].frame(frame.frame).t_first_row_s)
        middle = 0.5 * (config.height - 1)
        return row_time_ns(first_ns, middle, config.height, config.exposure_s, config.readout_s)

    @property
    def fb(self) -> float:
        """Focal length of the first camera's calibration times the true baseline, pixel metres.

        The second camera is turned into the first one's orientation, so its own does not matter.
        """
        first, second = list(self.cameras.values())[:2]
        K = CameraModel.from_calibration(next(iter(self.rig.cameras.values()))).K
        return float(K[0, 0]) * abs(float(first.to_camera(second.center[None])[0, 0]))


def simulated_truth(rig: Rig, heard: Heard) -> SimulatedTruth | None:
    """Return what is true of the rig that was heard; None where it is a real one."""
    if not heard.truth or len(rig.config.cameras) < 2:
        return None
    try:
        cameras = true_cameras(rig)
    except (CalibrationError, ConfigError):
        return None
    schedules = {
        name: FrameSchedule(name, index, config, rig.config.sim)
        for index, (name, config) in enumerate(rig.config.cameras.items())
    }
    return SimulatedTruth(cameras, schedules, heard.start_ns, rig)
