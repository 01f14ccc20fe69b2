"""One hand over time: the palm, the fingers, and what is held when markers hide."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.hand import HandModel, patch_outline
from rhot.rig import IkConfig, MarkerConfig
from rhot.skeleton import FINGERS
from rhot_ik.finger_chains import FabrikFingers
from rhot_ik.finger_geometry import FingerGeometry, marker_on_palm
from rhot_ik.fingers import AnalyticFingers
from rhot_ik.palm import PalmEstimator, PalmEvidence

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

REJOIN_S: Final = 0.1
"""A finger or palm that comes back is led to its measurement over this time."""
FOLLOW_NEIGHBOURS_S: Final = 0.4
"""Time constant with which a hidden finger bends like its neighbours."""
PREDICTED_WEIGHT: Final = 0.25
"""Trust in a marker that fusion bridged, relative to a measured one."""
_RATE_BY_MISS: Final = (np.array([0.004, 0.020]), np.array([30.0, 4.0]))
"""How fast a finger may turn, rad/s, by how far it misses its marker, metres."""
GAP_S: Final = 1.0
"""After a silence this long nothing of the past is used."""
LATE_S: Final = 0.1
"""A sample that is older than the last one by less than this came out of order and is left out."""
RELAXED_RAD: Final = np.radians([[5.0, 0.0, 15.0, 15.0], *[[20.0, 0.0, 30.0, 20.0]] * 4])


@dataclass(frozen=True, slots=True)
class HandObservation:
    """The markers of one hand at one moment, rig frame, metres.

    Attributes:
        t_ns: rig clock.
        base: (3,) centre of the base marker, or not seen.
        base_measured: whether it was measured at this moment rather than bridged.
        corners: (4, 3) of its patch, or not seen.
        tips: (5, 3); NaN rows = not seen.
        tips_measured: (5,) whether each was measured at this moment.
    """

    t_ns: int
    base: FloatArray | None
    base_measured: bool
    corners: FloatArray | None
    tips: FloatArray
    tips_measured: BoolArray


@dataclass(frozen=True, slots=True)
class HandSolution:
    """The hand at one moment.

    Attributes:
        T_rig_wrist: (4, 4) metres.
        angles: (5, 4) radians, inside the limits.
        residual: (5,) metres between measured and modelled marker; NaN where there was no measurement.
        fingers_measured: (5,).
        palm_measured: whether the base marker was.
    """

    T_rig_wrist: FloatArray
    angles: FloatArray
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
    """

    def __init__(self, model: HandModel, markers: Mapping[str, MarkerConfig], base: str, config: IkConfig) -> None:
        self._geometry = FingerGeometry.of(model, markers)
        marker = markers[base]
        outline = patch_outline(marker) if marker.kind == "patch" else None
        self._palm = PalmEstimator(self._geometry, marker_on_palm(model, base, marker), outline)
        self._analytic = AnalyticFingers(self._geometry)
        self._fabrik = FabrikFingers(self._geometry)
        self.config = config
        self.reset()

    @property
    def geometry(self) -> FingerGeometry:
        """The hand and where its markers are painted."""
        return self._geometry

    def reset(self) -> None:
        """Forget the past; the next sample starts anew."""
        self._palm.reset()
        self._t_ns: int | None = None
        self._base_seen_ns = 0
        self._measured_ns = 0
        self._base: FloatArray | None = None
        self._base_hidden = False
        self._base_lead = np.zeros(3)
        self._base_lead_s = 0.0
        self._tips = np.full((5, 3), np.nan)
        self._angles = self._geometry.model.clamp(RELAXED_RAD)
        self._finger_known = np.zeros(5, dtype=np.bool_)
        self._finger_hidden = np.zeros(5, dtype=np.bool_)
        self._finger_lead = np.zeros((5, 4))
        self._finger_lead_s = np.zeros(5)

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
        base = self._base_now(seen, visible, dt_s)
        if base is None:
            return None
        weights = np.where(visible, np.where(seen.tips_measured, 1.0, PREDICTED_WEIGHT), 0.0)
        corners = seen.corners if seen.base is not None else None
        rotation = self._palm.update(PalmEvidence(base, corners, seen.tips, weights), dt_s)
        if rotation is None:
            return None
        self._t_ns = seen.t_ns
        self._tips = seen.tips
        T = np.eye(4)
        T[:3, :3] = rotation
        T[:3, 3] = self._palm.wrist(base, rotation)
        self._base = base
        self._angles = self._fingers(T, seen.tips, visible, dt_s)
        modelled = self._geometry.marker_points(self._angles) @ rotation.T + T[:3, 3]
        residual = np.where(visible, np.sqrt(((modelled - seen.tips) ** 2).sum(-1)), np.nan)
        return HandSolution(
            T, self._angles, residual, visible & seen.tips_measured, seen.base is not None and seen.base_measured
        )

    def _is_over(self, seen: HandObservation, visible: BoolArray) -> bool:
        """Tell whether the palm, or everything, has been gone for longer than a hand is held."""
        if seen.base is not None:
            self._base_seen_ns = seen.t_ns
        if (seen.base is not None and seen.base_measured) or (visible & seen.tips_measured).any():
            self._measured_ns = seen.t_ns
        oldest_ns = seen.t_ns - round(self.config.hold_s * 1e9)
        return self._base_seen_ns < oldest_ns or self._measured_ns < oldest_ns

    def _base_now(self, seen: HandObservation, visible: BoolArray, dt_s: float) -> FloatArray | None:
        """Return the base marker (3,), led back without a step after it was hidden; carried by the tips meanwhile."""
        if seen.base is None:
            if self._base is None:
                return None
            self._base_hidden = True
            both = visible & np.isfinite(self._tips).all(axis=1)
            moved = np.median(seen.tips[both] - self._tips[both], axis=0) if both.any() else np.zeros(3)
            return self._base + moved
        if self._base_hidden and self._base is not None:
            self._base_lead, self._base_lead_s = self._base - seen.base, 0.0
            self._base_hidden = False
            return self._base
        self._base_lead_s += dt_s
        remaining = max(0.0, 1.0 - self._base_lead_s / REJOIN_S)
        return seen.base + remaining * self._base_lead

    def _fingers(self, T: FloatArray, tips: FloatArray, visible: BoolArray, dt_s: float) -> FloatArray:
        model = self._geometry.model
        held = self._held(visible, dt_s)
        if not visible.any():
            self._finger_hidden[:] = True
            return held
        local = (tips - T[:3, 3]) @ T[:3, :3]
        if self.config.solver == "fabrik":
            solved, _ = self._fabrik.solve(local, self._angles, self.config.tolerance_m, self.config.max_iterations)
        else:
            resting = self._geometry.marker_points(self._angles)
            solved = self._analytic.solve(np.where(visible[:, None], local, resting)).angles
        returning = visible & self._finger_hidden & self._finger_known
        self._finger_lead_s += dt_s
        if returning.any():
            self._finger_lead[returning] = held[returning] - solved[returning]
            self._finger_lead_s[returning] = 0.0
        # A finger that was never seen has nothing to be led from.
        self._finger_lead[visible & ~self._finger_known] = 0.0
        remaining = np.maximum(0.0, 1.0 - self._finger_lead_s / REJOIN_S)[:, None]
        led = np.where(visible[:, None], solved + remaining * self._finger_lead, held)
        led = self._rate_limited(led, local, dt_s)
        self._finger_known |= visible
        self._finger_hidden = ~visible
        return model.clamp(led)

    def _rate_limited(self, angles: FloatArray, wanted: FloatArray, dt_s: float) -> FloatArray:
        """Return angles (5, 4) no further from the last ones than a finger moves in `dt_s`.

        A marker that the finger cannot reach says little, and its nearest legal pose may lie at the other end of a
        range from one sample to the next: such a finger moves slowly.
        """
        missed = np.sqrt(((self._geometry.marker_points(angles) - wanted) ** 2).sum(-1))
        rate = np.interp(np.where(np.isfinite(missed), missed, 0.0), *_RATE_BY_MISS)
        change = angles - self._angles
        share = np.minimum(1.0, rate * dt_s / np.maximum(np.abs(change).max(axis=1), 1e-9))
        share[~self._finger_known] = 1.0
        limited: FloatArray = self._angles + share[:, None] * change
        return limited

    def _held(self, visible: BoolArray, dt_s: float) -> FloatArray:
        """Return the last angles (5, 4), hidden long fingers drawn towards the bend of their visible neighbours."""
        held = self._angles.copy()
        pull = 1.0 - np.exp(-dt_s / FOLLOW_NEIGHBOURS_S)
        for finger in range(1, len(FINGERS)):
            if visible[finger]:
                continue
            beside = [near for near in (finger - 1, finger + 1) if 1 <= near < len(FINGERS) and visible[near]]
            if beside:
                wanted = self._angles[beside].mean(axis=0)
                bends = (0, 2, 3)
                held[finger, bends] += pull * (wanted[[*bends]] - held[finger, bends])
        return self._geometry.model.clamp(held)
