"""Candidate positions of unknown or misplaced markers, on which the newest views of two cameras agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.camera import CameraModel
from rhot.messages import Position
from rhot_fusion.filter.initialisation import InitialState, View, from_views
from rhot_fusion.filter.settings import TrackSettings
from rhot_fusion.schedule import Schedule
from rhot_fusion.views.coherence import HandCoherence


class Candidates:
    """The newest views of M markers."""

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        markers: int,
        coherence: HandCoherence,
        schedule: Schedule,
        settings: TrackSettings,
        counts: Counter[str],
    ) -> None:
        """Start without views; increments `behind_cameras` and `gated` of counts."""
        self._cameras = list(cameras)
        self._coherence, self._schedule, self._settings, self._counts = coherence, schedule, settings, counts
        # Per camera: time, normalised coordinates and their variance.
        self._newest: list[dict[int, tuple[float, FloatArray, float]]] = [{} for _ in range(markers)]

    def clear(self) -> None:
        """Discard all views."""
        for newest in self._newest:
            newest.clear()

    def add(
        self, camera: int, markers: Sequence[int], times_s: Sequence[float], xy: FloatArray, variances: Sequence[float]
    ) -> None:
        """Store a camera's newest views (N, 2) of markers (N,), with times and variances (N,)."""
        for marker, t_s, view, variance in zip(markers, times_s, xy, variances, strict=True):
            self._newest[marker][camera] = t_s, view, variance

    def near(self, marker: int, t_s: float) -> dict[int, View]:
        """Return, by camera, the newest views of a marker close to a time."""
        settings = self._settings
        reach_s = min(settings.pair_s, settings.pair_periods * self._schedule.longest_period_s)
        return {
            camera: View(self._cameras[camera], seen_s, xy, variance)
            for camera, (seen_s, xy, variance) in self._newest[marker].items()
            if abs(t_s - seen_s) <= reach_s
        }

    def initial_state(
        self,
        marker: int,
        views: list[View],
        t_s: float,
        velocity: FloatArray,
        known: FloatArray,
        alive: BoolArray,
        volume_m: tuple[Position, Position],
    ) -> InitialState | None:
        """Return a marker's initial state from views of different cameras, if they agree on a plausible position.

        Args:
            marker: index of the marker.
            views: one per camera.
            t_s: time of the initial state.
            velocity: (3,) expected, metres per second.
            known: (M, 3) current marker positions, metres.
            alive: (M,) which of them are tracked.
            volume_m: corners of the volume in which markers are accepted, metres.
        """
        if len(views) < 2:
            return None
        settings = self._settings
        initial = from_views(views, t_s, velocity, settings.speed_sigma)
        if initial is None:
            self._counts["behind_cameras"] += 1
            return None
        low, high = volume_m
        position = initial.mean[:3]
        others = alive.copy()
        others[marker] = False
        believable = (
            initial.misfit <= settings.initialisation_gate + 2.0 * (len(views) - 2)
            and bool(((position >= low) & (position <= high)).all())
            and bool(self._coherence.near(np.array([marker]), position[None], known, others)[0])
            and not (np.linalg.norm(known[others] - position, axis=1) < settings.occupied_m).any()
        )
        self._counts["gated"] += not believable
        return initial if believable else None
