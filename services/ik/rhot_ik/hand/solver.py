"""Solver of one hand: initialisation and filtering."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final, Protocol

import numpy as np

from rhot.anatomy.hand import HandModel, patch_outline
from rhot.anatomy.markers import PaintedMarker
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.rotations import rotation_x, rotation_z
from rhot.plugins import load_plugin
from rhot_ik.hand.closed_form import FingerGeometry, marker_on_palm
from rhot_ik.hand.contact import GraspContact, Shape
from rhot_ik.hand.filter.evidence import Evidence, EvidenceModel, HandObservation
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.process import ANGLES, ERROR_LASTS_S, HandState
from rhot_ik.hand.filter.smoother import smoothed_states
from rhot_ik.hand.filter.uncertainty import joint_variances
from rhot_ik.hand.track import HandSolution, HandTrack

_WELL_MEASURED_M: Final = 0.01
"""A marker with a larger standard deviation says little of the palm: only one camera sees it."""

_LOST_S: Final = 0.3
"""When the seen tips miss the model by more than wrong proportions explain for this long, the hand is looked for
again: a wild marker lasts no longer."""
_QUARTER_TURN: Final = 20.0
"""A palm whose patch would fit this much better a quarter turn off (difference of two chi-squares: odds of e¹⁰) is
turned.
"""

# Initialisation of a hand from a single sample.

_ROLLS_DEG: Final = (0.0, 60.0, -60.0, 120.0, -120.0, 180.0)
_PITCHES_DEG: Final = (5.0, 40.0)
"""The tips usually hang below the plane of the palm, so the palm is pitched up from their direction."""
_REFINED: Final = 3
_TURNED_AWAY_COST: Final = 1e4
"""A flat patch that is seen faces the cameras: cost of the square of how far its normal points away."""


class HandInitialiser:
    """Finds the state that explains one sample best: many guesses, each refined.

    Args:
        hand_filter: of the hand.
        evidence: how points are trusted.
        base_offset: (3,) metres: the base marker's centre in the wrist frame.
        viewpoint: (3,) metres, rig frame: where the cameras are, all in all.
    """

    def __init__(
        self, hand_filter: HandFilter, evidence: EvidenceModel, base_offset: FloatArray, viewpoint: FloatArray
    ) -> None:
        self._filter = hand_filter
        self._evidence = evidence
        self._base_offset = base_offset
        self._viewpoint = viewpoint

    def find(
        self, seen: HandObservation, person: tuple[FloatArray, FloatArray] | None = None
    ) -> tuple[HandState, Evidence] | None:
        """Return the best state and the evidence it was judged by; None without the base or a tip seen well.

        `person` is what is known of the hand from before, see `HandState.personal_parameters`.
        """
        # What is only bridged may have been anything; a measured tip tells one end of the patch from the other.
        visible = seen.tips_seen & seen.tips_measured
        well = visible if seen.tips_certain is None else visible & seen.tips_certain
        if seen.base is None or not well.any():
            return None
        direction = seen.tips[visible].mean(axis=0) - seen.base
        if direction @ direction < 1e-6:
            return None
        by_patch = self._on_patch(seen, seen.base, visible, person)
        if by_patch:
            _, best, evidence = min(by_patch, key=lambda item: item[0])
            return best, evidence
        points = self._evidence.assess(seen, None)
        tried = []
        for R in self._facing(guesses(direction), seen.base):
            start = self._filter.start(R, seen.base - R @ self._base_offset, None, person, ~visible)
            state = self._filter.update(start, points)
            tried.append((self.cost(state, points), state))
        refined = []
        for _, state in sorted(tried, key=lambda item: item[0])[:_REFINED]:
            evidence = self._evidence.assess(seen, state.R)
            final = self._filter.update(self._filter.start(state.R, state.p, state.angles, person), evidence, steps=4)
            refined.append((self.cost(final, evidence), final, evidence))
        _, best, evidence = min(refined, key=lambda item: item[0])
        return best, evidence

    def quarter_turned(self, state: HandState, seen: HandObservation) -> HandState | None:
        """Return the better of the two states with the palm a quarter turn off on its patch; None without a tip."""
        visible = seen.tips_seen & seen.tips_measured
        if seen.base is None or not visible.any():
            return None
        # Palms whose sideways axes are less parallel than this (cosine) lie a quarter turn apart, not half a
        # turn or none.
        turned = [
            (cost, found)
            for cost, found, _ in self._on_patch(seen, seen.base, visible, None)
            if abs(found.R[:, 0] @ state.R[:, 0]) < 0.5
        ]
        return min(turned, key=lambda item: item[0])[1] if turned else None

    def _on_patch(
        self,
        seen: HandObservation,
        base: FloatArray,
        visible: BoolArray,
        person: tuple[FloatArray, FloatArray] | None,
    ) -> list[tuple[float, HandState, Evidence]]:
        """Return cost, state and evidence of each way round that the patch may lie; none where its corners tell none.

        From the tips alone a palm is looked for in their direction, and a lone curled finger points anywhere.
        """
        found = []
        for R in self._facing(self._evidence.patch_orientations(seen), base):
            evidence = self._evidence.assess(seen, R)
            if evidence.rotation is None:
                continue
            start = self._filter.start(R, base - R @ self._base_offset, None, person, ~visible)
            state = self._filter.update(start, evidence, steps=4)
            found.append((self.cost(state, evidence), state, evidence))
        return found

    def _facing(self, rotations: list[FloatArray], at: FloatArray) -> list[FloatArray]:
        """Return the rotations that show the cameras a flat patch; all when there is none, or none does."""
        if self._evidence.outline is None:
            return rotations
        sight = self._sight(at)
        # Guesses whose back points further away from the cameras than this (cosine) are not tried: the steps
        # turn little.
        facing = [R for R in rotations if R[:, 1] @ sight < 0.3]
        return facing or rotations

    def _sight(self, at: FloatArray) -> FloatArray:
        """Return the unit direction (3,) in which the cameras look at a point (3,)."""
        ray = at - self._viewpoint
        direction: FloatArray = ray / max(float(np.sqrt(ray @ ray)), 1e-9)
        return direction

    def cost(self, state: HandState, evidence: Evidence) -> float:
        """Return how ill a state explains a sample, the side of the hand that the cameras see included."""
        away = float(state.R[:, 1] @ self._sight(state.p))
        cost = self._filter.cost(state, evidence)
        if self._evidence.outline is not None:
            return cost + _TURNED_AWAY_COST * max(0.0, away + 0.1) ** 2
        # Nothing tells the sides apart but the hand itself; the back is a little likelier.
        return cost + away


def guesses(direction: FloatArray) -> list[FloatArray]:
    """Return rotations (3, 3), wrist to rig, of hands whose tips lie in a direction (3,) from the wrist."""
    back = -direction / np.sqrt(direction @ direction)
    up = np.array([0.0, 0.0, -1.0])
    if abs(up @ back) > 0.95:
        up = np.array([0.0, -1.0, 0.0])
    side = np.cross(up, back)
    side /= np.sqrt(side @ side)
    towards_tips = np.column_stack([side, np.cross(back, side), back])
    return [
        towards_tips @ rotation_z(np.radians(roll)) @ rotation_x(np.radians(pitch))
        for roll in _ROLLS_DEG
        for pitch in _PITCHES_DEG
    ]


_TIPS_OF_A_PALM: Final = 3


class FingerMethod(Protocol):
    """Another solver of the five fingers, made from the hand's geometry and `options` of [ik]; see `rhot.methods`."""

    def solve(self, targets: FloatArray, start: FloatArray) -> FloatArray:
        """Return angles (5, 4), radians.

        Args:
            targets: (5, 3) marker centres, metres, wrist frame.
            start: (5, 4) radians, the last angles.
        """
        ...


class SolverOptions(Protocol):
    """How points become a hand; `rhot.rig.IkConfig` is one."""

    @property
    def solver(self) -> str:
        """`filter`, or another finger solver among `rhot.methods`."""
        ...

    @property
    def options(self) -> Mapping[str, float | str | tuple[float, ...]]:
        """Of that solver."""
        ...

    @property
    def hold_s(self) -> float:
        """How long a hand whose points are gone is held, seconds."""
        ...


class HandSolver:
    """Solves one hand sample by sample; reads no clock.

    Args:
        model: the hand.
        markers: all markers of the rig; those of other hands are ignored.
        base: name of the marker on the back of this hand.
        config: finger solver, and how long a hand is held.
        viewpoint: (3,) metres, rig frame: mean position of the cameras; by default the rig's origin.
    """

    def __init__(
        self,
        model: HandModel,
        markers: Mapping[str, PaintedMarker],
        base: str,
        config: SolverOptions,
        viewpoint: FloatArray | None = None,
    ) -> None:
        self._geometry = FingerGeometry.of(model, markers)
        marker = markers[base]
        base_offset = marker_on_palm(model, base, marker)
        outline = patch_outline(marker) if marker.kind == "patch" else None
        known = np.array([self._geometry.markers.get(name) in model.marker_offsets_m for name in FINGERS] + [False])
        known[5] = base in model.marker_offsets_m
        self._evidence = EvidenceModel(outline)
        self._kinematics = HandKinematics(self._geometry)
        self._filter = HandFilter(self._geometry, base_offset, known)
        self._contact = GraspContact(model, self._filter, self._kinematics)
        eye = np.zeros(3) if viewpoint is None else viewpoint
        self._initialiser = HandInitialiser(self._filter, self._evidence, base_offset, eye)
        self.config = config
        self._track: HandTrack | None = None
        self._solution: HandSolution | None = None
        self._person: tuple[FloatArray, FloatArray] | None = None

    @property
    def config(self) -> SolverOptions:
        """How points become a hand; another finger solver than the filter comes from `rhot.methods`.

        Raises:
            ConfigError: when it is set: that solver is not installed here, or does not take its options.
        """
        return self._config

    @config.setter
    def config(self, config: SolverOptions) -> None:
        self._fingers: FingerMethod | None = None
        if config.solver != "filter":
            make = load_plugin("rhot.methods", f"ik.{config.solver}", f'[ik] solver = "{config.solver}"', "bench")
            self._fingers = make(self._geometry, config.options)
        self._config = config

    @property
    def geometry(self) -> FingerGeometry:
        """The hand and the positions of its markers on it."""
        return self._geometry

    @property
    def track(self) -> HandTrack | None:
        """The state after the last sample; None while there is no hand."""
        return self._track

    @property
    def solution(self) -> HandSolution | None:
        """The solution of the last sample; None while there is no hand."""
        return self._solution

    def solve(self, seen: HandObservation, shapes: Sequence[Shape] = ()) -> HandSolution | None:
        """Return the hand after one more sample, or None when too few markers are known.

        Args:
            seen: the sample.
            shapes: objects that the fingers may grasp, rig frame.
        """
        before = self._track
        if before is not None:
            dt_s = (seen.t_ns - before.t_ns) / 1e9
            # A sample that is older than the last one by less than this came out of order and is left
            # out.
            if -0.1 < dt_s < 0.0:
                return None
            # After a silence this long nothing of the past is used.
            if not 0.0 <= dt_s < 1.0 or self._is_over(seen, before):
                before = None
        self._track = self._initialised(seen) if before is None else self._continued(before, seen, shapes)
        if self._track is None:
            self._solution = None
        else:
            self._person = self._track.state.personal_parameters
            self._solution = self._solution_of(self._track)
        return self._solution

    def _is_over(self, seen: HandObservation, before: HandTrack) -> bool:
        """Return whether the palm, or every marker, has been unseen for longer than a hand is held."""
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
            angles=self._angles(state, seen, state.angles.reshape(5, 4)),
            corner_noise=evidence.corner_noise,
            corners_measured=evidence.rotation is not None,
            from_patch=evidence.rotation is not None,
            base_seen_ns=seen.t_ns,
            measured_ns=seen.t_ns,
            measured=measured,
            seen=seen,
        )

    def _continued(self, before: HandTrack, seen: HandObservation, shapes: Sequence[Shape]) -> HandTrack:
        dt_s = (seen.t_ns - before.t_ns) / 1e9
        measured = seen.tips_seen & seen.tips_measured
        held = self._contact.is_held(before.state, seen.tips, measured, shapes)
        expected = self._filter.predict(before.state, dt_s, ~measured, holds=held)
        evidence = self._evidence.assess(seen, self._filter.patch_rotation(expected), before.corner_noise)
        updated = self._contact.corrected(self._filter.update(expected, evidence), ~measured, shapes, held=held)
        from_patch = before.from_patch or (evidence.rotation is not None and bool(measured.any()))
        if before.from_patch or not from_patch:
            state, lost_s = self._reinitialised_if_lost(before, updated, seen, int(np.count_nonzero(measured)), dt_s)
        else:
            # Without the corners of its patch, the initial palm only pointed towards the tips.
            state, lost_s = self._reinitialised(updated, seen), 0.0
        turned = self._doubt_of_turn(before, evidence, dt_s)
        if turned > _QUARTER_TURN:
            state, turned = self._initialiser.quarter_turned(state, seen) or state, 0.0
        well_measured = int(np.count_nonzero(measured & _well_known(seen)))
        return HandTrack(
            t_ns=seen.t_ns,
            state=state,
            angles=self._angles(state, seen, before.angles),
            corner_noise=evidence.corner_noise,
            corners_measured=evidence.rotation is not None,
            from_patch=from_patch,
            base_seen_ns=before.base_seen_ns if seen.base is None else seen.t_ns,
            measured_ns=seen.t_ns if seen.measured_any else before.measured_ns,
            measured=measured,
            seen=seen,
            expected=expected if state is updated else None,
            lost_s=lost_s,
            most_tips=max(before.most_tips, well_measured if lost_s == 0.0 else 1),
            quarter_turn=turned,
        )

    def _doubt_of_turn(self, before: HandTrack, evidence: Evidence, dt_s: float) -> float:
        """Return `HandTrack.quarter_turn` after one more sample (a CUSUM, Page 1954)."""
        # Three tips tell how the palm lies; where the patch contradicts them, its sides are stated the wrong way round.
        if before.most_tips >= _TIPS_OF_A_PALM:
            return 0.0
        if evidence.patch is None:
            return before.quarter_turn
        # Samples that follow each other have the same errors.
        share = min(1.0, dt_s / ERROR_LASTS_S)
        return max(0.0, before.quarter_turn - share * evidence.patch.quarter_turn)

    def _reinitialised_if_lost(
        self, before: HandTrack, state: HandState, seen: HandObservation, measured: int, dt_s: float
    ) -> tuple[HandState, float]:
        """Return the state, reinitialised if the tips have disagreed with the model for too long, and that duration."""
        # Fewer tips than have agreed with the state do not reinitialise it: a few tips leave a patch ambiguous.
        if measured < before.most_tips:
            return state, before.lost_s
        # When the seen tips miss the model by more than this on average for `_LOST_S`, the hand is looked for again:
        # more than wrong proportions explain; half of it while no patch's corners have confirmed the palm.
        limit_m = 0.012 if before.from_patch else 0.006
        if state.mean_residual_m < limit_m:
            return state, 0.0
        # A larger residual shortens the wait: 150 mm mean a palm that was initialised the wrong way round.
        haste = (state.mean_residual_m / limit_m) ** 2
        # Time counts up to this many times, with the square of how many times as much they miss it.
        lost_s = before.lost_s + dt_s * min(haste, 20.0)
        if lost_s < _LOST_S:
            return state, lost_s
        return self._reinitialised(state, seen), 0.0

    def _reinitialised(self, state: HandState, seen: HandObservation) -> HandState:
        """Return a newly initialised state if it explains the sample far better, else the state."""
        # Person parameters learned with a wrong palm are wrong as well, so they are not passed on.
        found = self._initialiser.find(seen)
        if found is None or self._initialiser.cost(*found) > 0.5 * self._initialiser.cost(state, found[1]):
            return state
        return found[0]

    def smoothed(self, tracks: Sequence[HandTrack]) -> list[HandSolution]:
        """Return the hand at each of these samples, in order of time, smoothed over all of them."""
        states = smoothed_states(self._filter, tracks)
        solutions = []
        for track, state in zip(tracks, states, strict=True):
            angles = self._angles(state, track.seen, track.angles)
            solutions.append(self._solution_of(dataclasses.replace(track, state=state, angles=angles)))
        return solutions

    def _solution_of(self, track: HandTrack) -> HandSolution:
        state, seen = track.state, track.seen
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = state.R, state.p
        positions, orientations, modelled = self._kinematics.pose(
            state.R, state.p, track.angles.reshape(-1), state.longer
        )
        gaps = modelled - seen.tips
        # NaN where a tip was not seen, as it came.
        residual = np.sqrt((gaps * gaps).sum(-1))
        palm_measured = seen.base is not None and seen.base_measured
        return HandSolution(
            T_rig_wrist=T,
            angles=track.angles,
            positions=positions,
            orientations=orientations,
            residual=residual,
            fingers_measured=track.measured,
            palm_measured=palm_measured,
            sigma=np.sqrt(joint_variances(self._kinematics, state, positions)),
            angle_sigma=np.sqrt(np.maximum(state.P.diagonal()[ANGLES], 0.0)).reshape(5, 4),
        )

    def _angles(self, state: HandState, seen: HandObservation, before: FloatArray) -> FloatArray:
        """Return the angles (5, 4), radians, given those `before`; of fingers that are not measured the filter's."""
        estimated = state.angles.reshape(5, 4)
        if self._fingers is None:
            return estimated
        measured = seen.tips_seen & seen.tips_measured
        if not measured.any():
            return estimated
        resting = self._geometry.marker_points(estimated)
        local = self._filter.scaled_to_model((seen.tips - state.p) @ state.R, state.longer)
        local = np.where(measured[:, None], local, resting)
        return np.where(measured[:, None], self._fingers.solve(local, before), estimated)


def _well_known(seen: HandObservation) -> BoolArray:
    """Return which tips (5,) have a covariance whose trace is below the square of `_WELL_MEASURED_M`."""
    if seen.tip_covariances is None:
        return np.ones(5, dtype=np.bool_)
    known: BoolArray = np.trace(seen.tip_covariances, axis1=1, axis2=2) < _WELL_MEASURED_M**2
    return known
