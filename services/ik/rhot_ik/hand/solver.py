"""One hand over time: the filter of the whole hand, how it starts, and how what comes back is led in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel, patch_outline
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import BoolArray, FloatArray
from rhot.rig import IkConfig, MarkerConfig
from rhot_ik.fabrik.finger_chains import FabrikFingers
from rhot_ik.hand.filter.evidence import CornerNoise, EvidenceModel, HandObservation
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.initialisation import HandInitialiser
from rhot_ik.hand.filter.kinematics import HandKinematics
from rhot_ik.hand.filter.process import HandState
from rhot_ik.hand.filter.settings import HandSettings
from rhot_ik.hand.fingers.closed_form import AnalyticFingers
from rhot_ik.hand.fingers.geometry import FingerGeometry, marker_on_palm
from rhot_ik.hand.rejoin import Rejoin

__all__ = ["HandObservation", "HandSolution", "HandSolver"]


GAP_S: Final = 1.0
"""After a silence this long nothing of the past is used."""
LATE_S: Final = 0.1
"""A sample that is older than the last one by less than this came out of order and is left out."""
LOST_M: Final = 0.012
"""When the seen tips miss the model by more than this on average …"""
LOST_S: Final = 0.3
"""… for this long, the hand is looked for anew."""


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
        self._filter = HandFilter(self._geometry, base_offset, settings, known, viewpoint)
        eye = np.zeros(3) if viewpoint is None else viewpoint
        self._initialiser = HandInitialiser(self._filter, self._evidence, base_offset, eye)
        self._analytic = AnalyticFingers(self._geometry)
        self._fabrik = FabrikFingers(self._geometry)
        self.config = config
        self._person: tuple[FloatArray, FloatArray] | None = None
        self.reset()

    @property
    def geometry(self) -> FingerGeometry:
        """The hand and where its markers are painted."""
        return self._geometry

    @property
    def state(self) -> HandState | None:
        """The filter's state after the last sample; none when nothing is known."""
        return self._state

    @property
    def shown(self) -> FloatArray:
        """Angles (5, 4), radians, as they were shown last."""
        return self._shown

    @property
    def measured(self) -> BoolArray:
        """Which fingers (5,) the last sample measured."""
        return self._measured

    @property
    def residual(self) -> FloatArray:
        """Metres (5,) between measured and modelled marker in the last sample; NaN where there was no measurement."""
        return self._residual

    @property
    def palm_sources(self) -> tuple[bool, bool]:
        """Whether the last sample measured the palm by the corners of its patch, and by its base marker."""
        return self._palm_sources

    def reset(self) -> None:
        """Forget the past; the next sample starts anew."""
        self._t_ns: int | None = None
        self._base_seen_ns = 0
        self._measured_ns = 0
        self._state: HandState | None = None
        self._lost_s = 0.0
        self._rejoin = Rejoin(self._geometry)
        self._corner_noise: CornerNoise | None = None
        self._measured = np.zeros(5, dtype=np.bool_)
        self._palm_sources = (False, False)
        self._shown = np.zeros((5, 4))
        self._residual = np.full(5, np.nan)

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
        if self._state is None:
            found = self._initialiser.find(seen, self._person)
            if found is None:
                return None
            state, evidence = found
        else:
            expected = self._filter.predict(self._state, dt_s, ~(visible & seen.tips_measured))
            evidence = self._evidence.assess(seen, self._filter.patch_rotation(expected), self._corner_noise)
            state = self._filter.update(expected, evidence)
            state = self._reinitialised_if_lost(state, seen, visible, dt_s)
        measured = visible & seen.tips_measured
        angles = self._angles(state, seen.tips, measured)
        back = measured & ~self._measured
        if self._state is not None and back.any():
            self._rejoin.begin(back, angles, self._shown)
        self._rejoin.advance(dt_s, angles)
        model = self._geometry.model
        self._shown = np.minimum(np.maximum(self._rejoin.shown(angles), model.angle_min), model.angle_max)
        self._corner_noise = evidence.corner_noise
        self._palm_sources = (evidence.rotation is not None, seen.base is not None and seen.base_measured)
        self._t_ns, self._state, self._measured = seen.t_ns, state, measured
        self._person = state.what_is_personal
        R, p = state.R, state.p
        shorter_palm_m = -self._settings.palm_share * state.person[2]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, p - shorter_palm_m * R[:, 2]
        positions, orientations, modelled = self._kinematics.pose(
            R, p, self._shown.reshape(-1), state.longer, shorter_palm_m
        )
        gaps = modelled - seen.tips
        # NaN where a tip was not seen, as it came.
        residual = self._residual = np.sqrt((gaps * gaps).sum(-1))
        return HandSolution(T, self._shown, positions, orientations, residual, measured, self._palm_sources[1])

    def _is_over(self, seen: HandObservation, visible: BoolArray) -> bool:
        """Tell whether the palm, or everything, has been gone for longer than a hand is held."""
        if seen.base is not None:
            self._base_seen_ns = seen.t_ns
        if (seen.base is not None and seen.base_measured) or (visible & seen.tips_measured).any():
            self._measured_ns = seen.t_ns
        oldest_ns = seen.t_ns - round(self.config.hold_s * 1e9)
        return self._base_seen_ns < oldest_ns or self._measured_ns < oldest_ns

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
        found = self._initialiser.find(seen, state.what_is_personal)
        if found is None or self._initialiser.cost(*found) > 0.5 * self._initialiser.cost(state, found[1]):
            return state
        return found[0]

    def _angles(self, state: HandState, tips: FloatArray, measured: BoolArray) -> FloatArray:
        """Return the angles (5, 4) of the fingers; of those not measured as the whole hand's estimate has them."""
        estimated = state.angles.reshape(5, 4)
        if self.config.solver == "filter" or not measured.any():
            return estimated
        resting = self._geometry.marker_points(estimated)
        local = np.where(measured[:, None], self._filter.in_model((tips - state.p) @ state.R, state.longer), resting)
        if self.config.solver == "fabrik":
            solved, _ = self._fabrik.solve(local, self._shown, self.config.tolerance_m, self.config.max_iterations)
        else:
            solved = self._analytic.solve(local).angles
        return np.where(measured[:, None], solved, estimated)
