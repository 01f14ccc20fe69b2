"""Rigs, synthetic marker streams and figures for the tests and measurements of fusion."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.messages import Marker, MarkerFrame, PointSet
from rhot.recording import MarkerTrack, load_recording, marker_track_frames
from rhot.rig import CameraCalibration, CamerasFile, Rig, load_rig, write_json_model
from rhot.rig.cameras import camera_model
from rhot_fusion.core import FusionCore

SQUARE_M = 0.0259
MARKERS = ("thumb", "index", "middle", "ring", "little", "base")


def rig_toml(cameras: dict[str, float], rate_hz: float, fusion: str) -> str:
    lines = ["version = 1"]
    for name, x in cameras.items():
        lines += [f"[cameras.{name}]", f"rate_hz = {rate_hz}", "fov_deg = 62.2", f"position_m = [{x}, 0.0, 0.0]"]
    for name in MARKERS[:-1]:
        lines += [f"[markers.{name}]", f'joint = "{name}_tip"']
    lines += ["[markers.base]", 'joint = "wrist"', 'kind = "patch"', "size_m = [0.04, 0.03]"]
    lines += ["[fusion]", fusion]
    return "\n".join(lines) + "\n"


def make_rig(
    folder: Path,
    cameras: dict[str, CameraCalibration] | None = None,
    *,
    fusion: str = "",
    rate_hz: float = 60.0,
    places: dict[str, float] | None = None,
) -> Rig:
    """Write and load a rig: two nominal cameras 75 mm apart, others by their x, or calibrated ones as given."""
    names = dict.fromkeys(cameras, 0.0) if cameras else (places or {"left": 0.0, "right": 0.075})
    (folder / "rig.toml").write_text(rig_toml(names, rate_hz, fusion), encoding="utf-8")
    if cameras:
        write_json_model(folder / "cameras.json", CamerasFile(cameras=cameras))
    return load_rig(folder)


def calibration(
    K: FloatArray, distortion: FloatArray, T: FloatArray, width: int = 640, height: int = 480
) -> CameraCalibration:
    def rows(matrix: FloatArray) -> list[list[float]]:
        values: list[list[float]] = matrix.tolist()
        return values

    return CameraCalibration.model_validate(
        {
            "width": width,
            "height": height,
            "K": rows(K),
            "distortion": distortion.ravel().tolist(),
            "T_rig_camera": rows(T),
        }
    )


def thesis_cameras(thesis_rig: Path) -> dict[str, CameraCalibration]:
    """The thesis's own calibration, by geometric side.

    OpenCV's stereoCalibrate gives X2 = R·X1 + T. T is +2.92 squares along x: what camera 1 sees lies further right in
    camera 2's frame, so camera 2 is the left one and (R, T) itself maps the right camera's frame to the left one's.
    """
    inner = cv2.FileStorage(str(thesis_rig / "intrinsics.yml"), cv2.FILE_STORAGE_READ)
    outer = cv2.FileStorage(str(thesis_rig / "extrinsics.yml"), cv2.FILE_STORAGE_READ)
    T_left_right = np.eye(4)
    T_left_right[:3, :3] = outer.getNode("R").mat()
    T_left_right[:3, 3] = outer.getNode("T").mat().ravel() * SQUARE_M
    K1, D1, K2, D2 = (np.asarray(inner.getNode(name).mat(), dtype=np.float64) for name in ("M1", "D1", "M2", "D2"))
    return {"left": calibration(K2, D2, np.eye(4)), "right": calibration(K1, D1, T_left_right)}


@dataclass(frozen=True, slots=True)
class StreamFigures:
    """How well a recorded stream was followed.

    Attributes:
        in_volume: share of published points with a depth of 0.50 to 1.20 m.
        frames_in_volume: share of frames all of whose points have.
        step_p99_mm, step_max_mm: of the steps of a marker between consecutive frames of the recording.
        coverage: per marker, share of the frames in which both cameras truly saw it that report it.
        measured: same, reported as measured.
        delay_frames: lag of the published lateral place behind the picture, frames; negative = ahead.
        seconds_per_frame: of computing, per frame fed.
    """

    in_volume: float
    frames_in_volume: float
    step_p99_mm: float
    step_max_mm: float
    coverage: dict[str, float]
    measured: dict[str, float]
    delay_frames: float
    seconds_per_frame: float


_loaded = cache(load_recording)


def replay_figures(
    rig: Rig, recording_path: Path, seen_bits: int, rows: int | None = None
) -> tuple[StreamFigures, FusionCore]:
    """Run a recorded stream and measure it; `seen_bits` of masks.csv tell what was not truly seen.

    `rows` of that file end it sooner.
    """
    recording = _loaded(recording_path)
    core = FusionCore(rig)
    masks = np.loadtxt(recording_path / "masks.csv", delimiter=",", skiprows=1, dtype=np.int64)[:rows]
    last = int(masks[-1, 0])
    # Cameras are a frame or two apart: what follows the last one of both is not even made.
    begun = takewhile(lambda frame: frame.frame <= last + 30, marker_track_frames(rig, recording))
    frames = [frame for frame in begun if frame.frame <= last]
    left = recording.cameras["left"]
    assert isinstance(left, MarkerTrack)
    start_ns = int(left.t_ns[0])
    row_of = {int(frame): row for row, frame in enumerate(masks[:, 0])}
    places = np.full((len(masks), len(MARKERS), 3), np.nan)
    state = np.zeros((len(masks), len(MARKERS)), dtype=bool)
    began = time.perf_counter()
    outputs = [(frame.frame, output) for frame in frames for output in core.feed(frame)]
    spent = time.perf_counter() - began
    for frame, (_, points) in outputs:
        assert isinstance(points, PointSet)
        assert abs(points.t_ns - start_ns - (frame - int(left.frames[0])) * 1e9 / 30.0) < 1e6
        row = row_of[frame]
        for column, name in enumerate(MARKERS):
            point = points.points.get(name)
            if point is not None:
                places[row, column] = point.position
                state[row, column] = point.state == "measured"
    u = np.full((len(masks), len(MARKERS)), np.nan)
    kept = left.frames <= masks[-1, 0]
    u[
        [row_of[frame] for frame in left.frames[kept].tolist()],
        np.array([MARKERS.index(name) for name in left.markers])[left.marker[kept]],
    ] = left.uv[kept, 0]
    seen = (masks[:, 1:7] & seen_bits) == 0
    reported = np.isfinite(places[:, :, 2])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=2).ravel() * 1e3
    steps = steps[np.isfinite(steps)]
    outside = reported & ~((places[:, :, 2] > 0.5) & (places[:, :, 2] < 1.2))
    figures = StreamFigures(
        in_volume=1.0 - float(outside[reported].mean()),
        frames_in_volume=1.0 - float(outside.any(axis=1).mean()),
        step_p99_mm=float(np.percentile(steps, 99)),
        step_max_mm=float(steps.max()),
        coverage={name: float(reported[seen[:, i], i].mean()) for i, name in enumerate(MARKERS)},
        measured={name: float(state[seen[:, i], i].mean()) for i, name in enumerate(MARKERS)},
        delay_frames=_delay(u, places[:, :, 0] / places[:, :, 2], (masks[:, 1:7] == 0) & reported),
        seconds_per_frame=spent / len(frames),
    )
    return figures, core


def _delay(u: FloatArray, x: FloatArray, clean: NDArray[np.bool_]) -> float:
    """Return the lag (frames, parabola through the best whole one) at which the speed of x follows that of u."""
    scores = []
    lags = range(-4, 6)
    for lag in lags:
        total = 0.0
        for marker in range(u.shape[1]):
            du = np.diff(u[:, marker])
            dx = np.diff(x[:, marker])
            good = clean[1:, marker] & clean[:-1, marker]
            shifted = np.roll(dx, -lag)
            usable = good & np.roll(good, -lag) & np.isfinite(du) & np.isfinite(shifted)
            total += float(np.corrcoef(du[usable], shifted[usable])[0, 1])
        scores.append(total)
    best = int(np.clip(np.argmax(scores), 1, len(scores) - 2))
    before, peak, after = scores[best - 1 : best + 2]
    return lags[best] + 0.5 * (before - after) / (before - 2.0 * peak + after)


def pinhole_cameras(count: int, distortion: FloatArray | None = None) -> dict[str, CameraCalibration]:
    """Return cameras on an arc of 0.3 m about a point 0.8 m ahead of the first, all looking at it."""
    K = np.array([[530.0, 0.0, 319.5], [0.0, 528.0, 239.5], [0.0, 0.0, 1.0]])
    target = np.array([0.0, 0.0, 0.8])
    cameras = {}
    for index in range(count):
        center = np.array([0.075 * index, 0.02 * (index % 3), 0.01 * index])
        forward = (target - center) / np.linalg.norm(target - center)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
        T[:3, 3] = center
        cameras[f"camera{index}"] = calibration(K, np.zeros(0) if distortion is None else distortion, T)
    return cameras


def models(rig: Rig) -> list[CameraModel]:
    return [camera_model(camera) for camera in rig.cameras.values()]


@dataclass(frozen=True, slots=True)
class Motion:
    """A smooth path of each marker: a circle-like wander of the whole hand plus a spread of markers.

    Attributes:
        amplitude_m: of each axis.
        frequency_hz: of each axis; peak speed is 2π·f·a.
    """

    amplitude_m: tuple[float, float, float] = (0.08, 0.06, 0.05)
    frequency_hz: tuple[float, float, float] = (0.7, 0.9, 0.5)

    def at(self, t_s: FloatArray | float) -> FloatArray:
        """Return the markers' places (T, M, 3), metres, at times (T,)."""
        t = np.atleast_1d(np.asarray(t_s, dtype=np.float64))[:, None]
        f, a = np.array(self.frequency_hz), np.array(self.amplitude_m)
        center = np.array([0.03, 0.0, 0.8]) + a * np.sin(2.0 * np.pi * f * t + np.array([0.0, 1.0, 2.0]))
        spread = np.array(
            [
                [-0.06, 0.0, 0.0],
                [-0.03, -0.05, 0.0],
                [0.0, -0.06, 0.01],
                [0.03, -0.05, 0.0],
                [0.055, -0.03, -0.01],
                [0.0, 0.03, 0.02],
            ]
        )
        places: FloatArray = center[:, None, :] + spread
        return places


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame and when it arrives, seconds."""

    arrival_s: float
    frame: MarkerFrame


EPOCH_NS = 1_700_000_000_000_000_000


def watch(
    rig: Rig,
    motion: Motion,
    duration_s: float,
    *,
    rate_hz: float = 60.0,
    phase_s: float = 0.007,
    noise_px: float = 0.15,
    readout_s: float = 0.0,
    seed: int = 0,
) -> list[Seen]:
    """Let every camera of a rig watch the markers on its own schedule; frames in order of arrival.

    Camera k is k · phase_s behind the first. Each marker's time is that of its own row.
    """
    rng = np.random.default_rng(seed)
    seen: list[Seen] = []
    for index, (name, camera) in enumerate(zip(rig.cameras, models(rig), strict=True)):
        for number in range(int(duration_s * rate_hz)):
            start = number / rate_hz + index * phase_s
            times = np.full(len(MARKERS), start + 0.5 * readout_s)
            for _ in range(3 if readout_s else 1):
                truth = np.stack([motion.at(t)[0, marker] for marker, t in enumerate(times)])
                uv = camera.project(truth)
                times = start + readout_s * uv[:, 1] / camera.height
            uv = uv + rng.normal(0.0, noise_px, uv.shape)
            markers = {
                marker: Marker(
                    u=float(uv[i, 0]), v=float(uv[i, 1]), area=0.0, score=1.0, t_ns=EPOCH_NS + round(times[i] * 1e9)
                )
                for i, marker in enumerate(MARKERS)
                if camera.contains(uv[i : i + 1])[0]
            }
            t_ns = EPOCH_NS + round((start + 0.5 * readout_s) * 1e9)
            frame = MarkerFrame(
                t_ns=t_ns,
                seq=number,
                camera=name,
                width=camera.width,
                height=camera.height,
                markers=markers,
                frame=number,
            )
            seen.append(Seen(start + readout_s, frame))
    return sorted(seen, key=lambda one: one.arrival_s)


@dataclass(frozen=True, slots=True)
class TruthFigures:
    """How near published points were to the truth at their own time, after the first half second.

    Attributes:
        median_mm, p95_mm: distance.
        lateral_mm: median distance across the viewing direction of the first camera.
        lag_ms: median age of a set when it is published, against the newest frame.
        sets: number of point sets.
        measured: share of points reported as measured.
    """

    median_mm: float
    p95_mm: float
    lateral_mm: float
    lag_ms: float
    sets: int
    measured: float


def truth_figures(core: FusionCore, motion: Motion, seen: list[Seen]) -> TruthFigures:
    errors: list[FloatArray] = []
    lags: list[float] = []
    measured: list[bool] = []
    sets = 0
    for one in seen:
        for _, points in core.feed(one.frame):
            assert isinstance(points, PointSet)
            sets += 1
            t_s = (points.t_ns - EPOCH_NS) * 1e-9
            if t_s < 0.5:
                continue
            truth = motion.at(t_s)[0]
            lags.append((one.frame.t_ns - points.t_ns) * 1e-6)
            for i, name in enumerate(MARKERS):
                point = points.points.get(name)
                if point is not None:
                    errors.append(np.array(point.position) - truth[i])
                    measured.append(point.state == "measured")
    error = np.array(errors) * 1e3
    distance = np.linalg.norm(error, axis=1)
    return TruthFigures(
        median_mm=float(np.median(distance)),
        p95_mm=float(np.percentile(distance, 95)),
        lateral_mm=float(np.median(np.hypot(error[:, 0], error[:, 1]))),
        lag_ms=float(np.median(lags)),
        sets=sets,
        measured=float(np.mean(measured)),
    )
