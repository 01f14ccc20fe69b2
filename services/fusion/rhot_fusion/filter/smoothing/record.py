"""Frames of a recording, stored for smoothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from rhot.arrays import FloatArray, IndexArray
from rhot.geometry.camera import CameraModel
from rhot.types import Vector3
from rhot_fusion.filter.initialisation import InitialState
from rhot_fusion.filter.smoothing.smoother import Correct, Event, Node, RecordedFrame, smooth
from rhot_fusion.filter.state import ROUND, Innovation, Views
from rhot_fusion.filter.systematic import Systematic
from rhot_fusion.filter.tracks import TrackSettings, outcome_of, within_hand
from rhot_fusion.views.sightings import NOTHING, NOWHERE, Outcome, Sightings

_UPPER = np.triu_indices(3)
_NEAR = 0.75
"""Or within this many frame periods before or after."""


class HandRecord:
    """Frames with one hand's markers, in order of arrival.

    Attributes:
        index: (H,) indices of the hand's markers among all.
    """

    def __init__(self, index: IndexArray, cameras: Sequence[CameraModel]) -> None:
        self.index = index
        self._cameras = cameras
        self._frames: list[RecordedFrame] = []

    def clear(self) -> None:
        """Discard all frames."""
        self._frames.clear()

    def add(self, sightings: Sightings, shift: FloatArray, slack: FloatArray, variance: FloatArray) -> None:
        """Add a frame's views of this hand.

        Args:
            sightings: the N views.
            shift: (N, 2) correction from the visible centroid to the marker's centre, normalised units.
            slack: (N,) additional gate width for occlusion, normalised units.
            variance: (N,) of the shift, without the camera's pixel noise; see `smoothed`.
        """
        count = len(sightings.index)
        views = Views(
            self._cameras[sightings.camera],
            np.searchsorted(self.index, sightings.index),
            sightings.times_s - sightings.t_s,
            sightings.xy + shift,
            variance[:, None] * ROUND,
            slack,
        )
        nothing, seen = np.zeros(count, dtype=bool), sightings.xy.copy()
        of_paint = seen, sightings.area_px, sightings.border, sightings.skin
        self._frames.append(RecordedFrame(sightings.t_s, sightings.camera, views, nothing, [], *of_paint))

    def add_innovation(self, views: Views, innovation: Innovation, camera_variance: float) -> None:
        """Store the gate's results of the newest frame; `camera_variance` is the pixel noise included in `views`."""
        frame = self._frames[-1]
        rows = np.searchsorted(frame.views.index, views.index)
        frame.taken[rows] = innovation.accepted
        frame.views.xy[rows] = views.xy
        # The pixel noise is replaced by its final estimate later; the variances of paint and time stamps stay.
        frame.views.variance[rows] = views.variance - camera_variance * ROUND

    def add_removal(self, t_s: float, marker: int) -> None:
        """Record that a marker was removed after the newest frame."""
        if self._frames:
            self._frames[-1].events.append(Event(t_s, marker, None))

    def add_start(
        self, t_s: float, marker: int, initial: InitialState, cameras: Iterable[int], *, continues: bool
    ) -> None:
        """Record that a marker was initialised at the newest frame, from the newest views of some cameras."""
        first = self._frames[-1]
        sought = set(cameras)
        for frame in reversed(self._frames):
            mine = frame.views.index == marker
            if frame.camera in sought and mine.any():
                sought.remove(frame.camera)
                frame.taken |= mine
                first = frame
            if not sought:
                break
        self._frames[-1].events.append(Event(t_s, marker, initial, first, continues))

    def smoothed(self, variance_of: Callable[[int], float], settings: TrackSettings, correct: Correct) -> list[Node]:
        """Return the smoothed nodes of all frames in order of time; `variance_of` gives the pixel noise by camera."""
        frames = sorted(self._frames, key=lambda frame: frame.t_s)
        for frame in frames:
            own = frame.views.variance + variance_of(frame.camera) * ROUND
            frame.views = replace(frame.views, variance=own)
        self._frames = []
        return smooth(frames, len(self.index), settings, correct)


def outcomes(
    every: Sequence[tuple[IndexArray, int, list[Node]]],
    markers: int,
    periods_s: Sequence[float],
    systematic: Systematic,
    settings: TrackSettings,
    pair_variance: float,
    eye: Vector3,
) -> list[Outcome]:
    """Return the markers at the times of all frames.

    Args:
        every: per hand, the indices (H,) of its markers, that of its patch (−1 = none), and its nodes; the same frames
            for all hands.
        markers: number of markers.
        periods_s: frame period of each camera.
        systematic: systematic errors.
        settings: of the tracks.
        pair_variance: as in `CameraNoise`.
        eye: centroid of the cameras, metres.
    """
    first = every[0][2]
    around = [_around(camera, first, period_s) for camera, period_s in enumerate(periods_s)]
    found = []
    for k, node in enumerate(first):
        position, covariance, hidden_m2 = [NOWHERE] * markers, [NOTHING] * markers, [0.0] * markers
        seen = np.zeros((len(periods_s), markers), dtype=bool)
        for index, _, nodes in every:
            own = nodes[k].covariance[:, _UPPER[0], _UPPER[1]].tolist()
            columns = nodes[k].position.tolist(), own, nodes[k].hidden_m2.tolist()
            for marker, where, upper, hidden in zip(index.tolist(), *columns, strict=True):
                position[marker], covariance[marker], hidden_m2[marker] = where, upper, hidden
            for camera, sides in enumerate(around):
                seen[camera, index] = _shown(nodes, k, sides[k], _NEAR * periods_s[camera])
        shown = seen.T.tolist()
        for index, patch, _ in every:
            known = [marker for marker in index.tolist() if not math.isnan(position[marker][0])]
            within_hand(position, covariance, known, shown, eye, patch)
        rest = systematic, settings, pair_variance, hidden_m2
        found.append(outcome_of(node.t_s, position, covariance, seen.tolist(), *rest))
    return found


def _shown(nodes: list[Node], k: int, sides: tuple[list[int], list[int]], near_s: float) -> FloatArray:
    """Return which markers (H,) a camera sees at a node, from its frames before and after."""
    t_s = nodes[k].t_s
    shown = np.zeros(len(nodes[k].shown), dtype=bool)
    before, after = ([nodes[near].shown for near in side] for side in sides)
    for near in (*sides[0], *sides[1]):
        if abs(nodes[near].t_s - t_s) <= near_s:
            shown |= nodes[near].shown
    if before and after:
        shown |= np.any(before, axis=0) & np.any(after, axis=0)
    return shown


def _around(camera: int, nodes: list[Node], period_s: float) -> list[tuple[list[int], list[int]]]:
    """Return for each node the camera's nodes just before and just after it."""
    own = np.array([k for k, node in enumerate(nodes) if node.camera == camera], dtype=np.intp)
    times = np.array([nodes[k].t_s for k in own])
    # When smoothing, a camera counts as seeing a marker if it saw it within this many frame periods both before
    # and after: one frame may be lost.
    reach_s = 1.6 * period_s
    sides = []
    for node in nodes:
        first, middle = np.searchsorted(times, [node.t_s - reach_s, node.t_s])
        end, last = np.searchsorted(times, [node.t_s, node.t_s + reach_s], side="right")
        sides.append((own[first:end].tolist(), own[middle:last].tolist()))
    return sides
