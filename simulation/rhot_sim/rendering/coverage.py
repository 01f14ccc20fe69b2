"""What a camera truly sees of each marker: the centre of its visible area and the share that nothing hides.

The world is drawn as a picture of labels with the very outlines and order of the renderer, at a moment (no read-out, no
blur), finer than the pixel grid and not anti-aliased. A scale of 8 with 64 vertices finds centres to 0.01 px; the
default is for judging visibility many times.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel
from rhot_sim.rendering.canvas import FIXED_BITS, PLAIN_GROWTH, CanvasWindow, far_to_near, on_canvas
from rhot_sim.rendering.outline import Outliner
from rhot_sim.world.body import Body
from rhot_sim.world.parts import Group
from rhot_sim.world.world import World

Labels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class MarkerView:
    """One marker in one camera at one moment.

    Attributes:
        u, v: centre of the visible area, pixels, raw image; of the hidden outline where nothing is visible.
        area_px: visible area, square pixels.
        visible_fraction: visible area over the area that the marker would cover with nothing before it.
        inside: whether the marker's whole outline lies in the picture.
    """

    u: float
    v: float
    area_px: float
    visible_fraction: float
    inside: bool

    def shows(self, least_share: float) -> bool:
        """Tell whether the camera sees at least this share of the marker, wholly inside its picture."""
        return self.inside and self.visible_fraction >= least_share


class MarkerCoverage:
    """Tells what one camera sees of a world's markers.

    Args:
        camera: the true camera.
        world: what it looks at.
        scale: label pixels to a pixel of the picture.
        vertices: per ring; a multiple of 4.
    """

    def __init__(self, camera: CameraModel, world: World, scale: int = 2, vertices: int = 16) -> None:
        self.camera = camera
        self.world = world
        self._scale = scale
        self._shrink_px = PLAIN_GROWTH / scale
        self._body = Body(world)
        self._outliner = Outliner(camera, vertices, self._shrink_px)
        self._labels = {name: number for number, name in enumerate(world.markers, start=1)}

    def at(self, t_s: float) -> dict[str, MarkerView]:
        """Return the view of each marker at `t_s`, seconds since the world's start."""
        rings, (groups,) = self._body.rings(self.world.sample(np.array([t_s])), self.camera.center)
        (paths,) = self._outliner.paths(rings)
        points = paths.middle
        outlines = {name: points[list(indices)].reshape(-1, 2) for name, indices in self._body.marker_rings.items()}
        window = CanvasWindow.around(np.concatenate(list(outlines.values())), self.camera.width, self.camera.height)
        if window is None:
            return {name: self._view(name, outline, None, None) for name, outline in outlines.items()}
        labels = self._draw(points, far_to_near(groups, paths.distances), window)
        return {name: self._view(name, outline, labels, window) for name, outline in outlines.items()}

    def _draw(self, points: FloatArray, groups: list[Group], window: CanvasWindow) -> Labels:
        scale = self._scale
        labels: Labels = np.zeros(
            ((window.bottom - window.top) * scale, (window.right - window.left) * scale), dtype=np.uint8
        )
        fixed = on_canvas(points, window, scale)
        for group in groups:
            for part in group.parts:
                hull = cv2.convexHull(fixed[part.rings, :].reshape(-1, 1, 2))
                cv2.fillConvexPoly(labels, hull, self._labels.get(part.paint, 0), cv2.LINE_8, FIXED_BITS)
        return labels

    def _view(self, name: str, outline: FloatArray, labels: Labels | None, window: CanvasWindow | None) -> MarkerView:
        hull = cv2.convexHull(outline.astype(np.float32))
        # The outline was drawn inset by δ; the full area is A + perimeter · δ (Steiner).
        full = cv2.contourArea(hull) + cv2.arcLength(hull, True) * self._shrink_px
        inside = bool(self.camera.contains(outline).all())
        near = CanvasWindow.around(outline, self.camera.width, self.camera.height)
        if labels is None or window is None or near is None:
            return self._hidden(outline)
        scale = self._scale
        rows = slice((near.top - window.top) * scale, (near.bottom - window.top) * scale)
        columns = slice((near.left - window.left) * scale, (near.right - window.left) * scale)
        moments = cv2.moments((labels[rows, columns] == self._labels[name]).view(np.uint8), True)
        count = moments["m00"]
        if count == 0.0:
            return self._hidden(outline)
        u = (moments["m10"] / count + 0.5) / scale - 0.5 + near.left
        v = (moments["m01"] / count + 0.5) / scale - 0.5 + near.top
        area = count / scale**2
        return MarkerView(u, v, area, min(1.0, area / full), inside)

    def _hidden(self, outline: FloatArray) -> MarkerView:
        u, v = outline.mean(axis=0)
        return MarkerView(float(u), float(v), 0.0, 0.0, bool(self.camera.contains(outline).all()))
