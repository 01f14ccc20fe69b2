"""Status of each marker's track, and the one place where it changes.

A marker is `absent` until two cameras' views agree on a place, or one camera keeps seeing it while its hand is known;
then it is `tentative` until further views agree, and `confirmed` until nothing has shown it for a while.
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
    """Whether a track is published: only confirmed ones are."""

    ABSENT = 0
    TENTATIVE = 1
    CONFIRMED = 2


@dataclass(slots=True)
class Track:
    """One marker.

    Attributes:
        cameras: how many there are.
        status: absent, tentative or confirmed.
        agreed: views that agreed since it began.
        elsewhere: how many pairs of views in a row agreed on another place.
        alone: views in a row of a marker that is absent, by one camera.
        alone_s: time of the newest of them.
        accepted_s: per camera, time of the last frame whose view was accepted, seconds; −∞ = none.
        seen_s: of the newest of them.
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
        """Begin it by views of cameras in frames of these times."""
        self.status = TrackStatus.CONFIRMED if settings.confirmations == 0 else TrackStatus.TENTATIVE
        self.agreed = self.elsewhere = self.alone = 0
        self.accepted_s = [frames_s.get(camera, -np.inf) for camera in range(self.cameras)]
        self.seen_s = t_s

    def look_elsewhere(self, settings: TrackSettings) -> bool:
        """Take two views that agree on a place where it is not known to be; tell whether it is to begin there."""
        self.elsewhere += 1
        return self.status is TrackStatus.ABSENT or self.elsewhere >= settings.relocations

    def see_alone(self, t_s: float, longest_gap_s: float, settings: TrackSettings) -> bool:
        """Take a view of one camera that nothing agrees with; tell whether it is to begin on its ray."""
        self.alone = self.alone + 1 if t_s - self.alone_s <= longest_gap_s else 1
        self.alone_s = t_s
        return self.status is TrackStatus.ABSENT and self.alone >= settings.ray_views

    def accept(self, camera: int, t_s: float, settings: TrackSettings) -> None:
        """Take a view that agrees."""
        self.agreed += 1
        self.elsewhere = 0
        self.accepted_s[camera] = t_s
        self.seen_s = max(self.seen_s, t_s)
        if self.agreed >= settings.confirmations:
            self.status = TrackStatus.CONFIRMED

    def end(self, cameras: int) -> None:
        """Forget it, before so many cameras."""
        self.status = TrackStatus.ABSENT
        self.agreed = self.elsewhere = self.alone = 0
        self.accepted_s = [-np.inf] * cameras
        self.seen_s = -np.inf

    def views(self, since_s: Sequence[float]) -> list[bool]:
        """Tell which cameras (C,) have shown it since these times."""
        return [last >= since for last, since in zip(self.accepted_s, since_s, strict=True)]


def within_hand(
    position: list[Vector],
    covariance: list[Upper],
    markers: Sequence[int],
    shown: Sequence[Sequence[bool]],
    eye: Vector,
    extent_m: float,
) -> None:
    """Let markers of one hand that a single camera shows be about as far away as those that two show.

    That is for what is published. In the filter it would count as new evidence with every frame. Markers that nothing
    shows are left to inverse kinematics, which knows more of the hand.

    Args:
        position: (M,) of all markers, metres; changed in place.
        covariance: (M,) of them; changed in place.
        markers: of the hand, as far as they are known.
        shown: (M,) which cameras show each.
        eye: the middle of the cameras, metres.
        extent_m: standard deviation of a marker in depth about the middle of its hand's.
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
    """Return a point's state by how many cameras show it, and whether they have made its place certain."""
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
    """Return markers at positions (M,), NaN = absent, with covariances (M,), seen by cameras (C, M).

    Two cameras that see a marker measure it if its place has become certain by that: to `measured_m` beyond what any
    two views leave open, whose depth has the `pair_variance` of `CameraNoise`. What is hidden from all of them adds
    variances (M,) to each axis, square metres, which no frame makes smaller. The systematic error is stated, too, but
    tells nothing of one frame rather than another.
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
