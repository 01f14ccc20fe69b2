"""Pictures and marker frames of a simulated rig, made offline: every fault that the live simulation has but clocks.

The world's time 0 is `START_NS` of the rig clock. Cameras are out of step, roll their shutter and lose frames as live;
each frame carries its true time, as if the clocks of all cameras were exact.
"""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rhot.anatomy.markers import own_paints
from rhot.arrays import FloatArray, ImageArray
from rhot.geometry.camera import CameraModel
from rhot.messages import Marker, MarkerFrame
from rhot.rig import Rig
from rhot.rig.colors import load_colors
from rhot_bench.hands.accuracy import START_NS
from rhot_capture.detection.color_table import camera_tables
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.timing import marker_frame, row_time_ns
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.rig.schedule import FrameSchedule
from rhot_sim.world.motion import Motion, MotionSample
from rhot_sim.world.world import World


@dataclass(frozen=True, slots=True)
class Moment:
    """One frame of one camera.

    Attributes:
        delivered_s: when the picture is there, seconds since the world's start.
        camera: name.
        number: frame counter.
        t_first_row_s: start of the first row's exposure.
    """

    delivered_s: float
    camera: str
    number: int
    t_first_row_s: float


class SpedMotion:
    """Another motion, faster.

    Args:
        motion: what moves.
        factor: how much faster.
    """

    def __init__(self, motion: Motion, factor: float) -> None:
        self._motion = motion
        self._factor = factor

    def sample(self, t_s: FloatArray) -> MotionSample:
        """Return the motion at times (N,), seconds since the world's start."""
        return self._motion.sample(np.asarray(t_s, dtype=np.float64) * self._factor)


def world_of(rig: Rig, speed: float = 1.0) -> World:
    """Return the world of a simulated rig, moving `speed` times as fast as usual."""
    world = World.from_rig(rig)
    if speed != 1.0:
        world.motion = SpedMotion(world.motion, speed)
    return world


def with_cameras(rig: Rig, count: int) -> Rig:
    """Return a rig with its first cameras alone."""
    names = list(rig.config.cameras)[:count]
    config = rig.config.model_copy(update={"cameras": {name: rig.config.cameras[name] for name in names}})
    return dataclasses.replace(rig, config=config, cameras={name: rig.cameras[name] for name in names})


def with_rate(rig: Rig, rate_hz: float) -> Rig:
    """Return a rig whose cameras deliver another number of frames a second; exposures are cut where they must."""
    cameras = {
        name: camera.model_copy(
            update={
                "rate_hz": rate_hz,
                "exposure_s": min(camera.exposure_s, 0.9 / rate_hz),
                "readout_s": min(camera.readout_s, 0.9 / rate_hz),
            }
        )
        for name, camera in rig.config.cameras.items()
    }
    return dataclasses.replace(rig, config=rig.config.model_copy(update={"cameras": cameras}))


def moments(rig: Rig, from_s: float, to_s: float) -> Iterator[Moment]:
    """Yield the frames that all cameras deliver of a stretch of time, in order of delivery."""

    def of_camera(place: int, name: str) -> Iterator[Moment]:
        schedule = FrameSchedule(name, place, rig.config.cameras[name], rig.config.sim)
        number = schedule.first_after(from_s)
        while (frame := schedule.frame(number)).t_first_row_s < to_s:
            if not frame.dropped:
                yield Moment(frame.delivered_s, name, number, frame.t_first_row_s)
            number += 1

    streams = [of_camera(index, name) for index, name in enumerate(rig.config.cameras)]
    return heapq.merge(*streams, key=lambda moment: moment.delivered_s)


class Cameras:
    """The simulated cameras of a rig: they render.

    Args:
        rig: simulated.
        world: what they look at.
    """

    def __init__(self, rig: Rig, world: World) -> None:
        self._renderers = {
            name: Renderer(camera, world, rig.config.sim, rig.config.cameras[name], index)
            for index, (name, camera) in enumerate(true_cameras(rig).items())
        }

    def picture(self, moment: Moment) -> ImageArray:
        """Return a frame's picture (H, W, 3), uint8 BGR."""
        return self._renderers[moment.camera].render(moment.t_first_row_s)


class Capture:
    """What the capture services of a rig do with pictures, without camera, clock and bus.

    Args:
        rig: with colours.
    """

    def __init__(self, rig: Rig) -> None:
        self._cameras = rig.config.cameras
        tables = camera_tables(load_colors(rig.colors_path), list(own_paints(rig.config.markers)), self._cameras)
        self.detectors = {
            name: MarkerDetector(rig.config.markers, tables[name], camera.width, camera.height)
            for name, camera in self._cameras.items()
        }

    def frame(self, moment: Moment, image: ImageArray) -> MarkerFrame:
        """Return the message of a picture."""
        camera = self._cameras[moment.camera]
        return marker_frame(
            moment.camera,
            (camera.width, camera.height),
            self.detectors[moment.camera].detect(image),
            START_NS + round(moment.t_first_row_s * 1e9),
            camera.exposure_s,
            camera.readout_s,
            moment.number,
        )


def projected_frames(rig: Rig, world: World, from_s: float, to_s: float) -> Iterator[MarkerFrame]:
    """Yield marker frames by projecting the true marker centres, with noise of 0.1 px; nothing hides anything.

    For measuring the cost of what comes after capture without rendering.
    """
    rng = np.random.default_rng(0)
    cameras: Mapping[str, CameraModel] = true_cameras(rig)
    for moment in moments(rig, from_s, to_s):
        config, model = rig.config.cameras[moment.camera], cameras[moment.camera]
        middle_s = moment.t_first_row_s + 0.5 * (config.exposure_s + config.readout_s)
        truth = world.sample(np.array([middle_s])).markers
        uv = model.project(np.array([centre[0] for centre in truth.values()]))
        inside = model.contains(uv)
        uv += rng.normal(0.0, 0.1, uv.shape)
        first_row_ns = START_NS + round(moment.t_first_row_s * 1e9)

        def time_of(row: float, start: int = first_row_ns, height: int = config.height) -> int:
            return row_time_ns(start, row, height, config.exposure_s, config.readout_s)  # noqa: B023

        yield MarkerFrame(
            t_ns=time_of(0.5 * (config.height - 1)),
            camera=moment.camera,
            width=config.width,
            height=config.height,
            markers={
                name: Marker(u=float(u), v=float(v), area=0.0, score=0.9, t_ns=time_of(float(v)))
                for name, (u, v), seen in zip(truth, uv, inside, strict=True)
                if seen
            },
            frame=moment.number,
        )
