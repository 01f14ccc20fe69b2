"""From rings in space to outlines in a picture that is read out row by row.

A ball of radius r at C (camera frame, d = |C|) is outlined by the circle about C·(1 − r²/d²) with radius
r·√(1 − r²/d²), perpendicular to C. Ring points are projected through the lens at three moments that span exposure
and read-out; a point's path between them is a parabola, on which each point is placed at the time of its own row:

    t(v) = t_first_row + v/(H − 1) · readout + offset within the exposure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_sim.world.parts import BALL, DISC, PATCH, Rings

_NEAR_M: Final = 0.02
"""Nothing is drawn nearer to the lens than this."""


@dataclass(frozen=True, slots=True)
class OutlinePaths:
    """Paths of all ring points.

    Attributes:
        start, middle, end: (R, V, 2) pixels, at the beginning, middle and end of the span.
        distances: (R,) metres from the camera at the middle of the span.
    """

    start: FloatArray
    middle: FloatArray
    end: FloatArray
    distances: FloatArray

    def at(self, x: FloatArray) -> FloatArray:
        """Return points (R, V, 2), pixels, at x (R, V) in [−1, 1] from the span's start to its end."""
        half = 0.5 * (self.end - self.start)
        bend = 0.5 * (self.end + self.start) - self.middle
        x = x[..., None]
        points: FloatArray = self.middle + x * (half + x * bend)
        return points


class Outliner:
    """Projects rings through one camera.

    Args:
        camera: the true camera.
        vertices: per ring.
        shrink_px: outlines are drawn this much too large by the rasteriser, and so are made smaller by it.
        seam: share of `shrink_px` that applies where paint ends.
    """

    def __init__(self, camera: CameraModel, vertices: int, shrink_px: float, seam: float = 1.0) -> None:
        self.camera = camera
        self._seam = seam
        self._lens = CameraModel.from_arrays(camera.width, camera.height, camera.K, camera.distortion, np.eye(4))
        self._shrink = shrink_px / float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
        phi = 2.0 * np.pi * (np.arange(vertices) + 0.5) / vertices
        # A polygon with as much area as the circle.
        grow = 1.0 / np.sqrt(np.sin(2.0 * np.pi / vertices) / (2.0 * np.pi / vertices))
        self._circle = grow * np.stack([np.cos(phi), np.sin(phi)])
        self._square = _square(vertices)

    def paths(self, rings: Rings, pictures: int = 1) -> list[OutlinePaths]:
        """Return the paths of rings in each picture, at three moments of it (or at one, which stands still)."""
        to_camera = self.camera.R_camera_rig.T
        C = rings.centers @ to_camera + self.camera.t_camera_rig
        C[..., 2] = np.maximum(C[..., 2], _NEAR_M)
        axes = rings.axes @ to_camera
        shrink = self._shrink * C[..., 2]
        extents = np.repeat(rings.extents[None], len(C), axis=0)
        distance = np.sqrt(np.einsum("krc,krc->kr", C, C))
        view = C / distance[..., None]
        each = len(C) // pictures
        distances = distance[each // 2 :: each].copy()
        balls, discs, patches = (np.flatnonzero(rings.kinds == kind) for kind in (BALL, DISC, PATCH))
        self._outline_balls(C, axes, extents, balls)
        extents[:, balls] = np.maximum(extents[:, balls] - shrink[:, balls, None], 1e-5)
        if discs.size:
            inset = self._seam * shrink[:, discs]
            extents[:, discs] = np.maximum(extents[:, discs] - inset[..., None], 1e-5)
            shift = rings.shift_axes[:, discs] @ to_camera
            # A rim seen under the angle θ shrinks by cos θ of what its radius does; the shift does the rest,
            # (1 − cos θ)/sin θ = tan(θ/2).
            cosine = np.minimum(np.abs(np.einsum("krc,krc->kr", shift, view[:, discs])), 1.0)
            C[:, discs] += (inset * np.sqrt((1.0 - cosine) / (1.0 + cosine)))[..., None] * shift
        if patches.size:
            slant = np.einsum("krac,krc->kra", axes[:, patches], view[:, patches])
            slanted = shrink[:, patches, None] / np.sqrt(np.maximum(1.0 - slant**2, 0.01))
            extents[:, patches] = np.maximum(extents[:, patches] - slanted, 1e-5)
        pixels = self._project(C, axes * extents[..., None], patches)
        first, middle, last = (pixels[moment::each] for moment in (0, each // 2, each - 1))
        return [OutlinePaths(*parts) for parts in zip(first, middle, last, distances, strict=True)]

    @staticmethod
    def _outline_balls(C: FloatArray, axes: FloatArray, extents: FloatArray, balls: NDArray[np.intp]) -> None:
        """Turn balls in place into the circles that outline them."""
        center = C[:, balls]
        distance = np.sqrt(np.einsum("krc,krc->kr", center, center))
        n = center / distance[..., None]
        rest = np.sqrt(np.maximum(1.0 - (extents[:, balls, 0] / distance) ** 2, 0.0))
        C[:, balls] *= (rest**2)[..., None]
        extents[:, balls] *= rest[..., None]
        first = -n * n[..., :1]
        first[..., 0] += 1.0
        first /= np.sqrt(np.einsum("krc,krc->kr", first, first))[..., None]
        axes[:, balls, 0] = first
        second = axes[:, balls, 1]
        second[..., 0] = n[..., 1] * first[..., 2] - n[..., 2] * first[..., 1]
        second[..., 1] = n[..., 2] * first[..., 0] - n[..., 0] * first[..., 2]
        second[..., 2] = n[..., 0] * first[..., 1] - n[..., 1] * first[..., 0]
        axes[:, balls, 1] = second

    def _project(self, C: FloatArray, half_axes: FloatArray, patches: NDArray[np.intp]) -> FloatArray:
        points = C[:, :, None, :] + self._circle.T @ half_axes
        if patches.size:
            points[:, patches] = C[:, patches, None, :] + self._square @ half_axes[:, patches]
        np.maximum(points[..., 2], _NEAR_M, out=points[..., 2])
        return self._lens.project(points.reshape(-1, 3)).reshape(*points.shape[:-1], 2)


def _square(vertices: int) -> FloatArray:
    """Return points (V, 2) along the edges of the square [−1, 1]², corners included."""
    per_side = vertices // 4
    step = 2.0 * np.arange(per_side) / per_side - 1.0
    one = np.ones(per_side)
    sides = [np.stack(pair, axis=1) for pair in ((step, -one), (one, step), (-step, one), (-one, -step))]
    return np.concatenate(sides)


def row_timed(paths: OutlinePaths, moment: float, exposure_s: float, readout_s: float, height: int) -> FloatArray:
    """Return ring points (R, V, 2), pixels, each at the time of its own row.

    Args:
        paths: over the span of exposure and read-out.
        moment: share of the exposure that has passed.
        exposure_s: of every row.
        readout_s: from the first to the last row.
        height: rows of the picture.
    """
    span = exposure_s + readout_s
    if span <= 0.0:
        return paths.middle
    points = paths.middle
    # The row changes little with the time within the span, so the second round is already exact to 0.01 px.
    for _ in range(2 if readout_s > 0.0 else 1):
        row = np.clip(points[..., 1] / (height - 1), 0.0, 1.0)
        passed = moment * exposure_s + row * readout_s
        points = paths.at(2.0 * passed / span - 1.0)
    return points
