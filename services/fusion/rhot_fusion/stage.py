"""The core of fusion: marker frames in, point sets out."""

from __future__ import annotations

from collections import Counter
from statistics import median

import numpy as np
from numpy.typing import NDArray

from rhot.camera import CameraModel
from rhot.errors import ConfigError
from rhot.messages import MarkerFrame, Point, PointSet
from rhot.rig import FusionConfig, Rig
from rhot.stage import Output
from rhot_fusion.association import Association, Outcome
from rhot_fusion.corners import PatchCorners
from rhot_fusion.guard import StreamGuard
from rhot_fusion.schedule import Schedule
from rhot_fusion.tracks import Tracks

FloatArray = NDArray[np.float64]

POINTS_KEY = "rhot/points"
RIG_FRAME = "rig"

_ROW_SPREAD_S = 0.1
"""A marker's own time may differ from its frame's by no more than a read-out takes."""
_ROWS_SHARE = 0.5
"""Markers in other rows than the frame's middle are carried on this much further, as a share of a period."""
_LONGEST_GAP = 3.5
"""Observations further apart than this many periods are not joined."""
_SWAP_EVIDENCE = 50


class FusionStage:
    """Turns MarkerFrames of any number of cameras, in any order of arrival, into PointSets in the rig frame.

    Attributes:
        counts: what was ignored, by reason, beside `published` sets and `measured` points.
    """

    def __init__(self, rig: Rig) -> None:
        """Build the stage of a rig.

        Raises:
            ConfigError: the rig's cameras cannot be used with the method it asks for.
        """
        if len(rig.cameras) < 2:
            raise ConfigError(
                f"{rig.path / 'rig.toml'}: fusion needs two cameras or more, it has {len(rig.cameras)}; add another "
                "[cameras.NAME]"
            )
        self.counts: Counter[str] = Counter()
        models = {name: CameraModel.from_calibration(camera) for name, camera in rig.cameras.items()}
        self._models = list(models.values())
        self._camera_index = {name: place for place, name in enumerate(models)}
        self._markers = tuple(rig.config.markers)
        self._marker_index = {name: place for place, name in enumerate(self._markers)}
        self._config = rig.config.fusion
        self._association = Association(self._models, rig.config.markers, rig.hand.length_m, self._config, self.counts)
        self._corners = PatchCorners(rig.config.markers, self._models)
        self._guard = StreamGuard(models, self.counts)
        self._schedule = Schedule([1.0 / camera.rate_hz for camera in rig.config.cameras.values()])
        self._tracks = Tracks(len(self._models), len(self._markers))
        self._base_ns: int | None = None

    def configure(self, config: FusionConfig) -> None:
        """Change the settings while running; points go on from where they are unless the method changes.

        Raises:
            ConfigError: the rig's cameras cannot be used with the new method; the old settings stay.
        """
        self._association.configure(config)
        self._config = config

    @property
    def epipolar_px(self) -> tuple[float, float]:
        """Mean and 95th percentile of the recent epipolar residuals after the learnt correction, pixels."""
        return self._association.epipolar.figures_px

    @property
    def figures(self) -> dict[str, float]:
        """`epipolar_px` and `epipolar_p95_px`: how well the rows of the views agree; grows when a camera was bumped."""
        mean, p95 = self.epipolar_px
        return {name: value for name, value in (("epipolar_px", mean), ("epipolar_p95_px", p95)) if np.isfinite(value)}

    @property
    def problem(self) -> str:
        """What is wrong with the rig as a whole, one sentence; empty when nothing is."""
        behind, measured = self.counts["behind_cameras"], self.counts["measured"]
        if behind > _SWAP_EVIDENCE and behind > measured:
            first, second = list(self._camera_index)[:2]
            return (
                f"{behind} points lie behind the cameras and {measured} before them: cameras {first} and {second} are "
                "probably swapped; exchange their names or places in rig.toml (and cameras.json)"
            )
        return ""

    def feed(self, message: MarkerFrame) -> list[Output]:
        """Take one frame of one camera; return the point set that it made possible, if any."""
        verdict = self._guard.judge(message)
        if verdict == "refuse":
            return []
        known_ns = None if verdict == "restart" else self._base_ns
        base_ns = self._begin(message.t_ns) if known_ns is None else known_ns
        self._observe(message, base_ns)
        moment_s = self._schedule.moment(self._config.extrapolation)
        if moment_s is None:
            return []
        period_s = max(self._schedule.period_s(camera) for camera in range(len(self._models)))
        reach_s = (self._config.extrapolation + _ROWS_SHARE) * period_s
        shot = self._tracks.at(moment_s, reach_s, _LONGEST_GAP * period_s)
        points = self._points(self._association.advance(shot, moment_s, period_s), moment_s)
        seq = self.counts["published"]
        self.counts["published"] += 1
        return [(POINTS_KEY, PointSet(t_ns=base_ns + round(moment_s * 1e9), seq=seq, frame=RIG_FRAME, points=points))]

    def _begin(self, t_ns: int) -> int:
        """Start a stream at a time; seconds in here count from it, so that they fit a float64 to the nanosecond."""
        self._schedule.clear()
        self._tracks.clear()
        self._corners.clear()
        self._association.clear()
        self._base_ns = t_ns
        return t_ns

    def _observe(self, frame: MarkerFrame, base_ns: int) -> None:
        camera = self._camera_index[frame.camera]
        frame_s = (frame.t_ns - base_ns) * 1e-9
        places: list[int] = []
        uv: list[tuple[float, float]] = []
        times: list[float] = []
        for name, marker in frame.markers.items():
            place = self._marker_index.get(name)
            t_s = frame_s if marker.t_ns is None else (marker.t_ns - base_ns) * 1e-9
            if place is None:
                self.counts["unknown_marker"] += 1
            elif abs(t_s - frame_s) > _ROW_SPREAD_S:
                self.counts["wrong_marker_time"] += 1
            else:
                places.append(place)
                uv.append((marker.u, marker.v))
                times.append(t_s)
        model = self._models[camera]
        index, pixels, t = np.array(places, dtype=np.intp), np.array(uv).reshape(-1, 2), np.array(times)
        inside, later = model.contains(pixels), t > self._tracks.last_t_s[camera, index]
        self.counts["outside"] += int(np.count_nonzero(~inside))
        self.counts["late_marker"] += int(np.count_nonzero(~later))
        usable = inside & later
        index, pixels, t = index[usable], pixels[usable], t[usable]
        low, high = self._config.volume_m
        max_rate = self._config.max_speed_m_s / max(0.5 * (low[2] + high[2]), 0.1)
        self._tracks.append(camera, index, t, model.undistort(pixels), max_rate)
        self._corners.observe(camera, frame, frame_s)
        self._schedule.arrived(camera, median(t.tolist()) if len(t) else frame_s)

    def _points(self, outcome: Outcome, t_s: float) -> dict[str, Point]:
        points: dict[str, Point] = {}
        for index, (name, position) in enumerate(zip(self._markers, outcome.position.tolist(), strict=True)):
            if not np.isfinite(position[0]):
                continue
            measured = bool(outcome.measured[index])
            points[name] = Point(
                position=(position[0], position[1], position[2]),
                sigma=float(outcome.sigma_m[index]),
                views=int(outcome.views[index]),
                state="measured" if measured else "predicted",
                corners=self._corners.solve(name, outcome.xy[:, index], outcome.position[index], t_s)
                if measured
                else None,
            )
        return points
