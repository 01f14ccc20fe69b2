"""Track management for the hands of a rig: initialising, relocating and dropping markers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.hand_proportions import HandMeasures
from rhot.anatomy.markers import PaintedMarker
from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.geometry.camera import CameraModel
from rhot.types import Vector3
from rhot_fusion.filter.initialisation import InitialState, View, from_views, on_ray
from rhot_fusion.filter.joint import JointFilter
from rhot_fusion.filter.smoothing.record import HandRecord
from rhot_fusion.filter.tracks import (
    BEHIND_M,
    GATE,
    LOOSE_M,
    LOST_M,
    LOST_PERIODS,
    PAIR_S,
    RAY_SIGMA_M,
    SPEED_SIGMA,
    Track,
    TrackSettings,
    TrackStatus,
)
from rhot_fusion.schedule import FrameSchedule
from rhot_fusion.views.sightings import HandCoherence, Sightings, TrackingLimits

_DEPTH_MARKERS: Final = 1
"""Markers of a hand required to estimate its depth; in a grasp the patch is often the only one."""

# Candidate positions of unknown or misplaced markers, on which the newest views of two cameras agree.


class Candidates:
    """The newest views of M markers."""

    def __init__(
        self,
        cameras: Sequence[CameraModel],
        markers: int,
        coherence: HandCoherence,
        schedule: FrameSchedule,
        counts: Counter[str],
    ) -> None:
        """Start without views; increments `behind_cameras` and `gated` of counts."""
        self._cameras = list(cameras)
        self._coherence, self._schedule, self._counts = coherence, schedule, counts
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
        reach_s = min(PAIR_S, 1.6 * self._schedule.longest_period_s)
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
        volume_m: tuple[Vector3, Vector3],
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
        initial = from_views(views, t_s, velocity, SPEED_SIGMA)
        if initial is None:
            self._counts["behind_cameras"] += 1
            return None
        low, high = volume_m
        position = initial.mean[:3]
        others = alive.copy()
        others[marker] = False
        believable = (
            # Squared Mahalanobis distance (1 degree of freedom) up to which two views initialise a
            # marker: 4 sigma.
            initial.misfit <= 16.0 + 2.0 * (len(views) - 2)
            and bool(((position >= low) & (position <= high)).all())
            and bool(self._coherence.near(np.array([marker]), position[None], known, others)[0])
            # No marker is initialised closer to another one than this, metres.
            and not (np.linalg.norm(known[others] - position, axis=1) < 0.010).any()
        )
        self._counts["gated"] += not believable
        return initial if believable else None


@dataclass(frozen=True, slots=True)
class TrackedHand:
    """The markers of one hand.

    Attributes:
        index: (H,) indices among all markers.
        markers: the same as a list.
        place_of: index among the H markers, by index among all.
        base: index, among the H, of the patch on the back of the hand; −1 = none.
        across: indices, among the H, of the tips of little and index finger; None without either.
        beside_m: (H,) lateral distance of each finger's knuckle from the patch, towards the index finger, metres.
        reach_m: (H,) distance of the straight finger's tip from the point beside the patch where the finger begins
            (`roots`), metres; 0 for the thumb and for markers that are no fingertips.
        filter: of these markers.
        record: stored frames for smoothing; None without smoothing.
    """

    index: IndexArray
    markers: list[int]
    place_of: dict[int, int]
    base: int
    across: tuple[int, int] | None
    beside_m: list[float]
    reach_m: list[float]
    filter: JointFilter
    record: HandRecord | None

    @property
    def patch(self) -> int:
        """Index of the patch among all markers; −1 = none."""
        return self.markers[self.base] if self.base >= 0 else -1

    def of(self, sightings: Sightings, *, alone: bool) -> Sightings:
        """Return a frame's views of this hand; `alone` = it is the only hand of the rig."""
        return sightings if alone else sightings.chosen(np.isin(sightings.index, self.index))

    def roots(self, places: Sequence[Vector3], alive: Sequence[bool]) -> Sequence[Vector3]:
        """Return the points (H,) beside the patch where its fingers begin, from marker positions (H,).

        Fingers bend in parallel planes, so the lateral direction from there to the tip does not depend on the bend.
        Only positions of markers that are alive (H,) are used; the patch must be.
        """
        x, y, z = base = places[self.base]
        if self.across is None or not (alive[self.across[0]] and alive[self.across[1]]):
            return [base] * len(places)
        (x0, y0, z0), (x1, y1, z1) = (places[k] for k in self.across)
        i, j, k = x1 - x0, y1 - y0, z1 - z0
        scale = 1.0 / max(math.sqrt(i * i + j * j + k * k), 1e-6)
        sides = [scale * beside for beside in self.beside_m]
        return [(x + side * i, y + side * j, z + side * k) for side in sides]


class Acquisition:
    """Adds M markers to the filters of their hands and removes them.

    Attributes:
        limits: volume, and how long unseen markers are kept; may be replaced.
        tracks: (M,) of all markers.
        hand_of: per marker, its hand and its index among that hand's markers.
        begun: number of initialisations so far; filter states before and after one are not comparable.
    """

    def __init__(
        self,
        hands: Sequence[TrackedHand],
        cameras: Sequence[CameraModel],
        coherence: HandCoherence,
        schedule: FrameSchedule,
        limits: TrackingLimits,
        settings: TrackSettings,
        counts: Counter[str],
    ) -> None:
        """Start without markers; increments `behind_cameras` and `gated` of counts."""
        self.limits = limits
        self.hand_of = {int(m): (hand, k) for hand in hands for k, m in enumerate(hand.index)}
        self.tracks = [Track(len(cameras)) for _ in self.hand_of]
        self.begun = 0
        self._hands, self._cameras, self._schedule, self._settings = list(hands), list(cameras), schedule, settings
        self._candidates = Candidates(cameras, len(self.tracks), coherence, schedule, counts)

    def clear(self) -> None:
        """Discard all markers."""
        for track in self.tracks:
            track.end(len(self._cameras))
        self._candidates.clear()

    def add(
        self, camera: int, markers: Sequence[int], times_s: Sequence[float], xy: FloatArray, variances: Sequence[float]
    ) -> None:
        """Store a camera's newest views; see `Candidates`."""
        self._candidates.add(camera, markers, times_s, xy, variances)

    def is_free(self, marker: int, camera: int, t_s: float) -> bool:
        """Return whether a camera's view must not update the filter: the marker is unknown, or was just initialised."""
        hand, k = self.hand_of[marker]
        track = self.tracks[marker]
        if not hand.filter.state.alive[k]:
            return True
        if hand.filter.spread_m2[k] <= LOOSE_M**2 or self._is_recent(track.accepted_s[camera], t_s):
            return False
        # For a camera that sees the marker again, the prediction may be too far off for a linear update.
        near = self._candidates.near(marker, t_s)
        initial = self._initial_state(marker, near, t_s, hand.filter.velocity[k])
        if initial is not None and self._is_expected(hand, k, initial, t_s):
            self._begin(marker, initial, t_s, near, continues=True)
            return True
        return not self._is_recent(track.seen_s, t_s)

    def _is_expected(self, hand: TrackedHand, k: int, initial: InitialState, t_s: float) -> bool:
        """Return whether a marker can have moved to an initial state; rules out single false blobs."""
        state = hand.filter.predicted(max(t_s, hand.filter.state.t_s))
        rows = slice(3 * k, 3 * k + 3)
        away = initial.mean[:3] - state.mean[0, rows]
        S = state.covariance[rows, rows] + initial.covariance[:3, :3]
        return float(away @ np.linalg.solve(S, away)) <= GATE

    def try_start(self, marker: int, camera: int, t_s: float) -> None:
        """Try to initialise a marker from a view that updated no filter and the newest views of other cameras."""
        track = self.tracks[marker]
        hand, _ = self.hand_of[marker]
        alive = hand.filter.state.alive
        positions = hand.filter.position[alive]
        velocity = hand.filter.velocity[alive].mean(axis=0) if len(positions) else np.zeros(3)
        moment_s = max(t_s, hand.filter.state.t_s) if len(positions) else t_s
        near = self._candidates.near(marker, t_s)
        initial = self._initial_state(marker, near, moment_s, velocity)
        if initial is not None and track.status is not TrackStatus.TENTATIVE:
            if track.look_elsewhere():
                self._begin(marker, initial, moment_s, near)
        elif initial is None and set(near) == {camera} and len(positions) >= _DEPTH_MARKERS:
            gap_s = LOST_PERIODS * self._schedule.longest_period_s
            if track.see_alone(t_s, gap_s):
                middle = positions.mean(axis=0)
                behind_m = 0.0 if marker == hand.patch else BEHIND_M
                ray = on_ray(near[camera], middle, behind_m, RAY_SIGMA_M, velocity, SPEED_SIGMA)
                # Greatest distance from the centroid of its hand at which a marker is initialised
                # from one camera, metres; a hand's length.
                if np.linalg.norm(ray.mean[:3] - middle) <= 0.2:
                    self._begin(marker, ray, moment_s, near)

    def end(self, marker: int) -> None:
        """Remove a marker."""
        hand, k = self.hand_of[marker]
        if hand.filter.state.alive[k]:
            hand.filter.end(k)
            if hand.record is not None:
                hand.record.add_removal(hand.filter.state.t_s, k)
        self.tracks[marker].end(len(self._cameras))

    def forget(self, t_s: float) -> None:
        """Remove markers that are unseen and too uncertain, unseen for too long, or outside the volume."""
        (x0, y0, z0), (x1, y1, z1) = self.limits.volume_m
        hold_s, lost_m2 = self.limits.hold_s, LOST_M**2
        for hand in self._hands:
            known = hand.filter.state.alive.tolist()
            columns = hand.markers, known, hand.filter.position.tolist(), hand.filter.spread_m2
            for marker, alive, (x, y, z), spread_m2 in zip(*columns, strict=True):
                inside = x0 <= x <= x1 and y0 <= y <= y1 and z0 <= z <= z1
                if not alive:
                    continue
                seen_s = self.tracks[marker].seen_s
                # Visible markers are kept: slow unsynchronised cameras initialise them with a large covariance.
                lost = spread_m2 > lost_m2 and not self._is_recent(seen_s, t_s)
                if lost or not inside or t_s - seen_s > hold_s:
                    self.end(marker)

    def _begin(
        self, marker: int, initial: InitialState, t_s: float, views: dict[int, View], *, continues: bool = False
    ) -> None:
        """Add a marker; `continues` if the tracked marker can have moved there."""
        hand, k = self.hand_of[marker]
        state = hand.filter.state
        if t_s > state.t_s and state.alive.any():
            hand.filter.state = hand.filter.predicted(t_s)
        hand.filter.begin(k, initial.mean, initial.covariance, t_s)
        if hand.record is not None:
            hand.record.add_start(t_s, k, initial, views, continues=continues)
        newest_s = self._schedule.newest_s
        self.tracks[marker].begin(t_s, {camera: newest_s[camera] for camera in views}, self._settings)
        self.begun += 1

    def _initial_state(
        self, marker: int, near: dict[int, View], t_s: float, velocity: FloatArray
    ) -> InitialState | None:
        volume_m = self.limits.volume_m
        return self._candidates.initial_state(marker, list(near.values()), t_s, velocity, *self._positions(), volume_m)

    def _is_recent(self, then_s: float, t_s: float) -> bool:
        return t_s - then_s <= LOST_PERIODS * self._schedule.longest_period_s

    def _positions(self) -> tuple[FloatArray, BoolArray]:
        """Return the positions of all markers (M, 3), metres, and which (M,) are tracked."""
        count = len(self.tracks)
        known, alive = np.zeros((count, 3)), np.zeros(count, dtype=bool)
        for hand in self._hands:
            known[hand.index], alive[hand.index] = hand.filter.position, hand.filter.state.alive
        return known, alive


def hands_of(
    described: Mapping[str, PaintedMarker], measures: HandMeasures, cameras: Sequence[CameraModel], *, record: bool
) -> list[TrackedHand]:
    """Return the hands that wear the described markers; `record` keeps their frames."""
    names, markers = list(described), list(described.values())
    sides = np.array([marker.hand for marker in markers])
    hands = []
    for side in np.unique(sides):
        index = np.flatnonzero(sides == side)
        base = next((k for k, m in enumerate(index.tolist()) if markers[m].kind == "patch"), -1)
        joint = JointFilter(len(index), GATE)
        joints = [markers[m].joint for m in index.tolist()]
        ends = ("little_tip", "index_tip")
        across = (joints.index(ends[0]), joints.index(ends[1])) if set(ends) <= set(joints) else None
        beside_m, reach_m = [0.0] * len(index), [0.0] * len(index)
        if base >= 0:
            model = HandModel.from_file(measures, markers[int(index[0])].hand)
            # All angles zero: the flat open hand.
            flat = model.marker_positions(model.forward(np.eye(4), np.zeros((5, 4))), described)
            patch, *tips = (flat[names[int(index[k])]] for k in (base, *(across or ())))
            sense = np.sign(model.knuckles[1, 0] - model.knuckles[4, 0])
            aside = (tips[1] - tips[0]) / np.linalg.norm(tips[1] - tips[0]) if tips else np.zeros(3)
            fingers = {f"{name}_tip": row for row, name in enumerate(FINGERS)}
            for k, name in enumerate(joints):
                finger = fingers.get(name, -1)
                if finger >= 0:
                    beside_m[k] = float(sense * (model.knuckles[finger, 0] - patch[0]))
                if finger > 0:
                    away = flat[names[int(index[k])]] - patch
                    reach_m[k] = float(np.linalg.norm(away - beside_m[k] * aside))
        place_of = {marker: k for k, marker in enumerate(index.tolist())}
        kept = HandRecord(index, cameras) if record else None
        hands.append(TrackedHand(index, index.tolist(), place_of, base, across, beside_m, reach_m, joint, kept))
    return hands


def radii_of(markers: Mapping[str, PaintedMarker], measures: HandMeasures) -> FloatArray:
    """Return the radii (M,) of the painted fingertips, metres; 0 for markers of another kind."""
    radii = []
    for marker in markers.values():
        tip = marker.kind == "cap" and marker.joint.endswith("_tip")
        radii.append(
            float(HandModel.from_file(measures, marker.hand).radii[JOINTS.index(marker.joint)]) if tip else 0.0
        )
    return np.array(radii)
