"""What the solver of a hand knows after a sample, and what it publishes of it."""

from __future__ import annotations

from dataclasses import dataclass

from rhot.arrays import BoolArray, FloatArray
from rhot_ik.hand.filter.evidence import CornerNoise, HandObservation
from rhot_ik.hand.filter.process import HandState


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
        sigma: (26,) standard deviation of each joint's position by the filter, metres: root of the sum over the axes.
        angle_sigma: (5, 4) of each angle, radians.
    """

    T_rig_wrist: FloatArray
    angles: FloatArray
    positions: FloatArray
    orientations: FloatArray
    residual: FloatArray
    fingers_measured: BoolArray
    palm_measured: bool
    sigma: FloatArray
    angle_sigma: FloatArray


@dataclass(frozen=True, slots=True)
class HandTrack:
    """The state of one hand after a sample.

    Attributes:
        t_ns: time of the sample, rig clock.
        state: the estimate.
        angles: (5, 4) radians, published.
        corner_noise: learned noise of the patch's corners.
        corners_measured: whether the corners of the patch measured the palm's rotation.
        base_seen_ns, measured_ns: when the base marker was last seen, and when any marker was last measured.
        measured: (5,) whether each finger was measured.
        seen: the sample.
        expected: the predicted state; None if the sample initialised the hand.
        lost_s: for how long the seen tips have disagreed with the model, seconds.
        most_tips: largest number of well-measured tips that agreed with the model at once; at least 1.
        from_patch: whether the hand was initialised or confirmed by the corners of its patch.
        quarter_turn: by how much worse the corners of late have fitted the palm than one a quarter turn off, as
            `FittedPatch` states it; at least 0.
    """

    t_ns: int
    state: HandState
    angles: FloatArray
    corner_noise: CornerNoise
    corners_measured: bool
    base_seen_ns: int
    measured_ns: int
    measured: BoolArray
    seen: HandObservation
    expected: HandState | None = None
    lost_s: float = 0.0
    most_tips: int = 1
    from_patch: bool = True
    quarter_turn: float = 0.0
