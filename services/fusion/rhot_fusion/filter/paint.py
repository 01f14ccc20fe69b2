"""Correction from the centre of the visible paint to the centre of the marker.

A fingertip is round, so a camera sees the paint on the side that faces it. Of a finger along d, with c = d·u for the
direction u to the camera, the middle of that side lies off the finger's axis, and in the picture that is

    −(π/4) ρ r c        further along the finger,

r its radius, ρ ≈ 0.85 the share of the paint that is on its shaft rather than on its round end. The direction of a
finger across the view is that to the tip from beside the patch on the back of the hand, where its knuckle is; how far
it bends away from the camera is told by its visible area, which is

    A(c) / A(0) = (2 λ √(1 − c²) + (π/2) (1 + c)) / (2 λ + π/2)        for c ≤ 0,

λ r being the length of the painted shaft, beside the largest area that it has shown. The more a finger curls, the less
either tells: its end points elsewhere, and a small area is that of paint which the hand hides. Cameras far apart look
along a finger at different angles, so the same ratio tells what each would see of the whole marker; areas are compared
as if all were seen from the middle of the cameras.

What hides part of a marker is nearer than it, so it hides more of it in the camera on its own side: of two cameras the
one that sees less paint sees the middle of that too far towards the other camera, by half of the strip that is hidden.
With the share h that is hidden in one view and not in the fullest one, and w the marker's width, that is ½ h w. Whole
markers look unlike, too: of a small difference little counts.
What hides some of a patch comes from any side: it is where it is seen, and how far that may be off is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rhot.anatomy.hand import CAP_LENGTH_M
from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_fusion.filter.settings import PaintSettings
from rhot_fusion.views.vectors import Vector, across, dot, interpolated, unit, vector

_STRAIGHT_AWAY = -0.95
"""Beyond this c, 18 degrees off the line of sight, a camera sees a rim of paint, which tells of no ratio."""


@dataclass(slots=True)
class _Shown:
    """What one camera has shown of a marker's paint.

    Attributes:
        t_s: when last, seconds; −∞ = never.
        width_m: root of the area that the middle of the cameras would see, averaged over `settle_s` while it does not
            change.
        shrinking: share of it that is lost in a second, from its last two frames; 0 while it is not.
        slow_m: the same, lagging by `appears_s`.
        own: whether that width was told by the marker's own depth rather than by its hand's.
        changing: share by which the visible paint has grown or shrunk of late, 0 to 1.
        wider: how much wider this camera would see the whole marker than one in the middle of all, by how it points.
    """

    t_s: float = -math.inf
    width_m: float = 0.0
    shrinking: float = 0.0
    slow_m: float = 0.0
    own: bool = False
    changing: float = 0.0
    wider: float = 1.0

    def expected_m(self, t_s: float, shrinking: float) -> float:
        """Return the width at a moment after the last frame, if it goes on shrinking as it did, or less strongly."""
        return self.width_m * max(1.0 - min(self.shrinking, shrinking) * (t_s - self.t_s), 0.0)


class Paint:
    """What C cameras see of the paint of M markers. Plain numbers: there are too few of them for numpy.

    Attributes:
        bend: (M,) c of each fingertip by its area, −1 to 0.
    """

    def __init__(self, cameras: Sequence[CameraModel], radius_m: FloatArray, settings: PaintSettings) -> None:
        """Begin with the radii (M,) of fingertips, metres; 0 for a marker that is none."""
        self._settings = settings
        self._radius_m: list[float] = radius_m.tolist()
        self._cosine: list[float] = np.linspace(_STRAIGHT_AWAY, 0.0, 64).tolist()
        self._share = [self._seen(c) for c in self._cosine]
        self._least_share = self._seen(settings.most_bend)
        # What a finger bent as usual shows of its width when seen from the side.
        self._usual = math.sqrt(self._seen(settings.first_bend))
        # Root of the area of a tip seen from the side, painted over `CAP_LENGTH_M`; the rim of it is mixed with what is
        # behind.
        flat = 2.0 * radius_m * np.maximum(CAP_LENGTH_M - radius_m, 0.0) + 0.5 * np.pi * radius_m**2
        self._flat_m: list[float] = np.sqrt(settings.found * flat).tolist()
        self._focal_px = [float(camera.K[0, 0]) for camera in cameras]
        middle = np.stack([camera.center for camera in cameras]).mean(axis=0)
        # In each camera's frame, where the middle of the cameras is, and in its picture the direction away from that.
        self._middle: list[Vector] = [vector(camera.to_camera(middle[None])[0]) for camera in cameras]
        self._away: FloatArray = np.array([[-x, -y] for x, y, _ in self._middle])
        self._away /= np.maximum(np.hypot(*self._away.T), 1e-9)[:, None]
        self._cameras = range(len(cameras))
        self.clear()

    def clear(self) -> None:
        """Forget all areas."""
        markers = range(len(self._radius_m))
        self._shown = [[_Shown() for _ in self._cameras] for _ in markers]
        self._largest_m = [0.0 for _ in markers]
        self.bend = [self._settings.first_bend for _ in markers]

    def along(
        self,
        camera: int,
        markers: Sequence[int],
        areas_px: Sequence[float],
        tips: Sequence[Vector],
        bases: Sequence[Vector],
        reaches_m: Sequence[float],
    ) -> list[tuple[float, float]]:
        """Return what to add to a camera's views (N,) of fingertips for the side that it sees, normalised units.

        Args:
            camera: that sees them.
            markers: (N,) that it sees.
            areas_px: (N,) visible, square pixels; 0 = not told.
            tips: (N,) where they are, metres, camera frame.
            bases: (N,) where their fingers begin, metres, camera frame.
            reaches_m: (N,) how far from there the tips of straight fingers are; 0 = not known.
        """
        settings, middle = self._settings, self._middle[camera]
        shifts = []
        for marker, area, tip, base, reach in zip(markers, areas_px, tips, bases, reaches_m, strict=True):
            told = self._told(tip, base, reach)
            shown = self._shown[marker][camera]
            if area <= 0.0 or self._radius_m[marker] <= 0.0 or told <= 0.0:
                shown.wider = 1.0
                shifts.append((0.0, 0.0))
                continue
            c = max(self.bend[marker], settings.most_bend)
            sight = unit((middle[0] - tip[0], middle[1] - tip[1], middle[2] - tip[2]))
            finger = (tip[0] - base[0], tip[1] - base[1], tip[2] - base[2])
            sideways = unit(across(finger, sight))
            s = math.sqrt(1.0 - c * c)
            d = (c * sight[0] + s * sideways[0], c * sight[1] + s * sideways[1], c * sight[2] + s * sideways[2])
            # The camera stands at the origin.
            own = unit((-tip[0], -tip[1], -tip[2]))
            x, y, z = unit(across(d, own))
            bent = dot(d, own)
            shown.wider = (self._seen(bent) / self._seen(c)) ** (0.5 * told)
            size = told * settings.side * self._radius_m[marker] * bent
            depth = max(tip[2], 0.05)
            shifts.append((size * (x - tip[0] / depth * z) / depth, size * (y - tip[1] / depth * z) / depth))
        return shifts

    def _seen(self, c: float) -> float:
        """Return A(c) / A(0)."""
        shaft, end, c = 2.0 * self._settings.shaft, 0.5 * math.pi, max(c, _STRAIGHT_AWAY)
        return (shaft * math.sqrt(max(1.0 - c * c, 0.0)) + end * (1.0 + c)) / (shaft + end)

    def _told(self, tip: Vector, base: Vector, reach_m: float) -> float:
        """Return how much of the way from where a finger begins to its tip tells its end's direction, 0 to 1."""
        if reach_m <= 0.0:
            return 1.0
        curled, straight = self._settings.curled, self._settings.straight
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
    ) -> tuple[FloatArray, FloatArray]:
        """Return how far the middles of markers (N,) lie beside what is seen, and how sure that is.

        Args:
            camera: that sees them.
            markers: (N,) that it sees.
            t_s: time of the frame, seconds.
            areas_px: (N,) visible, square pixels; 0 = not told.
            depths_m: (N,) of the markers; infinite = not known, and then nothing is told.
            period_s: of the camera's frames.
            known: (N,) whose own depth is known well; how large the others are is not learnt.
            border: (N, 3) of the picture, as `Sightings` has it; none where it is far.

        Returns:
            (N, 2) what to add to the views and (N,) its standard deviation, normalised units.
        """
        sizes, doubts = [], []
        for marker, area, depth, sure in zip(markers, areas_px, depths_m, known, strict=True):
            if math.isinf(depth):
                size, doubt = 0.0, 0.0
            else:
                size, doubt = self._hidden(camera, marker, t_s, area, depth, sure)
            sizes.append(size)
            doubts.append(doubt)
        # Views that err alike tell as much together as one of them.
        alike = math.sqrt(max(1.0, self._settings.lasts_s / period_s))
        shifts = np.array(sizes)[:, None] * (self._settings.shift * self._away[camera])
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
        """Make up for what the picture's border cuts off, in place.

        The middle of a marker that reaches over it is as far from its inner edge as half of its width is; what is seen
        of it begins at the border.
        """
        for row, (marker, depth, (far, x, y)) in enumerate(zip(markers, depths_m, border, strict=True)):
            missing = 0.5 * self._largest_m[marker] / depth - far
            if missing > 0.0:
                shifts[row] = missing * x, missing * y
                doubts[row] = max(doubts[row], self._settings.cut * missing)

    def _hidden(
        self, camera: int, marker: int, t_s: float, area_px: float, depth_m: float, known: bool
    ) -> tuple[float, float]:
        """Return how wide the strip is that is made up for, and the standard deviation of what hides, normalised."""
        settings, every = self._settings, self._shown[marker]
        side_px, tip = math.sqrt(area_px), self._radius_m[marker] > 0.0
        self._watch(every[camera], t_s, side_px / self._focal_px[camera] * depth_m / every[camera].wider, known)
        full = told_full = 0.0
        for shown in every:
            if shown.t_s >= t_s - settings.compare_s:
                # A finger that bends shows all cameras less and less; what shows less by being later hides nothing.
                there = shown.expected_m(t_s, every[camera].shrinking)
                full = max(full, there)
                if shown.own:
                    told_full = max(told_full, there)
        # The largest area is not known at first: half way between that of a finger bent as usual and that of paint as
        # long as it should be. What is seen before anything is told of its distance is the best guess until then.
        told_full = told_full or full
        largest = self._largest_m[marker] or (
            (told_full / self._usual) ** settings.seen_first * self._flat_m[marker] ** (1.0 - settings.seen_first)
        )
        largest = max(told_full, largest)
        if known:
            self._largest_m[marker] = largest
            if area_px > 0.0:
                share = (told_full / max(largest, 1e-9)) ** 2
                self.bend[marker] = interpolated(share, self._share, self._cosine)
        if area_px <= 0.0:
            return 0.0, 0.0
        width = every[camera].width_m
        less = 1.0 - (width / full) ** 2 if full > width else 0.0
        uneven = settings.doubtful * (settings.uneven + settings.rim_px / max(side_px, 1.0))
        # Wiener's filter: what differs by more than whole markers do is hidden, all of it.
        hidden = less**3 / (less * less + uneven * uneven)
        if tip:
            strip = hidden * full / depth_m
            return strip, settings.doubt * strip
        # What turning away does not explain is hidden, nobody knows on which side: the middle may be anywhere within
        # half of that strip to either side, evenly.
        strip = hidden * full**2 / max(largest, 1e-9) / depth_m
        lost = max(1.0 - (width / max(largest, 1e-9)) ** 2 / settings.most_turned, 0.0)
        of_all = settings.shift / math.sqrt(3.0) * lost * largest / depth_m
        return 0.0, math.hypot(settings.doubt * strip, of_all)

    def _watch(self, shown: _Shown, t_s: float, width_m: float, known: bool) -> None:
        """Take the width, metres, of what a camera shows of a marker: its place and distance make no difference."""
        settings = self._settings
        elapsed = max(t_s - shown.t_s, 0.0)
        lost = elapsed > settings.compare_s
        # What comes back is as it was, or comes out from behind something.
        slow = width_m if math.isinf(elapsed) else shown.slow_m
        if not lost:
            slow -= math.expm1(-elapsed / settings.appears_s) * (width_m - slow)
        shown.slow_m = slow
        shown.changing = max(_unlike(slow, width_m) - settings.uneven, 0.0) if width_m > 0.0 else 0.0
        # At rest the noise of areas is averaged. What one camera loses first must not wait: it becomes depth.
        afresh = lost or not shown.own or shown.changing > 0.0
        before = shown.width_m
        shown.width_m += (1.0 if afresh else -math.expm1(-elapsed / settings.settle_s)) * (width_m - shown.width_m)
        shrinks = shown.width_m < before and shown.changing > 0.0 and not lost
        shown.shrinking = (1.0 - shown.width_m / before) / elapsed if shrinks and elapsed > 0.0 else 0.0
        shown.t_s, shown.own = t_s, known

    def hidden_m2(self, marker: int) -> float:
        """Return the variance of a fingertip's middle for paint that no camera shows, each axis, square metres.

        What bends away shows less, too; what is missing beyond that is hidden, nobody knows on which side.
        """
        largest, full = self._largest_m[marker], 0.0
        if not largest or self._radius_m[marker] <= 0.0:
            return 0.0
        every = self._shown[marker]
        since_s = max(shown.t_s for shown in every) - self._settings.compare_s
        for shown in every:
            if shown.t_s >= since_s and shown.width_m > full:
                full = shown.width_m
        lost = 1.0 - (full / largest) ** 2 / self._least_share
        return (self._settings.hidden * lost * largest) ** 2 if lost > 0.0 and full > 0.0 else 0.0

    def doubt_back(self, marker: int, depth_m: float) -> float:
        """Return how far what is seen of a marker may be off its middle when it comes back: normalised units.

        Of what is seen for the first time nothing tells that it was hidden.
        """
        if not self._largest_m[marker]:
            return 0.0
        return self._settings.appearing * 2.0 * self._radius_m[marker] / depth_m

    def slack(self, camera: int, areas_px: Sequence[float]) -> FloatArray:
        """Return how far views of markers (N,) may be off for what hides them, normalised units."""
        settings, focal_px = self._settings, self._focal_px[camera]
        return np.array([(settings.slack_px + settings.slack * math.sqrt(area)) / focal_px for area in areas_px])


def _unlike(width: float, other: float) -> float:
    """Return the share of the larger of two areas, of these roots, that the smaller one lacks, 0 to 1."""
    return 1.0 - (min(width, other) / max(width, other)) ** 2 if width > 0.0 or other > 0.0 else 0.0
