"""Correction from the centre of the visible paint to the centre of the marker.

**Visible side.** See `visible_side`. The bend of each finger is estimated from the largest of its visible areas,
relative to the largest one observed. Cameras far apart view a finger at different angles; with the same model, areas
are compared as if seen from the centroid of the cameras.

**Occlusion.** An occluder is nearer than the marker, so it hides more of the marker from the camera on its own side. Of
two cameras, the one that sees less paint sees a centroid displaced towards the other camera by half the width of the
hidden strip: ½ h w for a marker of width w, if a share h is hidden in this view and visible in the fullest view. Views
of an unoccluded marker differ slightly, too, so small differences are discounted. A patch may be occluded from any
side: its position is not corrected, only its covariance is enlarged. Where a gap shows equally little of a fingertip to
both cameras, the sides on which skin adjoins it differ, and the centroids with them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.hand import CAP_LENGTH_M
from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot.types import Vector3
from rhot_fusion.filter.visible_side import FIRST_BEND, MOST_BEND, SkinSides, VisibleArea, visible_side
from rhot_fusion.views.sightings import vector

_COMPARE_S: Final = 0.1
"""Areas observed further apart in time are not compared, seconds."""
_SETTLE_S: Final = 0.05
"""Time constant of the low-pass filter of the compared widths while they change by less than `_UNEVEN`, seconds. Larger
changes are followed without delay: a lag of 0.03 caused 20 mm of depth error within 0.1 s for a thumb that one
camera lost first. On 15 develop rigs, three simulated hands and the rendered pictures, 0.03 and 0.1 give the same
errors; longer values reduce jitter at rest.
"""
_UNEVEN: Final = 0.05
"""Relative difference of area between views of an unoccluded marker, caused by the camera positions."""
_DOUBTFUL: Final = 1.5
"""A difference of this many times that of an unoccluded marker is attributed to occlusion by half; smaller ones by
less, larger ones almost entirely. Compared with a dead zone of the same width, 1 and 1.5 give 79 and 86 swapped
points instead of 102 on 15 develop rigs, and 29 and 22 false points instead of 31 in six simulated scenes. Medians
are equal at 1.5 and 0.1 mm larger at 1.
"""
_CUT: Final = 0.5
"""Standard deviation of the centroid of a marker cut off by the image border, as a share of the missing width: markers
are not upright squares.
"""
_SHIFT: Final = 0.5
"""Displacement of the centroid, as a share of the occluded width: a strip displaces it by half of itself."""
_DOUBT: Final = 0.25
"""Standard deviation of this displacement, in the same unit."""
_LASTS_S: Final = 0.1
"""Correlation time of its error, seconds: a finger passes behind another one, 15 mm at 0.15 m/s. If the error were
white, the remaining strip of paint would become depth and velocity, however large the noise of each frame. Between
0.1 and 0.3 there is no difference on eight develop rigs; smoothed pictures are 1.5 mm worse at 0.3.
"""
_APPEARING: Final = 0.15
"""Standard deviation of the centroid of a marker that becomes visible from behind an occluder, as a share of its
width: at the median half of it is still hidden. Between 0.1 and 0.25 there is no difference.
"""
_OPPOSITE: Final = 1.5
"""Displacement of the centroid of a small rest of paint, as a share of the whole width, for each unit by which skin
adjoins it on another side than in the other cameras; nothing at `_WHOLE` of its largest area. Measured in pairs of
views, the factor was 1.1, 0.8, 0.5 and 0.3 at 0.15, 0.25, 0.4 and 0.7 of that area on 30 develop rigs, 0.8, 0.3 and 0.1
at 0.25, 0.4 and 0.65 in two rendered worlds. With it, swapped points of the 30 rigs are 244 instead of 271, the 95th
percentile is 8.9 instead of 9.0 mm, that of the rendered sequences 4.6 and 4.7 instead of 4.7 and 5.0 mm.
"""
_WHOLE: Final = 0.7
_SIDE_NOISE: Final = 0.12
"""Difference of the sides of skin below which noise is likelier than occlusion. At 0.08 a coverage of 98.1 % becomes
97.9 %, without it curled fingers of a rendered world are 12 % worse."""
_SIDE: Final = 0.66
"""(π/4) ρ of `visible_side`."""
_SLIVER: Final = 0.4
"""Below this share of its largest visible area, cameras see different parts of a fingertip."""
_SLIVER_DOUBT: Final = 0.04
"""Standard deviation of the centroid of such a part, as a share of the whole width, for the smallest ones. The
difference of two cameras' centroids was 0.12, 0.05 and 0.02 of the width (root mean square) for shares up to 0.15,
0.3 and 0.45 (rendered pictures). With it, 14 rendered sequences have a 95th percentile of 5.1 instead of 5.3 mm,
and three fast simulated hands 31 instead of 38 false points.
"""
_SEEN_FIRST: Final = 0.25
"""Weight of the first observed area, against the area of the nominal paint length, in the initial estimate of a
marker's largest area. Between 0 and 0.5 there is no difference on rendered and simulated hands; 1 is 0.4 mm worse
on the latter.
"""
_CURLED: Final = 0.65
"""The direction of a finger's end is used in proportion to how far the finger extends, from nothing at `_CURLED` to
fully at `_STRAIGHT`, as shares of the distance from knuckle to straight tip. On 15 develop rigs (60 fps, side
correction compared with the truth) the best factors are −0.2, 0.3, 0.6, 1.1 and 0.9 at 0.51, 0.63, 0.78, 0.86 and
0.97 of that distance; 0.05 less makes no difference. The correction is conservative, because a small area is more
often caused by occlusion.
"""
_STRAIGHT: Final = 0.95
_MOST_TURNED: Final = 0.5
"""Smallest share of its area that a patch shows because it is turned: that of 60 degrees, beyond which the back of the
hand is seen edge-on. Anything less is occlusion.
"""
_FOUND: Final = 0.9
"""Share of a tip's area that is detected as its colour; pixels at the rim are mixed with the background."""
_HIDDEN: Final = 0.5
"""Standard deviation of a tip's centre, each axis, for paint hidden from all cameras, as a share of the width that is
missing beyond `MOST_BEND`. On 15 develop rigs at 60 fps, 66, 30, 25 and 14 % of normalised errors exceeded the 95 %
quantile of chi-square where the fullest view showed 0.15 to 0.2, 0.2 to 0.3, 0.3 to 0.4 and 0.4 to 0.6 of the
largest area; with this term 5, 9, 11 and 10 %.
"""


@dataclass(slots=True)
class _Shown:
    """Visible paint of one marker in one camera.

    Attributes:
        t_s: time of the last observation, seconds; −∞ = never.
        width_m: square root of the area as seen from the centroid of the cameras, averaged over `_SETTLE_S` while it
            does not change.
        shrinking: relative decrease of the width per second between the last two frames; 0 unless it decreases.
        slow_m: the width, low-pass filtered, with which the visible one is compared.
        own: whether the width was computed with the marker's own depth rather than that of its hand.
        changing: relative recent change of the visible area, 0 to 1.
        wider: width of the whole marker seen by this camera, relative to that seen from the centroid of the cameras,
            given the finger's direction.
    """

    t_s: float = -math.inf
    width_m: float = 0.0
    shrinking: float = 0.0
    slow_m: float = 0.0
    own: bool = False
    changing: float = 0.0
    wider: float = 1.0

    def copy(self) -> _Shown:
        """Return a copy; `copy.copy` takes ten times as long, in every frame."""
        return _Shown(self.t_s, self.width_m, self.shrinking, self.slow_m, self.own, self.changing, self.wider)

    def expected_m(self, t_s: float, shrinking: float) -> float:
        """Return the width extrapolated to a later time, at its own rate or at `shrinking` if that is lower."""
        return self.width_m * max(1.0 - min(self.shrinking, shrinking) * (t_s - self.t_s), 0.0)


@dataclass(frozen=True, slots=True)
class PaintBefore:
    """What a frame of one camera changes of `Paint`, as it was before."""

    camera: int
    shown: list[_Shown]
    skin: list[tuple[float, float, float, float] | None]
    largest_m: list[float]
    bend: list[float]


class Paint:
    """Visible paint of M markers in C cameras; plain floats, because numpy is slower for so few numbers.

    Attributes:
        bend: (M,) c of each fingertip estimated from its area, −1 to 0.
    """

    def __init__(self, cameras: Sequence[CameraModel], radius_m: FloatArray) -> None:
        """Initialise with the fingertips' radii (M,), metres; 0 for other markers."""
        self._radius_m: list[float] = radius_m.tolist()
        self._area = VisibleArea()
        self._skin = SkinSides(cameras, len(radius_m))
        # Square root of the area of a tip seen from the side, painted over `CAP_LENGTH_M`, as far as it is detected:
        # pixels at the rim are mixed with the background.
        flat = 2.0 * radius_m * np.maximum(CAP_LENGTH_M - radius_m, 0.0) + 0.5 * np.pi * radius_m**2
        self._flat_m: list[float] = np.sqrt(_FOUND * flat).tolist()
        self._focal_px = [float(camera.K[0, 0]) for camera in cameras]
        middle = np.stack([camera.center for camera in cameras]).mean(axis=0)
        # Centroid of the cameras in each camera's frame, and the direction away from it in the image.
        self._middle: list[Vector3] = [vector(camera.to_camera(middle[None])[0]) for camera in cameras]
        away = np.array([[-x, -y] for x, y, _ in self._middle])
        self._away: list[list[float]] = (away / np.maximum(np.hypot(*away.T), 1e-9)[:, None]).tolist()
        self._cameras = range(len(cameras))
        self.clear()

    def clear(self) -> None:
        """Discard all areas."""
        markers = range(len(self._radius_m))
        self._shown = [[_Shown() for _ in self._cameras] for _ in markers]
        self._largest_m = [0.0 for _ in markers]
        self._skin.clear()
        self.bend = [FIRST_BEND for _ in markers]

    def before(self, camera: int) -> PaintBefore:
        """Return what the next frame of a camera will change; `restore` undoes that frame."""
        shown = [cameras[camera].copy() for cameras in self._shown]
        return PaintBefore(camera, shown, self._skin.of_camera(camera), list(self._largest_m), list(self.bend))

    def restore(self, before: PaintBefore) -> None:
        """Undo the frame that followed `before`; of several frames the newest first."""
        for cameras, shown in zip(self._shown, before.shown, strict=True):
            cameras[before.camera] = shown
        self._skin.restore(before.camera, before.skin)
        self._largest_m, self.bend = before.largest_m, before.bend

    def along(
        self,
        camera: int,
        markers: Sequence[int],
        areas_px: Sequence[float],
        tips: Sequence[Vector3],
        bases: Sequence[Vector3],
        reaches_m: Sequence[float],
    ) -> list[tuple[float, float]]:
        """Return the visible-side correction of a camera's views (N,) of fingertips, normalised units.

        Args:
            camera: index of the camera.
            markers: (N,) the observed markers.
            areas_px: (N,) visible area, square pixels; 0 = unknown.
            tips: (N,) positions of the tips, metres, camera frame.
            bases: (N,) positions of the knuckles, metres, camera frame.
            reaches_m: (N,) distance from knuckle to tip of the straight finger, metres; 0 = unknown.
        """
        middle = self._middle[camera]
        shifts = []
        for marker, area, tip, base, reach in zip(markers, areas_px, tips, bases, reaches_m, strict=True):
            told, shown = self._extension(tip, base, reach), self._shown[marker][camera]
            finger = [(told, (tip[0] - base[0], tip[1] - base[1], tip[2] - base[2]))] if told > 0.0 else []
            if (from_skin := self._skin.direction(camera, marker, shown.t_s)) is not None:
                finger.append((1.0, from_skin))
            if area <= 0.0 or self._radius_m[marker] <= 0.0 or not finger:
                shown.wider = 1.0
                shifts.append((0.0, 0.0))
                continue
            c = max(self.bend[marker], MOST_BEND)
            bent, (x, y, z), shown.wider = visible_side(finger, tip, middle, c, self._area)
            size, depth = _SIDE * self._radius_m[marker] * bent, max(tip[2], 0.05)
            shifts.append((size * (x - tip[0] / depth * z) / depth, size * (y - tip[1] / depth * z) / depth))
        return shifts

    def _extension(self, tip: Vector3, base: Vector3, reach_m: float) -> float:
        """Return the weight, 0 to 1, of the direction from knuckle to tip as the direction of the finger's end."""
        if reach_m <= 0.0:
            return 1.0
        curled, straight = _CURLED, _STRAIGHT
        return min(max((math.dist(tip, base) / reach_m - curled) / (straight - curled), 0.0), 1.0)

    def correct(
        self,
        camera: int,
        markers: Sequence[int],
        t_s: float,
        areas_px: Sequence[float],
        depths_m: Sequence[float],
        period_s: float,
        known: Sequence[bool],
        border: FloatArray | None = None,
        skin: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the occlusion correction of a camera's views, and its standard deviation.

        Args:
            camera: index of the camera.
            markers: (N,) the observed markers.
            t_s: time of the frame, seconds.
            areas_px: (N,) visible area, square pixels; 0 = unknown.
            depths_m: (N,) of the markers; infinite = unknown, without a correction.
            period_s: frame period of the camera.
            known: (N,) whether a marker's own depth is accurate; only then its size is learnt.
            border: (N, 3) distance to the image border as in `Sightings`; None = far away.
            skin: (N, 2) where skin adjoins the markers as in `Sightings`; None = unknown.

        Returns:
            (N, 2) corrections to add to the views and (N,) their standard deviations, normalised units.
        """
        if skin is not None:
            self._skin.observe(camera, t_s, markers, skin)
        sizes, doubts = [], []
        for marker, area, depth, well_known in zip(markers, areas_px, depths_m, known, strict=True):
            if math.isinf(depth):
                size, doubt = 0.0, 0.0
            else:
                size, doubt = self._hidden(camera, marker, t_s, area, depth, well_known)
            sizes.append(size)
            doubts.append(doubt)
        # The error is correlated over `_LASTS_S`: all views within it carry the information of one.
        alike = math.sqrt(max(1.0, _LASTS_S / period_s))
        shifts = np.outer(sizes, self._away[camera])
        if border is not None:
            self._complete(markers, depths_m, border.tolist(), shifts, doubts)
        return shifts, alike * np.array(doubts)

    def _complete(
        self,
        markers: Sequence[int],
        depths_m: Sequence[float],
        border: Sequence[tuple[float, float, float]],
        shifts: FloatArray,
        doubts: list[float],
    ) -> None:
        """Correct, in place, markers that the image border cuts off.

        The centre of such a marker is half its width away from its inner edge.
        """
        for row, (marker, depth, (edge, x, y)) in enumerate(zip(markers, depths_m, border, strict=True)):
            missing = 0.5 * self._largest_m[marker] / depth - edge
            if missing > 0.0:
                shifts[row] = missing * x, missing * y
                doubts[row] = max(doubts[row], _CUT * missing)

    def _hidden(
        self, camera: int, marker: int, t_s: float, area_px: float, depth_m: float, known: bool
    ) -> tuple[float, float]:
        """Return the occlusion correction away from the other cameras, and its standard deviation, normalised units."""
        every = self._shown[marker]
        side_px, tip = math.sqrt(area_px), self._radius_m[marker] > 0.0
        self._watch(every[camera], t_s, side_px / self._focal_px[camera] * depth_m / every[camera].wider, known)
        full = told_full = 0.0
        for shown in every:
            if shown.t_s >= t_s - _COMPARE_S:
                # A bending finger shows ever less to all cameras, so an earlier width is extrapolated before comparing.
                there = shown.expected_m(t_s, every[camera].shrinking)
                full = max(full, there)
                if shown.own:
                    told_full = max(told_full, there)
        # The largest area is unknown at first: it is taken between that of a relaxed finger with the visible area and
        # that of the nominal paint length. Widths computed with the hand's depth serve until the marker's is known.
        told_full = told_full or full
        largest = self._largest_m[marker] or (
            (told_full / self._area.usual) ** _SEEN_FIRST * self._flat_m[marker] ** (1.0 - _SEEN_FIRST)
        )
        largest = max(told_full, largest)
        if known:
            self._largest_m[marker] = largest
            if area_px > 0.0:
                share = (told_full / max(largest, 1e-9)) ** 2
                self.bend[marker] = self._area.bend(share)
        if area_px <= 0.0:
            return 0.0, 0.0
        width = every[camera].width_m
        less = 1.0 - (width / full) ** 2 if full > width else 0.0
        # At the rim, areas differ by a quarter of a pixel of the radius more.
        uneven = _DOUBTFUL * (_UNEVEN + 0.5 / max(side_px, 1.0))
        # Wiener filter: differences well above those of unoccluded markers are attributed to occlusion entirely.
        hidden = less**3 / (less * less + uneven * uneven)
        if tip:
            strip = hidden * full / depth_m
            # Of a small rest, cameras see different parts, whether or not they see equally much of it.
            lost = 1.0 - (width / largest) ** 2 / _SLIVER
            rest = _SLIVER_DOUBT * lost * largest / depth_m if lost > 0.0 else 0.0
            opposite = self._opposite(camera, marker, t_s, (width / largest) ** 2) * self._radius_m[marker] / depth_m
            return _SHIFT * strip + opposite, math.hypot(_DOUBT * strip, rest, opposite)
        # Area lost beyond what turning explains is hidden, on an unknown side: the centre is uniformly distributed
        # within half of that strip to either side.
        strip = hidden * full**2 / max(largest, 1e-9) / depth_m
        lost = max(1.0 - (width / max(largest, 1e-9)) ** 2 / _MOST_TURNED, 0.0)
        of_all = _SHIFT / math.sqrt(3.0) * lost * largest / depth_m
        return 0.0, math.hypot(_DOUBT * strip, of_all)

    def _opposite(self, camera: int, marker: int, t_s: float, share: float) -> float:
        """Return the displacement of a rest of paint, radii, along the direction away from the other cameras.

        Two fingers that let a third one show between them hide its left side from one camera and its right side from
        the other: both see equally little of it, so that the areas tell nothing.
        """
        if share >= _WHOLE:
            return 0.0
        (u, v), (x, y) = self._skin.apart(camera, marker, t_s), self._away[camera]
        side = u * x + v * y
        # As for the areas: what is well above the noise counts entirely.
        side *= side * side / (side * side + _SIDE_NOISE * _SIDE_NOISE)
        return 2.0 * _OPPOSITE * (1.0 - share / _WHOLE) * side

    def _watch(self, shown: _Shown, t_s: float, width_m: float, known: bool) -> None:
        """Update with the metric width that a camera shows of a marker."""
        elapsed = max(t_s - shown.t_s, 0.0)
        lost = elapsed > _COMPARE_S
        # A marker that reappears may be whole, or may still be emerging from behind an occluder.
        slow = width_m if math.isinf(elapsed) else shown.slow_m
        if not lost:
            # Time constant of the compared width, seconds: two frames at 60 fps.
            slow -= math.expm1(-elapsed / 0.03) * (width_m - slow)
        shown.slow_m = slow
        shown.changing = max(_unlike(slow, width_m) - _UNEVEN, 0.0) if width_m > 0.0 else 0.0
        # At rest the noise of areas is averaged. A loss in one camera must not be delayed: it would become depth.
        afresh = lost or not shown.own or shown.changing > 0.0
        before = shown.width_m
        shown.width_m += (1.0 if afresh else -math.expm1(-elapsed / _SETTLE_S)) * (width_m - shown.width_m)
        shrinks = shown.width_m < before and shown.changing > 0.0 and not lost
        shown.shrinking = (1.0 - shown.width_m / before) / elapsed if shrinks and elapsed > 0.0 else 0.0
        shown.t_s, shown.own = t_s, known

    def hidden_m2(self, marker: int) -> float:
        """Return the variance, each axis, of a fingertip's centre for paint hidden from all cameras, square metres.

        Area that is missing beyond the effect of bending is hidden, on an unknown side.
        """
        largest, full = self._largest_m[marker], 0.0
        if not largest or self._radius_m[marker] <= 0.0:
            return 0.0
        every = self._shown[marker]
        since_s = max(shown.t_s for shown in every) - _COMPARE_S
        for shown in every:
            if shown.t_s >= since_s and shown.width_m > full:
                full = shown.width_m
        lost = 1.0 - (full / largest) ** 2 / self._area.least
        return (_HIDDEN * lost * largest) ** 2 if lost > 0.0 and full > 0.0 else 0.0

    def doubt_back(self, marker: int, depth_m: float) -> float:
        """Return the standard deviation of the centroid of a reappearing marker, normalised units.

        It is 0 for a marker seen for the first time: nothing indicates that it was hidden.
        """
        if not self._largest_m[marker]:
            return 0.0
        return _APPEARING * 2.0 * self._radius_m[marker] / depth_m

    def slack(self, camera: int, areas_px: Sequence[float]) -> FloatArray:
        """Return the additional gate widths (N,) for sudden occlusion, normalised units."""
        focal_px = self._focal_px[camera]
        # Pixels, and a share of the marker's width: half of a tip may become hidden within one frame.
        return np.array([(0.5 + 0.05 * math.sqrt(area)) / focal_px for area in areas_px])


def _unlike(width: float, other: float) -> float:
    """Return the relative difference, 0 to 1, of two areas given by their square roots."""
    return 1.0 - (min(width, other) / max(width, other)) ** 2 if width > 0.0 or other > 0.0 else 0.0
