"""From the middle of the paint that a camera sees to the middle of the marker.

A fingertip is round, so a camera sees the paint on the side that faces it. Of a finger along d, with c = d·u for the
direction u to the camera, the middle of that side lies off the finger's axis, and in the picture that is

    −(π/4) ρ r c        further along the finger,

r its radius, ρ ≈ 0.85 the share of the paint that is on its shaft rather than on its round end. The direction of a
finger across the view is that to the tip from beside the patch on the back of the hand, where its knuckle is; how far
it bends away from the camera is told by its visible area, which is

    A(c) / A(0) = (2 λ √(1 − c²) + (π/2) (1 + c)) / (2 λ + π/2)        for c ≤ 0,

λ r being the length of the painted shaft, beside the largest area that it has shown.

What hides part of a marker is nearer than it, so it hides more of it in the camera on its own side: of two cameras the
one that sees less paint sees the middle of that too far towards the other camera, by half of the strip that is hidden.
With the share h that is hidden in one view and not in the fullest one, and w the marker's width, that is ½ h w.
Of a patch, whose size is known, the strip is as high as the patch: what both views show of it says how wide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import CAP_LENGTH_M
from rhot.geometry.camera import CameraModel
from rhot_fusion.filter.settings import PaintSettings

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


class Paint:
    """What C cameras see of the paint of M markers.

    Attributes:
        bend: (M,) c of each fingertip by its area, −1 to 0.
        changing: (C, M) share by which the paint that is visible has grown or shrunk of late, 0 to 1.
    """

    def __init__(self, cameras: Sequence[CameraModel], radius_m: FloatArray, settings: PaintSettings) -> None:
        """Begin with the radii (M,) of fingertips, metres; 0 for a marker that is none."""
        self._settings = settings
        self._radius_m = radius_m
        markers = len(radius_m)
        self._cosine: FloatArray = np.linspace(-1.0, 0.0, 64)
        shaft = 2.0 * settings.shaft
        end = 0.5 * np.pi
        self._share: FloatArray = (shaft * np.sqrt(1.0 - self._cosine**2) + end * (1.0 + self._cosine)) / (shaft + end)
        # What a finger bent as usual shows of its width when seen from the side.
        self._usual = float(np.sqrt(np.interp(settings.first_bend, self._cosine, self._share)))
        self._largest: FloatArray = np.zeros(markers)
        # Root of the area of a tip seen from the side, painted over `CAP_LENGTH_M`; the rim of it is mixed with what is
        # behind.
        flat = 2.0 * radius_m * np.maximum(CAP_LENGTH_M - radius_m, 0.0) + end * radius_m**2
        self._flat_m: FloatArray = np.sqrt(settings.found * flat)
        self.bend: FloatArray = np.full(markers, settings.first_bend)
        self._focal_px = [float(camera.K[0, 0]) for camera in cameras]
        centers = np.stack([camera.center for camera in cameras])
        self._middle: FloatArray = centers.mean(axis=0)
        # In each camera's picture, the direction away from the other cameras.
        away = [camera.R_camera_rig[:2] @ (camera.center - self._middle) for camera in cameras]
        self._away: FloatArray = np.array([a / max(float(np.hypot(*a)), 1e-9) for a in away])
        self._tips: BoolArray = radius_m > 0.0
        self._width: FloatArray = np.zeros((len(cameras), markers))
        self.changing: FloatArray = np.zeros((len(cameras), markers))
        self._slow: FloatArray = np.zeros((len(cameras), markers))
        self._seen_s: FloatArray = np.full((len(cameras), markers), -np.inf)
        # Whether that width was told by the marker's own depth rather than by its hand's.
        self._own: BoolArray = np.zeros((len(cameras), markers), dtype=np.bool_)

    def clear(self) -> None:
        """Forget all areas."""
        self._seen_s[:] = -np.inf
        self._slow[:] = 0.0
        self._largest[:] = 0.0
        self.bend[:] = self._settings.first_bend

    def along(self, camera: CameraModel, index: IndexArray, tip: FloatArray, base: FloatArray) -> FloatArray:
        """Return what to add to a camera's views (N, 2) of fingertips for the side that it sees, normalised units.

        Args:
            camera: that sees them.
            index: (N,) markers.
            tip: (N, 3) where they are, metres, rig frame.
            base: (N, 3) where their fingers begin.
        """
        c = np.maximum(self.bend[index], self._settings.most_bend)[:, None]
        sight = _unit(self._middle - tip)
        finger = tip - base
        d = c * sight + np.sqrt(1.0 - c * c) * _unit(finger - np.vecdot(finger, sight)[:, None] * sight)
        own = _unit(camera.center - tip)
        c = np.vecdot(d, own)[:, None]
        offset = self._settings.side * self._radius_m[index][:, None] * c * _unit(d - c * own)
        local, offset = tip @ camera.R_camera_rig.T + camera.t_camera_rig, offset @ camera.R_camera_rig.T
        depth = np.maximum(local[:, 2:], 0.05)
        shift: FloatArray = (offset[:, :2] - local[:, :2] / depth * offset[:, 2:]) / depth
        return shift

    def correct(
        self,
        camera: int,
        index: IndexArray,
        t_s: float,
        area_px: FloatArray,
        depth_m: FloatArray,
        period_s: float,
        known: BoolArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return how far the middles of markers (N,) lie beside what is seen, and how sure that is.

        Args:
            camera: that sees them.
            index: (N,) markers.
            t_s: when.
            area_px: (N,) visible, square pixels; 0 = not told.
            depth_m: (N,) of the markers; infinite = not known, and then nothing is told.
            period_s: of the camera's frames.
            known: (N,) whose own depth is known well; how large the others are is not learnt.

        Returns:
            (N, 2) what to add to the views and (N,) its standard deviation, normalised units.
        """
        settings = self._settings
        if not np.isfinite(depth_m).all():
            return np.zeros((len(index), 2)), np.zeros(len(index))
        # Where all markers are seen, rows in place cost less than rows by their numbers.
        rows = slice(None) if len(index) == len(self._radius_m) else index
        side_px = np.sqrt(area_px)
        width = side_px / self._focal_px[camera]
        # Widths in metres: how far the cameras are from the marker makes no difference.
        width_m = width * depth_m
        # Both cameras' widths lag by the same time: a marker that turns away shrinks in both.
        elapsed = np.maximum(t_s - self._seen_s[camera, rows], 0.0)
        afresh = (elapsed > settings.compare_s) | ~self._own[camera, rows]
        gain = np.where(afresh, 1.0, -np.expm1(-elapsed / settings.settle_s))
        old = self._width[camera, rows]
        lagging = old + gain * (width_m - old)
        self._width[camera, rows] = lagging
        self.changing[camera, rows] = self._changing(camera, rows, elapsed, width_m)
        self._seen_s[camera, rows] = t_s
        self._own[camera, rows] = known
        recent = self._seen_s[:, rows] >= t_s - settings.compare_s
        full = np.where(recent, self._width[:, rows], 0.0).max(axis=0)
        told_full = np.where(recent & self._own[:, rows], self._width[:, rows], 0.0).max(axis=0)
        before = self._largest[rows]
        if not before.all():
            # The largest area is not known at first: half way between that of a finger bent as usual and that of paint
            # as long as it should be.
            first = (told_full / self._usual) ** settings.seen_first * self._flat_m[rows] ** (1.0 - settings.seen_first)
            before = np.where(before > 0.0, before, first)
        largest = np.maximum(told_full, before)
        self._largest[rows] = np.where(known, largest, self._largest[rows])
        share = np.square(told_full / np.maximum(largest, 1e-9))
        told = (area_px > 0.0) & known
        self.bend[rows] = np.where(told, np.interp(share, self._share, self._cosine), self.bend[rows])
        share = np.square(lagging / np.maximum(full, 1e-9))
        uneven = settings.uneven + settings.rim_px / np.maximum(side_px, 1.0)
        hidden = np.where(area_px > 0.0, np.minimum(np.maximum(1.0 - share - uneven, 0.0), 1.0), 0.0)
        wide = np.where(self._tips[rows], full, np.square(full) / np.maximum(largest, 1e-9))
        size = hidden * wide / depth_m
        # What turning away does not explain is hidden from all cameras, nobody knows on which side: the middle may be
        # anywhere within half of that strip to either side, evenly.
        seen = np.square(lagging / np.maximum(largest, 1e-9))
        lost = np.where(self._tips[rows] | (area_px <= 0.0), 0.0, np.maximum(1.0 - seen / settings.most_turned, 0.0))
        of_all = settings.shift / math.sqrt(3.0) * lost * largest / depth_m
        doubt = np.hypot(settings.doubt * size, of_all)
        # Views that err alike tell as much together as one of them.
        doubt *= math.sqrt(max(1.0, settings.lasts_s / period_s))
        return settings.shift * size[:, None] * self._away[camera], doubt

    def _changing(self, camera: int, rows: IndexArray | slice, elapsed: FloatArray, width: FloatArray) -> FloatArray:
        """Return by what share (N,) of it the visible paint has grown or shrunk of late, 0 to 1."""
        settings = self._settings
        lost = elapsed > settings.compare_s
        # What comes back is as it was, or comes out from behind something.
        old = np.where(np.isinf(elapsed), width, self._slow[camera, rows])
        slow = old - np.expm1(-np.where(lost, 0.0, elapsed) / settings.appears_s) * (width - old)
        self._slow[camera, rows] = slow
        low, high = np.minimum(slow, width), np.maximum(slow, width)
        change: FloatArray = 1.0 - np.square(low / np.maximum(high, 1e-9)) - settings.uneven
        return np.where(width > 0.0, np.minimum(np.maximum(change, 0.0), 1.0), 0.0)

    @property
    def unlike(self) -> FloatArray:
        """Share (M,) of the paint in the fullest of the newest views that the poorest of them does not show, 0 to 1."""
        recent = self._seen_s >= self._seen_s.max(axis=0) - self._settings.compare_s
        full = np.where(recent, self._width, 0.0).max(axis=0)
        least = np.where(recent, self._width, np.inf).min(axis=0)
        return np.where(full > 0.0, 1.0 - np.square(np.minimum(least / np.maximum(full, 1e-9), 1.0)), 0.0)

    def doubt_back(self, index: IndexArray, depth_m: FloatArray) -> FloatArray:
        """Return how far what is seen of markers (N,) may be off their middles when they come back: normalised units.

        Of what is seen for the first time nothing tells that it was hidden.
        """
        whole = np.where(self._largest[index] > 0.0, 2.0 * self._radius_m[index], 0.0)
        doubt: FloatArray = self._settings.appearing * whole / depth_m
        return doubt

    def slack(self, camera: int, area_px: FloatArray) -> FloatArray:
        """Return how far views of markers (N,) may be off for what hides them, normalised units."""
        slack: FloatArray = (self._settings.slack_px + self._settings.slack * np.sqrt(area_px)) / self._focal_px[camera]
        return slack


def _unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (N, 3) of length 1."""
    unit: FloatArray = vectors / np.maximum(np.sqrt(np.vecdot(vectors, vectors)), 1e-6)[:, None]
    return unit
