"""The fusion core: computes point sets from marker frames."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from statistics import median

import numpy as np

from rhot.core import Explanation, ExplanationRow, Output
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame, Point, PointSet, PointState, Position
from rhot.messages.base import wire_position
from rhot.plugins import load_plugin
from rhot.rig import FusionConfig, Rig
from rhot.rig.cameras import camera_rig
from rhot_fusion.filter.joint import squared_distance
from rhot_fusion.filter.state import ROUND
from rhot_fusion.filter.tracker import FilterTracker
from rhot_fusion.filter.tracks import GATE, TrackStatus
from rhot_fusion.views.corners import Corners, PatchCorners
from rhot_fusion.views.sightings import Outcome, Sightings, Tracker, nearest_border

# Rejects implausible frames before they are processed, and counts them by reason.

_FUTURE_NS = 500_000_000
"""A frame further ahead of the newest one than this is rejected until several frames agree."""
_BACK_NS = 1_000_000_000
"""The same for a frame that is older than the newest one; the network reorders by far less."""


class StreamGuard:
    """Checks a frame's camera name, size, order and time.

    A single frame with a time far in the past or future must not corrupt the tracks, but a stream that paused or was
    restarted must be accepted. Frames far from the stream's time are therefore rejected until several consecutive ones
    agree with each other.

    Attributes:
        counts: rejected frames by reason.
    """

    def __init__(self, cameras: Mapping[str, CameraModel], counts: Counter[str]) -> None:
        self._cameras = cameras
        self.counts = counts
        self._newest_ns: int | None = None
        self._last: dict[str, int] = {}
        self._suspect_ns: int | None = None
        self._suspects = 0

    def judge(self, frame: MarkerFrame) -> str:
        """Return `accept`, `refuse`, or `restart` if this frame begins a new stream."""
        camera = self._cameras.get(frame.camera)
        if camera is None:
            return self._refuse("unknown_camera")
        if (frame.width, frame.height) != (camera.width, camera.height):
            return self._refuse("wrong_size")
        if self._newest_ns is not None and not -_BACK_NS <= frame.t_ns - self._newest_ns <= _FUTURE_NS:
            return self._judge_suspect(frame)
        last = self._last.get(frame.camera)
        if last is not None and frame.t_ns <= last:
            # Reordered or repeated by the network: not newer than this camera's last frame.
            return self._refuse("duplicate" if frame.t_ns == last else "late")
        self._accept(frame)
        return "accept"

    def _judge_suspect(self, frame: MarkerFrame) -> str:
        follows = self._suspect_ns is not None and 0 <= frame.t_ns - self._suspect_ns <= _FUTURE_NS
        self._suspects = self._suspects + 1 if follows else 1
        self._suspect_ns = frame.t_ns
        ahead = self._newest_ns is not None and frame.t_ns > self._newest_ns
        # Number of consecutive such frames ahead after which the stream is considered to have paused.
        # Number of consecutive such older frames after which the stream is considered to have been restarted.
        if self._suspects < (3 if ahead else 8):
            return self._refuse("wrong_time")
        self._last.clear()
        self._newest_ns = None
        self._accept(frame)
        self.counts["restarts"] += 1
        return "restart"

    def _accept(self, frame: MarkerFrame) -> None:
        self._last[frame.camera] = frame.t_ns
        self._newest_ns = frame.t_ns if self._newest_ns is None else max(self._newest_ns, frame.t_ns)
        self._suspects = 0
        self._suspect_ns = None

    def _refuse(self, reason: str) -> str:
        self.counts[reason] += 1
        return "refuse"


# Explain fusion: the state of each marker, and why views were accepted or rejected (read-only).


def tracker_tables(
    tracker: Tracker, cameras: Sequence[str], markers: Sequence[str], counts: Mapping[str, int], now_s: float
) -> list[Explanation]:
    """Return the tables of a tracker's state.

    Args:
        tracker: of any method; `filter` has tables of its own.
        cameras, markers: names, in the tracker's order.
        counts: of the stage.
        now_s: current time, seconds since the stream's start.
    """
    tables = [_rig(tracker, counts)]
    if isinstance(tracker, FilterTracker):
        tables = [_gates(tracker, cameras, markers), _states(tracker, cameras, markers, now_s), *tables]
    return tables


def _gates(tracker: FilterTracker, cameras: Sequence[str], markers: Sequence[str]) -> Explanation:
    rows = []
    for camera, (index, innovation, slack) in sorted(tracker.gates.items()):
        focal_px = tracker.focal_px(camera)
        S = innovation.S + np.square(slack)[:, None] * ROUND
        sigma_px = np.sqrt(S[:, (0, 2)]) * focal_px
        distance2 = squared_distance(S, innovation.y)
        for marker, y, sigma, nis, accepted in zip(
            index.tolist(), innovation.y * focal_px, sigma_px, distance2.tolist(), innovation.accepted, strict=True
        ):
            rows.append(
                ExplanationRow(
                    (
                        cameras[camera],
                        markers[marker],
                        f"{y[0]:+.2f}",
                        f"{sigma[0]:.2f}",
                        f"{y[1]:+.2f}",
                        f"{sigma[1]:.2f}",
                        f"{nis**0.5:.1f}",
                        "accepted" if accepted else "rejected",
                    ),
                    "accepted" if accepted else "rejected",
                )
            )
    return Explanation(
        "Gates: innovations of each camera's newest frame",
        (
            *("camera", "marker", "innovation x, px", "sigma x, px", "innovation y, px", "sigma y, px"),
            *("Mahalanobis distance", "verdict"),
        ),
        tuple(rows),
        "Innovation: observation minus the filter's prediction. Sigma: its standard deviation, including an allowance "
        f"for occluded paint. Observations with a Mahalanobis distance above {GATE**0.5:.0f} are "
        "rejected.",
    )


def _states(tracker: FilterTracker, cameras: Sequence[str], markers: Sequence[str], now_s: float) -> Explanation:
    outcome = tracker.outcome(now_s)
    rows = []
    for index, name in enumerate(markers):
        track = tracker.tracks[index]
        if track.status is not TrackStatus.CONFIRMED or outcome.covariance is None or outcome.state is None:
            status = f"not tracked ({track.status.name.lower()})"
            rows.append(ExplanationRow((name, status, "", "", "", ""), "rejected"))
            continue
        fresh = [camera for camera, seen in zip(cameras, outcome.seen, strict=True) if seen[index]]
        xx, _, _, yy, _, zz = outcome.covariance[index]
        rows.append(
            ExplanationRow(
                (
                    name,
                    outcome.state[index],
                    ", ".join(f"{1e3 * value:.1f}" for value in outcome.position[index]),
                    " / ".join(f"{1e3 * value:.2f}" for value in (xx**0.5, yy**0.5, zz**0.5)),
                    f"{1e3 * (now_s - track.seen_s):.0f}",
                    ", ".join(fresh) or "none",
                ),
                "accepted" if fresh else "rejected",
            )
        )
    return Explanation(
        "Filter: state of each marker",
        ("marker", "state", "x, y, z, mm", "sigma x / y / z, mm", "last seen, ms ago", "visible to cameras"),
        tuple(rows),
    )


def _rig(tracker: Tracker, counts: Mapping[str, int]) -> Explanation:
    mean, p95 = tracker.epipolar.figures_px
    noise = []
    if isinstance(tracker, FilterTracker):
        noise = [(f"noise, camera {k + 1}, px", f"{px:.2f}") for k, px in enumerate(tracker.noise.sigma_px.tolist())]
    rows = [
        ("epipolar residual, mean, px", f"{mean:.2f}"),
        ("epipolar residual, p95, px", f"{p95:.2f}"),
        ("systematic epipolar residual, px", f"{tracker.epipolar.correction_px:.2f}"),
        *noise,
        *((f"count: {name}", str(count)) for name, count in sorted(counts.items()) if count),
    ]
    return Explanation(
        "Fusion: agreement of the cameras, and counts",
        ("quantity", "value"),
        tuple(ExplanationRow(row) for row in rows),
        "The systematic residual grows when a camera moves after its calibration. Counts start with the processed part "
        "of the recording (--lead).",
    )


POINTS_KEY = "rhot/points"
RIG_FRAME = "rig"


class FusionCore:
    """Computes PointSets in the rig frame from MarkerFrames of any number of cameras, in any order of arrival.

    Attributes:
        counts: rejected input by reason, `published` sets and `measured` points.
    """

    def __init__(self, rig: Rig, *, record: bool = False) -> None:
        """Build the core of a rig; `record` stores the frames for `smoothed`.

        Raises:
            ConfigError: fewer than two cameras, or cameras that the configured method cannot use.
        """
        if len(rig.cameras) < 2:
            raise ConfigError(
                f"{rig.path / 'rig.toml'}: fusion needs at least two cameras, but the rig has {len(rig.cameras)}; add "
                "[cameras.NAME]"
            )
        self.counts: Counter[str] = Counter()
        self._cameras = camera_rig(rig)
        self._models = list(self._cameras.models)
        self._camera_index = {name: index for index, name in enumerate(self._cameras.names)}
        self._markers = tuple(rig.config.markers)
        self._config = rig.config.fusion
        self._periods_s = [1.0 / rate_hz for rate_hz in self._cameras.rates_hz]
        self._rig = rig
        self._record = record
        self._published: list[PointSet] = []
        self._smoothed: list[PointSet] = []
        self._tracker = self._make_tracker(self._config)
        self._corners = PatchCorners(rig.config.markers, self._models)
        self._guard = StreamGuard(dict(zip(self._cameras.names, self._models, strict=True)), self.counts)
        self._base_ns: int | None = None
        self._newest_s = 0.0

    def configure(self, config: FusionConfig) -> None:
        """Change the settings while running; the tracks are kept unless the method changes.

        Raises:
            ConfigError: the rig's cameras cannot be used with the new method; the old settings stay in force.
        """
        if config.method == self._config.method:
            self._tracker.configure(config)
        else:
            tracker = self._make_tracker(config)
            self.smoothed()
            tracker.epipolar = self._tracker.epipolar
            tracker.epipolar.set_limit(config.epipolar_limit_px)
            self._tracker = tracker
        self._config = config

    def smoothed(self) -> list[PointSet]:
        """Return the points at all frames so far, smoothed over all of them; empty without `record` and `filter`."""
        if isinstance(self._tracker, FilterTracker) and self._base_ns is not None:
            live = {points.t_ns: points for points in self._published}
            for outcome in self._tracker.smoothed():
                t_ns = self._base_ns + round(outcome.t_s * 1e9)
                self._smoothed.append(self._points(outcome, t_ns, len(self._smoothed), live.get(t_ns)))
            self._published.clear()
        return self._smoothed

    @property
    def epipolar_px(self) -> tuple[float, float]:
        """Mean and 95th percentile of the recent corrected epipolar residuals, pixels."""
        return self._tracker.epipolar.figures_px

    @property
    def figures(self) -> dict[str, float]:
        """Epipolar residuals (`epipolar_px`, `epipolar_p95_px`) and the size of their correction, pixels.

        `epipolar_correction_px` is the systematic residual; it grows when a camera moves after its calibration.
        """
        mean, p95 = self.epipolar_px
        correction = self._tracker.epipolar.correction_px
        figures = {"epipolar_px": mean, "epipolar_p95_px": p95, "epipolar_correction_px": correction}
        return {name: value for name, value in figures.items() if np.isfinite(value)}

    @property
    def problem(self) -> str:
        """A problem of the whole rig, as one sentence; empty if there is none."""
        behind, measured = self.counts["behind_cameras"], self.counts["measured"]
        first, second = list(self._camera_index)[:2]
        remedy = f"cameras {first} and {second} are probably swapped: exchange their plugs or folders, or their names"
        # Cameras are reported as swapped if more points than this, and more than measured ones, are behind
        # them: ten frames of a hand. Chosen.
        if behind > 50 and behind > measured:
            return f"{behind} points are behind the cameras and {measured} in front: {remedy} in rig.toml"
        agreement = self._tracker.agreement if isinstance(self._tracker, FilterTracker) else None
        bumped_px = 0.0 if agreement is None else agreement.bumped_px
        if agreement is not None and agreement.swapped:
            return f"the views of two cameras fit their calibration only when they are exchanged: {remedy} in rig.toml"
        if bumped_px:
            return (
                f"a camera has moved since the calibration: its views are {bumped_px:.1f} px off their epipolar lines; "
                "only a part of this error can be corrected; run rhot calibrate cameras"
            )
        return ""

    def feed(self, frame: MarkerFrame) -> list[Output]:
        """Process a frame of one camera; return the next point set if its time was reached."""
        verdict = self._guard.judge(frame)
        if verdict == "refuse":
            return []
        known_ns = None if verdict == "restart" else self._base_ns
        base_ns = self._begin(frame.t_ns) if known_ns is None else known_ns
        sightings = self._sightings(frame, base_ns)
        self._newest_s = sightings.t_s
        outcome = self._tracker.advance(sightings)
        if outcome is None:
            return []
        seq = self.counts["published"]
        self.counts["published"] += 1
        t_ns = base_ns + round(outcome.t_s * 1e9)
        points = self._points(outcome, t_ns, seq)
        if self._record:
            self._published.append(points)
        return [(POINTS_KEY, points)]

    def explain(self) -> list[Explanation]:
        """Return tables of the markers' state after the newest frame; see `rhot.core`."""
        return tracker_tables(self._tracker, list(self._camera_index), self._markers, self.counts, self._newest_s)

    def _begin(self, t_ns: int) -> int:
        """Start a stream; seconds count from its start, so that float64 resolves nanoseconds."""
        self.smoothed()
        self._corners.clear()
        self._tracker.clear()
        self._base_ns = t_ns
        return t_ns

    def _sightings(self, frame: MarkerFrame, base_ns: int) -> Sightings:
        camera = self._camera_index[frame.camera]
        frame_s = (frame.t_ns - base_ns) * 1e-9
        indices: list[int] = []
        uv: list[tuple[float, float]] = []
        times: list[float] = []
        areas: list[float] = []
        skin: list[tuple[float, float]] = []
        is_near = False
        known = 0
        for index, name in enumerate(self._markers):
            marker = frame.markers.get(name)
            if marker is None:
                continue
            known += 1
            t_s = frame_s if marker.t_ns is None else (marker.t_ns - base_ns) * 1e-9
            # Largest difference between a marker's time and its frame's: the sensor's read-out takes no
            # longer.
            if abs(t_s - frame_s) > 0.1:
                self.counts["wrong_marker_time"] += 1
            elif not (-0.5 < marker.u < frame.width - 0.5 and -0.5 < marker.v < frame.height - 0.5):
                self.counts["outside"] += 1
            else:
                indices.append(index)
                uv.append((marker.u, marker.v))
                times.append(t_s)
                areas.append(marker.area)
                skin.append(marker.skin_side or (0.0, 0.0))
                away_px = min(marker.u, marker.v, frame.width - 1 - marker.u, frame.height - 1 - marker.v) + 0.5
                is_near |= away_px**2 < marker.area
        if known < len(frame.markers):
            self.counts["unknown_marker"] += len(frame.markers) - known
        # Computed on demand: in few frames does a marker touch the border.
        borders = [nearest_border(u, v, frame.width, frame.height) for u, v in uv] if is_near else None
        # One call undistorts all pixels.
        count, patches = len(indices), self._corners.listed(camera, frame.markers)
        for points in patches.values():
            uv += points
        xy = self._models[camera].undistort(np.array(uv))
        if patches:
            corners = iter(xy[count:].tolist())
            for name in patches:
                t_ns = frame.markers[name].t_ns
                t_s = frame_s if t_ns is None else (t_ns - base_ns) * 1e-9
                self._corners.observe(camera, name, t_s, list(islice(corners, 5)))
        middle_s = median(times) if times else frame_s
        border = None if borders is None else np.array(borders) / (self._models[camera].K[0, 0], 1.0, 1.0)
        markers = np.array(indices, dtype=np.intp)
        sides = np.array(skin).reshape(count, 2)
        seen = Sightings(camera, middle_s, markers, np.array(times), xy[:count], np.array(areas), border, sides)
        return seen if math.isfinite(seen.xy.sum()) else self._inside_lens(seen)

    def _inside_lens(self, seen: Sightings) -> Sightings:
        """Return the observations for which the camera's lens model can be inverted."""
        inside = np.isfinite(seen.xy[:, 0]) & np.isfinite(seen.xy[:, 1])
        self.counts["outside"] += int(np.count_nonzero(~inside))
        return seen.chosen(inside)

    def _make_tracker(self, config: FusionConfig) -> Tracker:
        if config.method == "filter":
            return FilterTracker(
                self._cameras, self._rig.config.markers, self._rig.hand, config, self.counts, record=self._record
            )
        what = f'[fusion] method = "{config.method}"'
        method: Callable[..., Tracker] = load_plugin("rhot.methods", f"fusion.{config.method}", what, "bench")
        return method(self._models, self._rig.config.markers, self._rig.hand, self._periods_s, config, self.counts)

    def _points(self, outcome: Outcome, t_ns: int, seq: int, live: PointSet | None = None) -> PointSet:
        """Return the message of an outcome; if `live` is given, with its corners, translated to the new points."""
        points: dict[str, dict[str, object]] = {}
        for index, (name, (x, y, z), sigma, views, measured) in enumerate(
            zip(self._markers, outcome.position, outcome.sigma_m, outcome.views, outcome.measured, strict=True)
        ):
            if math.isnan(x):
                continue
            position = x, y, z
            corners = None
            if live is not None:
                corners = _translated_corners(live.points.get(name), position)
            elif measured and name in self._corners.names:
                cameras = [camera for camera, seen in enumerate(outcome.seen) if seen[index]]
                corners = self._corners.solve(name, cameras, position, outcome.t_s)
            state: PointState = "measured" if measured else "predicted"
            if outcome.state is not None:
                state = outcome.state[index]
            covariance = None if outcome.covariance is None else outcome.covariance[index]
            points[name] = {
                "position": position,
                "sigma": sigma,
                "views": views,
                "state": state,
                "covariance": covariance,
                "corners": corners,
            }
        # Validating the whole message is a third faster than validating each point.
        return PointSet.model_validate({"t_ns": t_ns, "seq": seq, "frame": RIG_FRAME, "points": points})


def _translated_corners(point: Point | None, position: Position) -> Corners | None:
    """Return the corners of a point, translated with it to another position."""
    if point is None or point.corners is None:
        return None
    step = np.array(position) - point.position
    a, b, c, d = (wire_position(np.array(corner) + step) for corner in point.corners)
    return a, b, c, d
