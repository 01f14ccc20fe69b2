"""Fusion by filtering: each camera's frame moves all markers of a hand when it comes, each view at its own row's time."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from rhot.camera import CameraModel
from rhot.hand import HandModel
from rhot.messages import HandPose
from rhot.rig import FusionConfig, Rig
from rhot.rig.quality import pair_epipolar_p95_px
from rhot.skeleton import JOINTS
from rhot_fusion.coherence import HandCoherence
from rhot_fusion.epipolar import EpipolarModel
from rhot_fusion.filter.agreement import CameraAgreement
from rhot_fusion.filter.birth import Birth, View, from_views, on_ray
from rhot_fusion.filter.joint import JointFilter, State, Views
from rhot_fusion.filter.smoother import Event, Frame, Node, smooth
from rhot_fusion.filter.noise import CameraNoise, stated_px
from rhot_fusion.filter.paint import Paint
from rhot_fusion.filter.settings import DEFAULT, FilterSettings
from rhot_fusion.filter.systematic import Systematic
from rhot_fusion.filter.tracks import Belief, Track, state_of
from rhot_fusion.schedule import Schedule
from rhot_fusion.sightings import BoolArray, FloatArray, IndexArray, Outcome, Sightings

_RAY_VIEWS = 3
"""Views in a row of one camera that put a marker on its ray."""
_BRIDGED = 1.6
"""Looked back at, a camera shows a marker if it did so this many periods before and after."""
_FEWEST = 3
"""Markers of a hand that tell where it is."""


@dataclass(slots=True)
class _Hand:
    """The markers of one hand.

    Attributes:
        index: (H,) of them among all markers.
        filter: theirs.
    """

    index: IndexArray
    filter: JointFilter
    record: list[Frame]


class FilterTracker:
    """The `filter` method; see `Tracker`."""

    def __init__(
        self, rig: Rig, cameras: Sequence[CameraModel], config: FusionConfig, counts: Counter[str], *,
        record: bool = False, settings: FilterSettings = DEFAULT,
    ) -> None:
        """Build for a rig.

        Of counts it takes `measured`, `refused`, `late_frames`, `too_late`, `gated` and `outside_volume`.
        """
        self._cameras, self._config, self._counts, self._settings = list(cameras), config, counts, settings
        names, markers = list(rig.cameras), rig.config.markers
        self._count = len(markers)
        sides = np.array([marker.hand for marker in markers.values()])
        self._hands = [
            _Hand(np.flatnonzero(sides == side), JointFilter(int((sides == side).sum()), settings.motion, settings.track.gate), [])
            for side in np.unique(sides)
        ]
        self._record = record
        self._hand_of = {int(m): (hand, k) for hand in self._hands for k, m in enumerate(hand.index)}
        self._coherence = HandCoherence(markers, rig.hand.length_m)
        self.noise = CameraNoise(cameras, settings.noise, stated_px(names, rig.quality, settings.noise), rig.calibrated)
        stated = [pair_epipolar_p95_px(rig.quality, a, b) or 0.0 for a, b in combinations(names, 2)]
        self.agreement = CameraAgreement(
            cameras, self._count, config.epipolar_limit_px, rig.calibrated, max(stated, default=0.0)
        )
        self._paint = Paint(cameras, _radii(rig), settings.paint)
        self._systematic = Systematic(
            cameras, rig.quality, float(self.noise.calibration_px.max()), _radii(rig), settings.systematic
        )
        self._base = _bases(rig)
        self._time_variance = 0.0 if rig.calibrated else settings.noise.uncalibrated_s**2
        self._schedule = Schedule([1.0 / camera.rate_hz for camera in rig.config.cameras.values()])
        self.tracks = [Track(len(cameras)) for _ in markers]
        self._history: deque[tuple[Sightings, list[State]]] = deque(maxlen=32)
        self._newest: list[dict[int, View]] = [{} for _ in markers]
        self.clear()

    @property
    def epipolar(self) -> EpipolarModel:
        """What was learnt of the cameras since they were calibrated."""
        return self.agreement.epipolar

    @epipolar.setter
    def epipolar(self, model: EpipolarModel) -> None:
        self.agreement.epipolar = model

    def configure(self, config: FusionConfig) -> None:
        """Change the settings."""
        self._config = config
        self.epipolar.set_limit(config.epipolar_limit_px)

    def learn(self, hand: HandPose) -> None:
        """Take a hand that inverse kinematics made of earlier points."""

    def clear(self) -> None:
        """Forget all markers; what was learnt of the cameras stays."""
        for hand in self._hands:
            hand.filter.clear()
        for track in self.tracks:
            track.end()
        for newest in self._newest:
            newest.clear()
        self._history.clear()
        self._schedule.clear()
        self.agreement.clear()
        self._paint.clear()

    def advance(self, sightings: Sightings) -> Outcome | None:
        """Take one frame; return the markers at its moment, or None when another frame of the same moment is due."""
        self._schedule.arrived(sightings.camera, sightings.t_s)
        self.agreement.watch(sightings, self._schedule)
        sightings = replace(sightings, xy=self.agreement.correct(sightings.camera, sightings.xy))
        self._in_order(sightings)
        moment_s = self._schedule.newest_moment()
        return None if moment_s is None else self.outcome(moment_s)

    def _in_order(self, sightings: Sightings) -> None:
        """Take a frame; where newer ones were taken, go back and take them again."""
        newer: list[Sightings] = []
        if self._history and self._history[-1][0].t_s - sightings.t_s > self._settings.track.replay_s:
            self._counts["too_late"] += 1
            return
        while self._history and self._history[-1][0].t_s > sightings.t_s:
            later, states = self._history.pop()
            newer.append(later)
            for hand, state in zip(self._hands, states, strict=True):
                # Markers that began or ended since then stay as they are.
                if (hand.filter.state.alive == state.alive).all():
                    hand.filter.state = state
        self._counts["late_frames"] += bool(newer)
        self._take(sightings)
        for later in reversed(newer):
            self._take(later, again=True)

    def _take(self, sightings: Sightings, *, again: bool = False) -> None:
        """Let a frame move the markers."""
        self._history.append((sightings, [hand.filter.state for hand in self._hands]))
        variance = self.noise.variance(sightings.camera)
        placed = np.zeros(self._count, dtype=bool)
        if not again:
            for row, marker in enumerate(sightings.index.tolist()):
                self._newest[marker][sightings.camera] = View(
                    self._cameras[sightings.camera], float(sightings.times_s[row]), sightings.xy[row], variance
                )
        for hand in self._hands:
            here = np.flatnonzero(np.isin(sightings.index, hand.index)) if len(self._hands) > 1 else _all(sightings)
            if not again:
                if self._record:
                    self._note_frame(hand, sightings, here)
                for marker in self._loose(hand, sightings.index[here]):
                    if not self._is_recent(self.tracks[marker].accepted_s[sightings.camera], sightings.t_s):
                        placed[marker] = self._place_anew(marker, sightings.t_s)
            free = np.array([placed[m] or self._is_lost(hand, m, sightings.t_s) for m in sightings.index[here].tolist()])
            self._update(hand, sightings, here[~free] if len(here) else here, variance, again)
        if again:
            return
        for marker in sightings.index.tolist():
            track = self.tracks[marker]
            if not placed[marker] and (
                track.belief is Belief.ABSENT or track.accepted_s[sightings.camera] != sightings.t_s
            ):
                self._seek(marker, sightings.camera, sightings.t_s)

    def _loose(self, hand: _Hand, index: IndexArray) -> list[int]:
        """Return those of markers (N,) that are known, but not well enough for a filter."""
        count = len(hand.index)
        variances = hand.filter.state.covariance.reshape(2 * count, 3, 2 * count, 3)
        limit = self._settings.track.loose_m**2
        return [
            marker
            for marker in index.tolist()
            if float(np.trace(variances[k := self._hand_of[marker][1], :, k])) > limit
        ]

    def _is_lost(self, hand: _Hand, marker: int, t_s: float) -> bool:
        """Tell whether nothing has shown a marker for so long that one view says nothing of its place."""
        return not self._is_recent(self.tracks[marker].seen_s, t_s) and bool(self._loose(hand, np.array([marker])))

    def _is_recent(self, then_s: float, t_s: float) -> bool:
        return t_s - then_s <= self._settings.track.lost_periods * self._schedule.longest_period_s

    def _place_anew(self, marker: int, t_s: float) -> bool:
        """Put a marker where two cameras' newest views agree; tell whether they do."""
        hand, k = self._hand_of[marker]
        near = self._near(marker, t_s)
        birth = self._together(marker, list(near.values()), t_s, hand.filter.velocity[k])
        if birth is not None:
            self._begin(marker, birth, t_s, list(near), min(view.t_s for view in near.values()))
        return birth is not None

    def _near(self, marker: int, t_s: float) -> dict[int, View]:
        """Return, by camera, the newest views of a marker that were taken about a moment."""
        settings = self._settings.track
        reach_s = min(settings.pair_s, settings.pair_periods * self._schedule.longest_period_s)
        return {camera: view for camera, view in self._newest[marker].items() if abs(t_s - view.t_s) <= reach_s}

    def _update(self, hand: _Hand, sightings: Sightings, here: IndexArray, variance: float, again: bool) -> None:
        local = np.searchsorted(hand.index, sightings.index[here])
        state = hand.filter.state
        known = state.alive[local]
        here, local = here[known], local[known]
        t_s = max(sightings.t_s, state.t_s)
        if not len(here):
            return
        camera = self._cameras[sightings.camera]
        depth = np.maximum(hand.filter.place[local] @ camera.R_camera_rig[2] + camera.t_camera_rig[2], 0.1)
        shift, doubt = self._paint.correct(
            sightings.camera, sightings.index[here], sightings.t_s, sightings.area_px[here], depth
        )
        base = self._base.get(int(hand.index[0]), -1)
        if base >= 0 and hand.filter.state.alive[k_base := int(np.searchsorted(hand.index, base))]:
            shift += self._paint.along(camera, sightings.index[here], hand.filter.place[local], hand.filter.place[k_base])
        slack = self._paint.slack(sightings.camera, sightings.area_px[here])
        variances = np.zeros((len(here), 2, 2))
        variances[:, 0, 0] = variances[:, 1, 1] = variance + doubt * doubt
        if self._time_variance:
            pace = hand.filter.velocity[local] @ camera.R_camera_rig[:2].T / max(state.mean[0, 2], 0.1)
            variances += self._time_variance * pace[:, :, None] * pace[:, None, :]
        views = Views(camera, local, sightings.times_s[here] - t_s, sightings.xy[here] + shift, variances, slack)
        innovation, _ = hand.filter.step(t_s, views)
        if again:
            return
        if self._record:
            record = hand.record[-1]
            rows = np.searchsorted(record.views.index, local)
            record.taken[rows] = innovation.accepted
            record.views.xy[rows] = views.xy
            record.views.variance[rows] = (doubt * doubt)[:, None, None] * np.eye(2)
        self.noise.learn(sightings.camera, innovation)
        self._counts["refused"] += len(here) - int(np.count_nonzero(innovation.accepted))
        for marker, accepted in zip(hand.index[local].tolist(), innovation.accepted.tolist(), strict=True):
            if accepted:
                self.tracks[marker].accept(sightings.camera, sightings.t_s, self._settings.track)
            elif self.tracks[marker].belief is Belief.TENTATIVE:
                self._end(marker)

    def _end(self, marker: int) -> None:
        hand, k = self._hand_of[marker]
        if hand.filter.state.alive[k]:
            hand.filter.end(k)
            self._note(hand, Event(hand.filter.state.t_s, k, None))
        self.tracks[marker].end()

    def _note(self, hand: _Hand, event: Event) -> None:
        if self._record and hand.record:
            hand.record[-1].events.append(event)

    def _note_frame(self, hand: _Hand, sightings: Sightings, here: IndexArray) -> None:
        views = Views(
            self._cameras[sightings.camera],
            np.searchsorted(hand.index, sightings.index[here]),
            sightings.times_s[here] - sightings.t_s,
            sightings.xy[here],
            np.zeros((len(here), 2, 2)),
            np.zeros(len(here)),
        )
        hand.record.append(Frame(sightings.t_s, sightings.camera, views, np.zeros(len(here), dtype=bool), []))

    def smoothed(self) -> list[Outcome]:
        """Return the markers at the moments of all frames since the last `clear`, as the whole recording shows them."""
        every: list[list[Node]] = []
        for hand in self._hands:
            frames = sorted(hand.record, key=lambda frame: frame.t_s)
            for frame in frames:
                own = frame.views.variance + self.noise.variance(frame.camera) * np.eye(2)
                frame.views = replace(frame.views, variance=own)
            every.append(smooth(frames, len(hand.index), self._settings))
        return self._outcomes(every)

    def _outcomes(self, every: list[list[Node]]) -> list[Outcome]:
        outcomes = []
        around = [self._around(camera, every[0]) for camera in range(len(self._cameras))]
        for place, node in enumerate(every[0]):
            position = np.full((self._count, 3), np.nan)
            covariance = np.zeros((self._count, 3, 3))
            seen = np.zeros((len(self._cameras), self._count), dtype=bool)
            for hand, nodes in zip(self._hands, every, strict=True):
                position[hand.index] = nodes[place].place
                covariance[hand.index] = nodes[place].covariance[:, :3, :3]
                for camera, sides in enumerate(around):
                    before, after = ([nodes[k].shown for k in side] for side in sides[place])
                    near = [nodes[k].shown for side in sides[place] for k in side if self._is_near(camera, nodes[k], node)]
                    if near:
                        seen[camera, hand.index] = np.any(near, axis=0)
                    if before and after:
                        seen[camera, hand.index] |= np.any(before, axis=0) & np.any(after, axis=0)
            outcomes.append(_outcome(node.t_s, position, covariance, seen, self._systematic))
        return outcomes

    def _is_near(self, camera: int, one: Node, other: Node) -> bool:
        return abs(one.t_s - other.t_s) <= 0.75 * self._schedule.period_s(camera)

    def _around(self, camera: int, nodes: list[Node]) -> list[tuple[list[int], list[int]]]:
        """Return for each node those of a camera just before and just after it: a frame may be lost between them."""
        own = np.array([place for place, node in enumerate(nodes) if node.camera == camera], dtype=np.intp)
        times = np.array([nodes[place].t_s for place in own])
        reach_s = _BRIDGED * self._schedule.period_s(camera)
        sides = []
        for node in nodes:
            first, middle = np.searchsorted(times, [node.t_s - reach_s, node.t_s])
            end, last = np.searchsorted(times, [node.t_s, node.t_s + reach_s], side="right")
            sides.append((own[first:end].tolist(), own[middle:last].tolist()))
        return sides

    def _fresh_s(self) -> list[float]:
        """Return how long a view of each camera (C,) counts, seconds."""
        settings = self._settings.track
        return [
            max(settings.fresh_periods * self._schedule.period_s(camera), settings.fresh_s)
            for camera in range(len(self._cameras))
        ]

    def _seek(self, marker: int, camera: int, t_s: float) -> None:
        """Look whether a view that moved no marker and another camera's newest one agree on a place."""
        settings, track = self._settings.track, self.tracks[marker]
        hand, k = self._hand_of[marker]
        place = hand.filter.place[hand.filter.state.alive]
        velocity = hand.filter.velocity[hand.filter.state.alive].mean(axis=0) if len(place) else np.zeros(3)
        moment_s = max(t_s, hand.filter.state.t_s) if len(place) else t_s
        near = self._near(marker, t_s)
        recent = list(near.values())
        birth = self._together(marker, recent, moment_s, velocity)
        if birth is None:
            if track.belief is Belief.ABSENT and len(recent) == 1 and len(place) >= _FEWEST:
                track.alone += 1
                if track.alone >= _RAY_VIEWS:
                    ray = on_ray(near[camera], place.mean(axis=0), velocity, settings.ray_sigma_m, settings.speed_sigma)
                    self._begin(marker, ray, moment_s, [camera], t_s)
            return
        if track.belief is Belief.BELIEVED:
            track.elsewhere += 1
            if track.elsewhere < settings.relocations:
                return
        self._begin(marker, birth, moment_s, list(near), min(v.t_s for v in recent))

    def _begin(self, marker: int, birth: Birth, t_s: float, cameras: list[int], first_s: float) -> None:
        hand, k = self._hand_of[marker]
        state = hand.filter.state
        if t_s > state.t_s and state.alive.any():
            hand.filter.state = hand.filter.predicted(t_s)
        hand.filter.begin(k, birth.mean, birth.covariance, t_s)
        self._note(hand, Event(t_s, k, birth, first_s))
        self.tracks[marker].begin(t_s, cameras, self._settings.track)
        self._history.clear()

    def _together(self, marker: int, views: list[View], t_s: float, velocity: FloatArray) -> Birth | None:
        """Return what views of different cameras say of a marker, if they agree and it can be there."""
        if len(views) < 2:
            return None
        settings = self._settings.track
        birth = from_views(views, t_s, velocity, settings.speed_sigma)
        if birth is None:
            self._counts["behind_cameras"] += 1
            return None
        low, high = self._config.volume_m
        place = birth.mean[:3]
        known, alive = self._places()
        alive[marker] = False
        believable = (
            birth.misfit <= settings.birth_gate + 2.0 * (len(views) - 2)
            and bool(((place >= low) & (place <= high)).all())
            and bool(self._coherence.near(np.array([marker]), place[None], known, alive)[0])
            and not (np.linalg.norm(known[alive] - place, axis=1) < settings.occupied_m).any()
        )
        self._counts["gated"] += not believable
        return birth if believable else None

    def _places(self) -> tuple[FloatArray, BoolArray]:
        """Return where all markers (M, 3) are, and which (M,) are known."""
        known, alive = np.zeros((self._count, 3)), np.zeros(self._count, dtype=bool)
        for hand in self._hands:
            known[hand.index], alive[hand.index] = hand.filter.place, hand.filter.state.alive
        return known, alive

    def _forget(self, t_s: float) -> None:
        """End markers that nothing has shown for a while, or that left the volume."""
        low, high = np.array(self._config.volume_m)
        for hand in self._hands:
            for k in np.flatnonzero(hand.filter.state.alive).tolist():
                marker = int(hand.index[k])
                place = hand.filter.place[k]
                if t_s - self.tracks[marker].seen_s > self._config.hold_s or (place < low).any() or (place > high).any():
                    self._end(marker)

    def outcome(self, t_s: float) -> Outcome:
        """Return the markers at a moment that is not before the filter's."""
        self._forget(t_s)
        fresh = [
            t_s - seen_s <= lasts for seen_s, lasts in zip(self._schedule.newest_s, self._fresh_s(), strict=True)
        ]
        then_s = t_s + self._config.predict_s
        position = np.full((self._count, 3), np.nan)
        covariance = np.zeros((self._count, 3, 3))
        seen = np.zeros((len(self._cameras), self._count), dtype=bool)
        for hand in self._hands:
            state = hand.filter.predicted(then_s)
            place = state.mean[0].reshape(-1, 3)
            own = state.covariance.reshape(2, len(place), 3, 2, len(place), 3)[0][:, :, 0]
            for k, marker in enumerate(hand.index.tolist()):
                if self.tracks[marker].belief is Belief.BELIEVED:
                    position[marker], covariance[marker] = place[k], own[k, :, k]
                    seen[:, marker] = self.tracks[marker].views(self._schedule.newest_s, fresh)
        outcome = _outcome(then_s, position, covariance, seen, self._systematic)
        self._counts["measured"] += sum(outcome.measured)
        return outcome


def _outcome(
    t_s: float, position: FloatArray, covariance: FloatArray, seen: BoolArray, systematic: Systematic
) -> Outcome:
    """Return markers at positions (M, 3), NaN = absent, with covariances (M, 3, 3), seen by cameras (C, M)."""
    covariance = covariance + systematic.covariance(position)
    views = seen.sum(axis=0)
    measured = (views >= 2) & np.isfinite(position[:, 0])
    sigma = np.sqrt(np.maximum(np.trace(covariance, axis1=1, axis2=2), 0.0))
    return Outcome(
        t_s,
        position.tolist(),
        sigma.tolist(),
        views.tolist(),
        measured.tolist(),
        seen.tolist(),
        covariance,
        [state_of(count) for count in views.tolist()],
    )


def _all(sightings: Sightings) -> IndexArray:
    return np.arange(len(sightings.index))


def _radii(rig: Rig) -> FloatArray:
    """Return the radii (M,) of the painted fingertips, metres; 0 for markers of another kind."""
    radii = []
    for marker in rig.config.markers.values():
        tip = marker.kind == "cap" and marker.joint.endswith("_tip")
        radii.append(float(HandModel.from_file(rig.hand, marker.hand).radii[JOINTS.index(marker.joint)]) if tip else 0.0)
    return np.array(radii)


def _bases(rig: Rig) -> dict[int, int]:
    """Return, by the first marker of each hand, the marker that is a patch on its back."""
    markers = list(rig.config.markers.values())
    sides = [marker.hand for marker in markers]
    return {sides.index(marker.hand): k for k, marker in enumerate(markers) if marker.kind == "patch"}
