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

import numpy as np

from rhot.messages import PointState
from rhot_fusion.filter.settings import TrackSettings
from rhot_fusion.filter.systematic import Systematic
from rhot_fusion.views.sightings import Outcome, Upper
from rhot_fusion.views.vectors import Vector, unit


class TrackStatus(IntEnum):
    """Life cycle of a track; only confirmed ones are published."""

    ABSENT = 0
    TENTATIVE = 1
    CONFIRMED = 2


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

    def look_elsewhere(self, settings: TrackSettings) -> bool:
        """Count a view pair that agrees on a new position; return whether to initialise the track there."""
        self.elsewhere += 1
        return self.status is TrackStatus.ABSENT or self.elsewhere >= settings.relocations

    def see_alone(self, t_s: float, longest_gap_s: float, settings: TrackSettings) -> bool:
        """Count a view that only one camera has; return whether to initialise the track on its viewing ray."""
        self.alone = self.alone + 1 if t_s - self.alone_s <= longest_gap_s else 1
        self.alone_s = t_s
        return self.status is TrackStatus.ABSENT and self.alone >= settings.ray_views

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
    position: list[Vector],
    covariance: list[Upper],
    markers: Sequence[int],
    shown: Sequence[Sequence[bool]],
    eye: Vector,
    extent_m: float,
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
        extent_m: standard deviation of a marker's depth about the hand's centroid.
    """
    fixed = [position[marker] for marker in markers if sum(shown[marker]) >= 2]
    if not fixed or len(fixed) == len(markers):
        return
    middle = tuple(fmean(column) for column in zip(*fixed, strict=True))
    variance = extent_m**2 * (1.0 + 1.0 / len(fixed))
    for marker in markers:
        if sum(shown[marker]) != 1:
            continue
        (px, py, pz), (xx, xy, xz, yy, yz, zz) = position[marker], covariance[marker]
        x, y, z = unit((px - eye[0], py - eye[1], pz - eye[2]))
        a, b, c = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
        gain = 1.0 / (a * x + b * y + c * z + variance)
        off = gain * ((middle[0] - px) * x + (middle[1] - py) * y + (middle[2] - pz) * z)
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
    position: Sequence[Vector],
    covariance: Sequence[Upper],
    seen: list[list[bool]],
    systematic: Systematic,
    settings: TrackSettings,
    pair_variance: float,
    hidden_m2: Sequence[float],
) -> Outcome:
    """Return the published outcome of markers.

    A marker seen by two cameras is `measured` if its standard deviation is at most `measured_m` beyond the uncertainty
    of any single pair of views. The systematic error is part of the published covariance but not of this test, because
    it is the same in every frame.

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
