"""Solver of one hand: initialisation, filtering, and blending of reappearing fingers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel, patch_outline
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import BoolArray, FloatArray, IntArray
from rhot.rig import IkConfig, MarkerConfig
from rhot_ik.fabrik.finger_chains import FabrikFingers
from rhot_ik.hand.blending import BlendSettings, blended, carried
from rhot_ik.hand.contact import Shape
from rhot_ik.hand.filter.evidence import CornerNoise, EvidenceModel, HandObservation
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.initialisation import HandInitialiser
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.process import HandState
from rhot_ik.hand.filter.settings import HandSettings
from rhot_ik.hand.filter.smoother import smoothed_states
from rhot_ik.hand.fingers.closed_form import AnalyticFingers
from rhot_ik.hand.fingers.geometry import FingerGeometry, marker_on_palm

__all__ = ["HandObservation", "HandSolution", "HandSolver"]

_NEVER_NS: Final = 2**62
"""Since when a tip has been known that is not: later than any sample."""


@dataclass(frozen=True, slots=True)
class HandSolution:
    """The hand at one moment.

    Attributes:
        T_rig_wrist: (4, 4) metres.
        angles: (5, 4) radians, inside the limits.
        positions: (26, 3) metres, rig frame, of all joints.
        orientations: (26, 4) unit quaternions x, y, z, w, rig frame.
        residual: (5,) metres between measured and modelled marker; NaN where there was no measurement.
        fingers_measured: (5,).
        palm_measured: whether the base marker was.
    """

    T_rig_wrist: FloatArray
    angles: FloatArray
    positions: FloatArray
    orientations: FloatArray
    residual: FloatArray
    fingers_measured: BoolArray
    palm_measured: bool


@dataclass(frozen=True, slots=True)
class HandTrack:
    """What is known of one hand after a sample.

    Attributes:
        t_ns: of the sample, rig clock.
        state: of the estimate.
        shown: (5, 4) radians, angles as they were shown.
        blends_s: (5,) for how much longer each finger is blended in, seconds.
        corner_noise: of the patch, as learned.
        corners_measured: whether the corners of the patch measured the palm's rotation.
        base_seen_ns, measured_ns: when the base marker was there last, and when anything was measured.
        measured: (5,) whether each finger was.
        sure: (5,) and whether well in all directions.
        known_since_ns: (5,) since when each has been known at all, without a break.
        seen: the sample.
        expected: the state as it was expected before the sample; none where the hand was taken up with it.
        lost_s: for how long the seen tips have missed the model.
        most_tips: how many tips, well known in all directions, met it at once so far; at least 1.
        laid: whether the hand was looked for by corners that fit its patch.
    """

    t_ns: int
    state: HandState
    shown: FloatArray
    blends_s: FloatArray
    corner_noise: CornerNoise
    corners_measured: bool
    base_seen_ns: int
    measured_ns: int
    measured: BoolArray
    sure: BoolArray
    known_since_ns: IntArray
    seen: HandObservation
    expected: HandState | None = None
    lost_s: float = 0.0
    most_tips: int = 1
    laid: bool = True


class HandSolver:
    """Solves one hand sample by sample; everything it knows of time comes with the samples.

    Args:
        model: the hand.
        markers: all markers of the rig; those of other hands are ignored.
        base: name of the marker on the back of this hand.
        config: which finger solver, and how long a hand is held.
        viewpoint: (3,) metres, rig frame: where the cameras are, all in all; the rig's origin when not given.
        settings: numbers of the estimate.
    """

    def __init__(
        self,
        model: HandModel,
        markers: Mapping[str, MarkerConfig],
        base: str,
        config: IkConfig,
        viewpoint: FloatArray | None = None,
        settings: HandSettings | None = None,
    ) -> None:
        self._settings = settings = settings or HandSettings()
        self._geometry = FingerGeometry.of(model, markers)
        marker = markers[base]
        base_offset = marker_on_palm(model, base, marker)
        outline = patch_outline(marker) if marker.kind == "patch" else None
        known = np.array([self._geometry.markers.get(name) in model.marker_offsets_m for name in FINGERS] + [False])
        known[5] = base in model.marker_offsets_m
        self._evidence = EvidenceModel(outline, settings)
        self._kinematics = HandKinematics(self._geometry)
        self._filter = HandFilter(self._geometry, base_offset, settings, known)
        eye = np.zeros(3) if viewpoint is None else viewpoint
        self._initialiser = HandInitialiser(self._filter, self._evidence, base_offset, eye)
        self._analytic = AnalyticFingers(self._geometry)
        self._fabrik = FabrikFingers(self._geometry)
        self.config = config
        self._blend = BlendSettings()
        self._track: HandTrack | None = None
        self._solution: HandSolution | None = None
        self._person: tuple[FloatArray, FloatArray] | None = None

    @property
    def geometry(self) -> FingerGeometry:
        """The hand and where its markers are painted."""
        return self._geometry

    @property
    def track(self) -> HandTrack | None:
        """What is known after the last sample; none when that is nothing."""
        return self._track

    @property
    def solution(self) -> HandSolution | None:
        """What the last sample led to."""
        return self._solution

    def solve(self, seen: HandObservation, shapes: Sequence[Shape] = ()) -> HandSolution | None:
        """Return the hand after one more sample, or None when too little is known to show one.

        Args:
            seen: the sample.
            shapes: things that fingers may close round, rig frame.
        """
        before = self._track
        if before is not None:
            dt_s = (seen.t_ns - before.t_ns) / 1e9
            if -self._settings.late_s < dt_s < 0.0:
                return None
            if not 0.0 <= dt_s < self._settings.gap_s or self._is_over(seen, before):
                before = None
        self._track = self._initialised(seen) if before is None else self._continued(before, seen, shapes)
        if self._track is None:
            self._solution = None
        else:
            self._person = self._track.state.personal_parameters
            self._solution = self._solution_of(self._track)
        return self._solution

    def _is_over(self, seen: HandObservation, before: HandTrack) -> bool:
        """Tell whether the palm, or everything, has been gone for longer than a hand is held."""
        oldest_ns = seen.t_ns - round(self.config.hold_s * 1e9)
        base_gone = seen.base is None and before.base_seen_ns < oldest_ns
        all_gone = not seen.measured_any and before.measured_ns < oldest_ns
        return base_gone or all_gone

    def _initialised(self, seen: HandObservation) -> HandTrack | None:
        found = self._initialiser.find(seen, self._person)
        if found is None or not seen.measured_any:
            return None
        state, evidence = found
        measured = seen.tips_seen & seen.tips_measured
        return HandTrack(
            t_ns=seen.t_ns,
            state=state,
            shown=self._angles(state, seen, state.angles.reshape(5, 4)),
            blends_s=np.zeros(5),
            corner_noise=evidence.corner_noise,
            corners_measured=evidence.rotation is not None,
            laid=evidence.rotation is not None,
            base_seen_ns=seen.t_ns,
            measured_ns=seen.t_ns,
            measured=measured,
            sure=measured & _known_to(seen, self._blend.sure_m),
            known_since_ns=np.where(measured, seen.t_ns, _NEVER_NS),
            seen=seen,
        )

    def _continued(self, before: HandTrack, seen: HandObservation, shapes: Sequence[Shape]) -> HandTrack:
        dt_s = (seen.t_ns - before.t_ns) / 1e9
        measured = seen.tips_seen & seen.tips_measured
        expected = self._filter.predict(before.state, dt_s, ~measured, holds=len(shapes) > 0)
        evidence = self._evidence.assess(seen, self._filter.patch_rotation(expected), before.corner_noise)
        updated = self._filter.update(expected, evidence, shapes=shapes)
        laid = before.laid or (evidence.rotation is not None and bool(measured.any()))
        if before.laid or not laid:
            state, lost_s = self._reinitialised_if_lost(before, updated, seen, int(np.count_nonzero(measured)), dt_s)
        else:
            # A palm that was taken up without the corners of its patch was guessed to point to its tips.
            state, lost_s = self._reinitialised(updated, seen), 0.0
        angles = self._angles(state, seen, before.shown)
        sure = measured & _known_to(seen, self._blend.sure_m)
        known = measured & _known_to(seen, self._blend.known_m)
        since_ns = np.where(known, np.minimum(before.known_since_ns, seen.t_ns), _NEVER_NS)
        left_s = np.where(sure & before.sure, before.blends_s, self._blend.lasts_s)
        # Fingers that go with another palm than before are led in from nowhere.
        shown, left_s = (before.shown, left_s) if state is updated else (angles, np.zeros(5))
        if left_s.any():
            moved = (state.angles - before.state.angles).reshape(5, 4)
            led = (left_s > 0.0) & (seen.t_ns - since_ns > 1e9 * self._blend.settles_s)
            shown = carried(self._kinematics, shown, moved, led, dt_s, self._blend)
            shown = self._filter.legal(shown.reshape(-1)).reshape(5, 4)
        shown, left_s = blended(self._kinematics, angles, shown, left_s, dt_s, self._blend)
        return HandTrack(
            t_ns=seen.t_ns,
            state=state,
            shown=shown,
            blends_s=left_s,
            corner_noise=evidence.corner_noise,
            corners_measured=evidence.rotation is not None,
            laid=laid,
            base_seen_ns=before.base_seen_ns if seen.base is None else seen.t_ns,
            measured_ns=seen.t_ns if seen.measured_any else before.measured_ns,
            measured=measured,
            sure=sure,
            known_since_ns=since_ns,
            seen=seen,
            expected=expected if state is updated else None,
            lost_s=lost_s,
            most_tips=max(before.most_tips, int(np.count_nonzero(sure)) if lost_s == 0.0 else 1),
        )

    def _reinitialised_if_lost(
        self, before: HandTrack, state: HandState, seen: HandObservation, measured: int, dt_s: float
    ) -> tuple[HandState, float]:
        """Return the state, or a better one when the tips have missed the model for too long, and for how long."""
        # What so many tips have met at once is not overturned by fewer: a few leave a patch two ways round.
        if measured < before.most_tips:
            return state, before.lost_s
        if state.mean_residual_m < self._settings.lost_m:
            return state, 0.0
        # The further they are off, the less there is to wait for: 150 mm are a palm taken up the wrong way round.
        haste = (state.mean_residual_m / self._settings.lost_m) ** 2
        lost_s = before.lost_s + dt_s * min(haste, self._settings.lost_haste)
        if lost_s < self._settings.lost_s:
            return state, lost_s
        return self._reinitialised(state, seen), 0.0

    def _reinitialised(self, state: HandState, seen: HandObservation) -> HandState:
        """Return the state, or one that explains the sample far better."""
        # What was learned of the person on a hand that was taken up wrongly is wrong as well.
        found = self._initialiser.find(seen)
        if found is None or self._initialiser.cost(*found) > 0.5 * self._initialiser.cost(state, found[1]):
            return state
        return found[0]

    def smoothed(self, tracks: Sequence[HandTrack]) -> list[HandSolution]:
        """Return the hand at each of a row of samples, in order of time, as all of them together show it."""
        states = smoothed_states(self._filter, tracks)
        solutions = []
        for track, state in zip(tracks, states, strict=True):
            shown = self._angles(state, track.seen, track.shown)
            solutions.append(self._solution_of(dataclasses.replace(track, state=state, shown=shown)))
        return solutions

    def _solution_of(self, track: HandTrack) -> HandSolution:
        state, seen = track.state, track.seen
        shorter_palm_m = -self._settings.palm_share * float(state.person[2])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = state.R, state.p - shorter_palm_m * state.R[:, 2]
        positions, orientations, modelled = self._kinematics.pose(
            state.R, state.p, track.shown.reshape(-1), state.longer, shorter_palm_m
        )
        gaps = modelled - seen.tips
        # NaN where a tip was not seen, as it came.
        residual = np.sqrt((gaps * gaps).sum(-1))
        palm_measured = seen.base is not None and seen.base_measured
        return HandSolution(T, track.shown, positions, orientations, residual, track.measured, palm_measured)

    def _angles(self, state: HandState, seen: HandObservation, shown: FloatArray) -> FloatArray:
        """Return the angles (5, 4) of the fingers; of those not measured as the whole hand's estimate has them."""
        estimated = state.angles.reshape(5, 4)
        if self.config.solver == "filter":
            return estimated
        measured = seen.tips_seen & seen.tips_measured
        if not measured.any():
            return estimated
        resting = self._geometry.marker_points(estimated)
        local = self._filter.in_model((seen.tips - state.p) @ state.R, state.longer)
        local = np.where(measured[:, None], local, resting)
        if self.config.solver == "fabrik":
            solved, _ = self._fabrik.solve(local, shown, self.config.tolerance_m, self.config.max_iterations)
        else:
            solved = self._analytic.solve(local).angles
        return np.where(measured[:, None], solved, estimated)


def _known_to(seen: HandObservation, sigma_m: float) -> BoolArray:
    """Tell which tips (5,) are known to so much in all directions together."""
    if seen.tip_covariances is None:
        return np.ones(5, dtype=np.bool_)
    known: BoolArray = np.trace(seen.tip_covariances, axis1=1, axis2=2) < sigma_m**2
    return known
