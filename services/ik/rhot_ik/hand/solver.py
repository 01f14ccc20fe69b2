"""One hand over time: the filter of the whole hand, its start, and the transitions between sources."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel, patch_outline
from rhot.arrays import BoolArray, FloatArray
from rhot.rig import IkConfig, MarkerConfig
from rhot_ik.fabrik.finger_chains import FabrikFingers
from rhot_ik.hand.filter.evidence import EvidenceModel, HandObservation
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.initialisation import HandInitialiser
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.point_covariance import PointCovariances
from rhot_ik.hand.filter.process import HandState
from rhot_ik.hand.fingers.closed_form import AnalyticFingers
from rhot_ik.hand.fingers.expected_bend import ExpectedBend
from rhot_ik.hand.fingers.geometry import FingerGeometry, marker_on_palm
from rhot_ik.hand.transitions import FingerStepLimit, FingerTransition, PalmTransition

__all__ = ["HandObservation", "HandSolution", "HandSolver"]


GAP_S: Final = 1.0
"""After a silence this long nothing of the past is used."""
LATE_S: Final = 0.1
"""A sample that is older than the last one by less than this came out of order and is left out."""
LOST_M: Final = 0.012
"""When the seen tips miss the model by more than this on average …"""
LOST_S: Final = 0.3
"""… for this long, the hand is searched for from scratch."""


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


class HandSolver:
    """Solves one hand sample by sample; everything it knows of time comes with the samples.

    Args:
        model: the hand.
        markers: all markers of the rig; those of other hands are ignored.
        base: name of the marker on the back of this hand.
        config: which finger solver, and how long a hand is held.
        viewpoints: (C, 3) metres, rig frame: the cameras' centres, for the shape of the points' errors; taken as round
            when not given.

    Attributes:
        geometry: the hand and where its markers are painted.
        state: of the filter after the last sample; none when nothing is known.
        shown: (5, 4) radians: the angles published last.
        measured: (5,) which fingers the last sample measured.
        residual: (5,) metres between measured and modelled marker in the last sample; NaN where nothing was measured.
        palm_sources: whether the last sample measured the palm by the corners of its patch, and by its base marker.
    """

    def __init__(
        self,
        model: HandModel,
        markers: Mapping[str, MarkerConfig],
        base: str,
        config: IkConfig,
        viewpoints: FloatArray | None = None,
    ) -> None:
        self.geometry = FingerGeometry.of(model, markers)
        marker = markers[base]
        base_offset = marker_on_palm(model, base, marker)
        outline = patch_outline(marker) if marker.kind == "patch" else None
        covariances = PointCovariances(np.empty((0, 3)) if viewpoints is None else viewpoints)
        self._evidence = EvidenceModel(outline, covariances)
        self._kinematics = HandKinematics(self.geometry)
        self._filter = HandFilter(self.geometry, base_offset)
        self._initialiser = HandInitialiser(self._filter, self._evidence, base_offset)
        self._analytic = AnalyticFingers(self.geometry)
        self._bend = ExpectedBend(self._analytic)
        self._fabrik = FabrikFingers(self.geometry)
        self.config = config
        self.reset()

    def reset(self) -> None:
        """Forget the past; the next sample starts from scratch."""
        self._t_ns: int | None = None
        self._base_seen_ns = 0
        self._measured_ns = 0
        self.state: HandState | None = None
        self._lost_s = 0.0
        self._finger_transition = FingerTransition(self.geometry.model)
        self._step_limit = FingerStepLimit()
        self._palm_transition = PalmTransition()
        self._known = np.zeros(5, dtype=np.bool_)
        self.measured = np.zeros(5, dtype=np.bool_)
        self.palm_sources = (False, False)
        self.shown = np.zeros((5, 4))
        self._tips = np.full((5, 3), np.nan)
        self.residual = np.full(5, np.nan)

    def solve(self, seen: HandObservation) -> HandSolution | None:
        """Return the hand after one more sample, or None when too little is known to show one."""
        dt_s = 0.0
        if self._t_ns is not None:
            dt_s = (seen.t_ns - self._t_ns) / 1e9
            if -LATE_S < dt_s < 0.0:
                return None
            if not 0.0 <= dt_s < GAP_S:
                self.reset()
                dt_s = 0.0
        visible = np.asarray(np.isfinite(seen.tips).all(axis=1))
        if self._is_over(seen, visible):
            self.reset()
            return None
        if self.state is None:
            expected = None
            found = self._initialiser.find(seen)
            if found is None:
                return None
            state, evidence = found
        else:
            expected = self._filter.predict(self.state, dt_s)
            evidence = self._evidence.assess(seen, expected.R)
            state = self._filter.update(expected, evidence)
            state = self._reinitialised_if_lost(state, seen, visible, dt_s)
        measured = visible & seen.tips_measured
        palm_sources = (evidence.rotation is not None, seen.base is not None and seen.base_measured)
        if expected is not None:
            if palm_sources != self.palm_sources or (measured & ~self.measured).any():
                self._palm_transition.begin((expected.R, expected.p), (state.R, state.p))
            self._palm_transition.advance(dt_s)
        R, p = self._palm_transition.apply(state.R, state.p)
        angles = self._angles(state, R, p, seen.tips, measured)
        if expected is not None:
            changed = (measured != self.measured) & self._known
            if changed.any():
                self._finger_transition.begin(changed, angles, self.shown)
            self._finger_transition.advance(dt_s)
        shown = self._finger_transition.apply(angles)
        if expected is not None:
            shown = self._finger_transition.limit_step(shown, self.shown, self._max_step_m(seen.tips, measured, dt_s))
        model = self.geometry.model
        self.shown = np.minimum(np.maximum(shown, model.angle_min), model.angle_max)
        self._known |= visible
        self._tips = seen.tips
        self._t_ns, self.state, self.measured, self.palm_sources = seen.t_ns, state, measured, palm_sources
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, p
        positions, orientations, modelled = self._kinematics.pose(R, p, self.shown.reshape(-1))
        gaps = modelled - seen.tips
        # NaN where a tip was not seen, as it came.
        residual = self.residual = np.sqrt((gaps * gaps).sum(-1))
        return HandSolution(T, self.shown, positions, orientations, residual, measured, palm_sources[1])

    def _is_over(self, seen: HandObservation, visible: BoolArray) -> bool:
        """Tell whether the palm, or everything, has been gone for longer than a hand is held."""
        if seen.base is not None:
            self._base_seen_ns = seen.t_ns
        if (seen.base is not None and seen.base_measured) or (visible & seen.tips_measured).any():
            self._measured_ns = seen.t_ns
        oldest_ns = seen.t_ns - round(self.config.hold_s * 1e9)
        return self._base_seen_ns < oldest_ns or self._measured_ns < oldest_ns

    def _max_step_m(self, tips: FloatArray, measured: BoolArray, dt_s: float) -> FloatArray:
        """Return how far each finger (5,) may move its joints in this sample, metres."""
        moved = tips - self._tips
        limit = self._step_limit.advance(dt_s, np.sqrt((moved * moved).sum(-1)), measured)
        return np.where(self._known, limit, np.inf)

    def _reinitialised_if_lost(
        self, state: HandState, seen: HandObservation, visible: BoolArray, dt_s: float
    ) -> HandState:
        """Return the state, or a better one when the tips have missed the model for too long."""
        if state.mean_residual_m < LOST_M or np.count_nonzero(visible) < 3:
            self._lost_s = 0.0
            return state
        self._lost_s += dt_s
        if self._lost_s < LOST_S:
            return state
        self._lost_s = 0.0
        found = self._initialiser.find(seen)
        if found is None or self._initialiser.cost(*found) > 0.5 * self._initialiser.cost(state, found[1]):
            return state
        self.palm_sources = (False, False)
        return found[0]

    def _angles(
        self, state: HandState, R: FloatArray, p: FloatArray, tips: FloatArray, measured: BoolArray
    ) -> FloatArray:
        """Return the angles (5, 4) of the fingers on a palm at R, p; of those not measured as the filter has them."""
        filtered = self._bend.expected(state.angles.reshape(5, 4))
        if self.config.solver == "filter" or not measured.any():
            return filtered
        resting = self.geometry.marker_points(filtered)
        local = np.where(measured[:, None], (tips - p) @ R, resting)
        if self.config.solver == "fabrik":
            solved, _ = self._fabrik.solve(local, self.shown, self.config.tolerance_m, self.config.max_iterations)
        else:
            solved = self._analytic.solve(local).angles
        return np.where(measured[:, None], solved, filtered)
