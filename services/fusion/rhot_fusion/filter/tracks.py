"""Status of each marker's track, and the one place where it changes.

A marker is `absent` until views of two cameras agree on a position, or until one camera keeps seeing it while its hand
is tracked. It is then `tentative` until further views agree, and `confirmed` until it has not been seen for a while.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from statistics import fmean
from typing import Final

import numpy as np

from rhot.types import PointState, Vector3
from rhot_fusion.filter.systematic import Systematic
from rhot_fusion.views.sightings import Outcome, Upper, unit

GATE: Final = 25.0
"""Squared Mahalanobis distance (2 degrees of freedom) beyond which an observation is rejected; exceeded by chance once
in 270,000.
"""
PAIR_S: Final = 0.15
"""Longest time between these two views, in seconds and in frame periods; unsynchronised cameras are half a period
apart, and one frame may be lost.
"""
SPEED_SIGMA: Final = 0.5
"""Standard deviation of a new marker's velocity about that of its hand, or about 0, m/s; in daily actions 95 % of
speeds are below 1 m/s.
"""
_RELOCATIONS: Final = 3
"""Consecutive pairs of views that must agree on a different position before a marker is moved there."""
RAY_SIGMA_M: Final = 0.08
"""Standard deviation in depth, about its hand, of a marker initialised from one camera, metres."""
_RAY_VIEWS: Final = 3
"""Consecutive views of one camera that initialise a marker on its viewing ray."""
BEHIND_M: Final = 0.044
"""How much farther away a fingertip is that one camera sees than the middle of the markers that two see, metres: what
hides it from the others is nearer. 0.044 ± 0.025 in 1,738 frames of 30 develop rigs, 0.056 ± 0.018 where the middle is
the patch alone.
"""
BEHIND_SIGMA_M: Final = 0.025
"""Standard deviation of that distance, metres."""
LOOSE_M: Final = 0.03
"""A marker whose standard deviation is larger is initialised anew by two views, metres: at that size, depth is no
longer linear in pixel coordinates.
"""
LOST_PERIODS: Final = 2.5
"""A marker not observed for this many frame periods is not moved by a single view."""
LOST_M: Final = 0.12
"""A marker with a larger standard deviation is not published, and is deleted once no camera sees it, metres. The limit
is generous because slow unsynchronised cameras (15 fps) initialise markers with a large depth uncertainty, and a
smaller limit deleted them at once.
"""


class TrackStatus(IntEnum):
    """Life cycle of a track; only confirmed ones are published."""

    ABSENT = 0
    TENTATIVE = 1
    CONFIRMED = 2


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """What a track must fulfil; rigs without `cameras.json` have limits of their own.

    Attributes:
        confirmations: further views that must agree before a new marker is published. Without a calibration, two views
            rarely contradict each other.
        measured_m: upper bound of the standard deviation of a point in state `measured`, metres (root of the
            covariance's trace, including hidden paint but not the calibration error), beyond the uncertainty of any
            pair of views; the width of a little finger's tip, because a less certain point may be the neighbouring
            finger. At 0.0125 instead of 0.011, 20 rendered sequences have a live coverage of 94.7 instead of 94.2 %
            and a 95th percentile of 5.3 instead of 5.1 mm. Without a calibration: four pixels, at 2 cm of depth each.
        inflation_gate: squared Mahalanobis distance (2 degrees of freedom) beyond which the covariance of a marker is
            inflated; 1 % by chance. The acceleration scale belongs to the whole hand; one finger may curl alone. Over
            the rendered pictures the mean 95th percentile is 5.3 mm at 9, 5.4 at 14 and 5.6 without. Where one blob in
            twenty is wrong, as without a calibration, tracks would diverge.
        reacquisition_gate: the same for the first observations of a marker that its camera had lost; 5 % by chance.
    """

    confirmations: int = 0
    measured_m: float = 0.0125
    inflation_gate: float = 9.0
    reacquisition_gate: float = 6.0


CALIBRATED: Final = TrackSettings()
UNCALIBRATED: Final = TrackSettings(
    confirmations=6, measured_m=0.08, inflation_gate=math.inf, reacquisition_gate=math.inf
)


@dataclass(slots=True)
class Track:
    """Track of one marker.

    Attributes:
        cameras: number of cameras.
        status: absent, tentative or confirmed.
        agreed: number of accepted views since its initialisation.
        elsewhere: number of consecutive view pairs that agreed on a different position.
        alone: number of consecutive views of the absent marker by a single camera.
        alone_s: time of the newest of those, seconds.
        accepted_s: per camera, time of the last frame whose view was accepted, seconds; −∞ = none.
        seen_s: maximum of `accepted_s`.
    """

    cameras: int
    status: TrackStatus = TrackStatus.ABSENT
    agreed: int = 0
    elsewhere: int = 0
    alone: int = 0
    alone_s: float = -np.inf
    accepted_s: list[float] = field(default_factory=list)
    seen_s: float = -np.inf

    def begin(self, t_s: float, frames_s: dict[int, float], settings: TrackSettings) -> None:
        """Initialise from views; `frames_s` holds the frame time by camera."""
        self.status = TrackStatus.CONFIRMED if settings.confirmations == 0 else TrackStatus.TENTATIVE
        self.agreed = self.elsewhere = self.alone = 0
        self.accepted_s = [frames_s.get(camera, -np.inf) for camera in range(self.cameras)]
        self.seen_s = t_s

    def look_elsewhere(self) -> bool:
        """Count a view pair that agrees on a new position; return whether to initialise the track there."""
        self.elsewhere += 1
        return self.status is TrackStatus.ABSENT or self.elsewhere >= _RELOCATIONS

    def see_alone(self, t_s: float, longest_gap_s: float) -> bool:
        """Count a view that only one camera has; return whether to initialise the track on its viewing ray."""
        self.alone = self.alone + 1 if t_s - self.alone_s <= longest_gap_s else 1
        self.alone_s = t_s
        return self.status is TrackStatus.ABSENT and self.alone >= _RAY_VIEWS

    def accept(self, camera: int, t_s: float, settings: TrackSettings) -> None:
        """Count an accepted view."""
        self.agreed += 1
        self.elsewhere = 0
        self.accepted_s[camera] = t_s
        self.seen_s = max(self.seen_s, t_s)
        if self.agreed >= settings.confirmations:
            self.status = TrackStatus.CONFIRMED

    def end(self, cameras: int) -> None:
        """Reset the track to absent, for this number of cameras."""
        self.status = TrackStatus.ABSENT
        self.agreed = self.elsewhere = self.alone = 0
        self.accepted_s = [-np.inf] * cameras
        self.seen_s = -np.inf

    def views(self, since_s: Sequence[float]) -> list[bool]:
        """Return which cameras (C,) have seen it since the given times."""
        return [last >= since for last, since in zip(self.accepted_s, since_s, strict=True)]


def within_hand(
    position: list[Vector3],
    covariance: list[Upper],
    markers: Sequence[int],
    shown: Sequence[Sequence[bool]],
    eye: Vector3,
    patch: int,
) -> None:
    """Constrain the depth of markers seen by one camera with the hand's markers seen by two.

    Applied to the published points only: in the filter, the same prior would count as new evidence in every frame.
    Markers that no camera sees are left to inverse kinematics, which has a model of the hand.

    Args:
        position: (M,) of all markers, metres; changed in place.
        covariance: (M,) of all markers; changed in place.
        markers: confirmed markers of the hand.
        shown: (M,) which cameras see each.
        eye: centroid of the cameras, metres.
        patch: the marker on the back of the hand, which lies behind nothing; −1 = none.
    """
    fixed = [position[marker] for marker in markers if sum(shown[marker]) >= 2]
    if not fixed or len(fixed) == len(markers):
        return
    middle = tuple(fmean(column) for column in zip(*fixed, strict=True))
    variance = BEHIND_SIGMA_M**2 * (1.0 + 1.0 / len(fixed))
    for marker in markers:
        if sum(shown[marker]) != 1:
            continue
        (px, py, pz), (xx, xy, xz, yy, yz, zz) = position[marker], covariance[marker]
        x, y, z = unit((px - eye[0], py - eye[1], pz - eye[2]))
        a, b, c = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
        gain = 1.0 / (a * x + b * y + c * z + variance)
        behind_m = 0.0 if marker == patch else BEHIND_M
        off = gain * ((middle[0] - px) * x + (middle[1] - py) * y + (middle[2] - pz) * z + behind_m)
        position[marker] = px + off * a, py + off * b, pz + off * c
        less = gain * a * a, gain * a * b, gain * a * c, gain * b * b, gain * b * c, gain * c * c
        xx, xy, xz, yy, yz, zz = (own - known for own, known in zip(covariance[marker], less, strict=True))
        covariance[marker] = xx, xy, xz, yy, yz, zz


def state_of(views: int, certain: bool) -> PointState:
    """Return a point's state from the number of cameras that see it and whether its position is certain."""
    if views >= 2:
        return "measured" if certain else "predicted"
    return "one_view" if views == 1 else "predicted"


def outcome_of(
    t_s: float,
    position: Sequence[Vector3],
    covariance: Sequence[Upper],
    seen: list[list[bool]],
    systematic: Systematic,
    settings: TrackSettings,
    pair_variance: float,
    hidden_m2: Sequence[float],
) -> Outcome:
    """Return the published outcome of markers.

    A marker seen by two cameras is `measured` if its standard deviation is at most `TrackSettings.measured_m` beyond
    the uncertainty of any single pair of views. The systematic error is part of the published covariance but not of
    this test, because it is the same in every frame.

    Args:
        t_s: time of the outcome.
        position: (M,) metres; NaN = absent.
        covariance: (M,) of the filter.
        seen: (C, M) which camera sees which marker.
        systematic: systematic errors.
        settings: of the tracks.
        pair_variance: as in `CameraNoise`.
        hidden_m2: (M,) variance of each axis for paint hidden from all cameras, square metres.
    """
    sigmas, views, measured = [], [], []
    whole: list[Upper] = []
    states: list[PointState] = []
    columns = zip(position, covariance, hidden_m2, *seen, strict=True)
    for marker, (place, (xx, xy, xz, yy, yz, zz), hidden, *sees) in enumerate(columns):
        count = sum(sees)
        most = settings.measured_m**2 + pair_variance * systematic.distance_m(place) ** 4
        state = state_of(count, xx + yy + zz + 3.0 * hidden <= most)
        a, b, c, d, e, f = systematic.covariance(marker, place)
        a, d, f = a + hidden, d + hidden, f + hidden
        whole.append((xx + a, xy + b, xz + c, yy + d, yz + e, zz + f))
        sigmas.append(math.sqrt(max(xx + a + yy + d + zz + f, 0.0)))
        views.append(count)
        states.append(state)
        measured.append(state == "measured" and not math.isnan(place[0]))
    return Outcome(t_s, position, sigmas, views, measured, seen, whole, states)
