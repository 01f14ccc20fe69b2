"""Finding the feet's markers in a picture: where their corners are, and how surely they are markers at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray, ImageArray
from rhot.geometry.hull import Region

# Corners of a marker from its four edges.
#
# Each edge is crossed many times; every crossing says to a fraction of a pixel where black turns white, and a line
# through them is surer than the one corner at its end, which blur rounds off. Corners are where neighbouring lines
# meet.

_RIM: Final = 0.12
"""Share of an edge at its ends that is left out: there the neighbour's blur reaches in."""
_STEP_PX: Final = 0.5
"""Between samples across an edge: blur spreads it over two pixels or more."""
_MAX_REACH_PX: Final = 4.0
"""And at most so many pixels; chosen."""
_MIN_CONTRAST: Final = 12.0
"""Grey levels between both sides of an edge; less is noise. Chosen."""
_MIN_SHARE: Final = 0.4
"""Of the points along an edge that must be found. Chosen."""
_MAX_SHIFT_PX: Final = 2.0
"""Corners that move further than this from where the detector had them met other edges. Chosen."""
UNREFINED_SIGMA_PX: Final = 0.4
"""Of a corner as the detector finds it, per axis."""


def sample_picture(grey: ImageArray, positions: NDArray[np.float32]) -> FloatArray:
    """Return the grey levels (N,) at positions (N, 2), pixels, between pixels by bilinear interpolation."""
    u, v = np.ascontiguousarray(positions[:, 0]), np.ascontiguousarray(positions[:, 1])
    values = cv2.remap(grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).ravel()


def refine_corners(grey: ImageArray, corners: FloatArray, cells: int) -> tuple[FloatArray, float]:
    """Return the corners (4, 2), pixels, where lines through a marker's edges meet; as given where one is not clear.

    With them comes their standard deviation per axis, pixels, from the scatter of the crossings about the lines.

    Args:
        grey: (H, W) picture.
        corners: (4, 2) found corners, cyclic.
        cells: of the marker along a side, with its border.
    """
    following = np.roll(corners, -1, axis=0)
    along = following - corners
    lengths = np.linalg.norm(along, axis=1)
    if lengths.min() < 4.0:
        return corners, UNREFINED_SIGMA_PX
    outwards = np.column_stack([along[:, 1], -along[:, 0]]) / lengths[:, None]
    if float(np.einsum("ni,ni->", outwards, corners - corners.mean(axis=0))) < 0.0:
        outwards = -outwards
    # How far across an edge is looked, in cells: the printed margin is little wider, and inside lie the bits.
    reach = min(_MAX_REACH_PX, 0.65 * float(lengths.min()) / cells)
    # Points along each edge at which it is looked for; chosen.
    shares = np.linspace(_RIM, 1.0 - _RIM, 14)
    steps = np.arange(-reach, reach + 1e-6, _STEP_PX)
    starts = corners[:, None] + shares[None, :, None] * along[:, None]
    positions = (starts[:, :, None] + steps[None, None, :, None] * outwards[:, None, None]).astype(np.float32)
    shape = positions.shape[:3]
    across, clear = _crossings(sample_picture(grey, positions.reshape(-1, 2)).reshape(shape), steps)
    lines, scatter, straight = _lines(starts + across[..., None] * outwards[:, None], clear, outwards)
    if not straight:
        return corners, UNREFINED_SIGMA_PX
    refined = np.cross(np.roll(lines, 1, axis=0), lines)
    if (np.abs(refined[:, 2]) < 1e-9).any():
        return corners, UNREFINED_SIGMA_PX
    refined = refined[:, :2] / refined[:, 2:]
    moved = np.linalg.norm(refined - corners, axis=1)
    if float(moved.max()) > _MAX_SHIFT_PX:
        return corners, UNREFINED_SIGMA_PX
    # What the scatter about the lines does not tell of; corners in clear simulated pictures are 0.035 px off in
    # all.
    return refined, max(0.03, scatter)


def _crossings(profiles: FloatArray, steps: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return where profiles (4, N, M) turn from black to white (4, N), pixels outwards, and which do so clearly."""
    rise = np.maximum(np.diff(profiles, axis=2), 0.0)
    middles = 0.5 * (steps[1:] + steps[:-1])
    peak = rise.max(axis=2, keepdims=True)
    # The steepest rise and its flanks alone: noise elsewhere would pull the mean towards the middle.
    near = np.abs(middles - middles[np.argmax(rise, axis=2)][..., None]) <= 1.6
    weights = np.where(near & (rise > 0.15 * peak), rise, 0.0)
    total = weights.sum(axis=2)
    across = (weights * middles).sum(axis=2) / np.maximum(total, 1e-9)
    return across, total >= _MIN_CONTRAST


def _lines(points: FloatArray, clear: NDArray[np.bool_], outwards: FloatArray) -> tuple[FloatArray, float, bool]:
    """Return lines (4, 3), a·u + b·v + c = 0, through the points (4, N, 2) of each side that agree.

    With them come the largest standard deviation of a line's end, which is twice that of its middle (σ·√(4/N)), and
    whether enough points of every side agree on a line along it.
    """
    used = clear.astype(np.float64)
    least = max(3.0, _MIN_SHARE * points.shape[1])
    normals, centres = outwards, points.mean(axis=1)
    count, scatter = used.sum(axis=1), np.zeros(4)
    for _ in range(3):
        count = used.sum(axis=1)
        if float(count.min()) < least:
            return np.zeros((4, 3)), 0.0, False
        centres = (used[..., None] * points).sum(axis=1) / count[:, None]
        difference = points - centres[:, None]
        moments = np.einsum("sn,sni,snj->sij", used, difference, difference)
        # Direction of the larger axis of the points' spread, a quarter turn on is the normal.
        angle = 0.5 * np.arctan2(2.0 * moments[:, 0, 1], moments[:, 0, 0] - moments[:, 1, 1])
        normals = np.column_stack([-np.sin(angle), np.cos(angle)])
        distance = np.abs(np.einsum("sni,si->sn", difference, normals))
        scatter = np.sqrt((used * distance**2).sum(axis=1) / count)
        used = (clear & (distance < np.maximum(0.2, 2.0 * scatter)[:, None])).astype(np.float64)
    along = np.abs(np.einsum("si,si->s", normals, outwards)) > 0.9
    lines = np.column_stack([normals, -np.einsum("si,si->s", normals, centres)])
    return lines, float((2.0 * scatter / np.sqrt(count)).max()), bool(along.all())


MIN_SIDE_PX: Final = 10.0
"""Of a marker's black square: below two pixels a cell (3x3 bits and their border) its bits cannot be told any more."""
MIN_LIKENESS: Final = 0.8
"""Correlation with the marker as it is printed. Real photographed markers of 6x6 bits, 25 px wide, reach 0.94 and more;
the one square of 378 pictures of feet without markers that decodes has 0.58."""
_CELL_SAMPLES: Final = 4
_CELL_INSET: Final = 0.2
"""Samples along each side of a cell, and the share of a cell at its rim that they leave out: it is blurred. Chosen."""


@dataclass(frozen=True, slots=True)
class MarkerDetection:
    """A marker in one picture.

    Attributes:
        marker_id: in its dictionary.
        corners: (4, 2) float64, pixels, upper left, upper right, lower right, lower left as the marker is printed.
        corner_sigma_px: standard deviation of the corners per axis.
        likeness: −1 to 1, correlation of the picture inside the corners with the marker as it is printed.
        side_px: square root of its area.
    """

    marker_id: int
    corners: FloatArray
    corner_sigma_px: float
    likeness: float
    side_px: float


class MarkerFinder:
    """Finds markers of a dictionary, only those that the feet wear."""

    def __init__(self, dictionary: cv2.aruco.Dictionary, marker_ids: Sequence[int]) -> None:
        """Prepare.

        Args:
            dictionary: see `rhot.aruco_dictionary.marker_dictionary`.
            marker_ids: the markers to look for.
        """
        self._ids = tuple(marker_ids)
        # A dictionary of the worn markers alone: what is not looked for cannot be found by mistake.
        worn = cv2.aruco.Dictionary(
            dictionary.bytesList[list(self._ids)], dictionary.markerSize, dictionary.maxCorrectionBits
        )
        side = dictionary.markerSize + 2
        self._patterns = {
            marker_id: _normalised(
                np.kron(dictionary.generateImageMarker(marker_id, side), np.ones((_CELL_SAMPLES, _CELL_SAMPLES)))
            )
            for marker_id in self._ids
        }
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.cornerRefinementWinSize = 4
        parameters.cornerRefinementMinAccuracy = 0.01
        parameters.relativeCornerRefinmentWinSize = 0.4
        parameters.adaptiveThreshWinSizeMin = 7
        parameters.adaptiveThreshWinSizeMax = 31
        parameters.adaptiveThreshWinSizeStep = 12
        parameters.maxErroneousBitsInBorderRate = 0.1
        parameters.polygonalApproxAccuracyRate = 0.05
        parameters.minDistanceToBorder = 1
        self._parameters = parameters
        self._dictionary = worn
        self._detectors: dict[int, cv2.aruco.ArucoDetector] = {}
        side_centres = (np.arange(_CELL_SAMPLES) + 0.5) / _CELL_SAMPLES * (1.0 - 2.0 * _CELL_INSET) + _CELL_INSET
        positions = (np.arange(side)[:, None] + side_centres).ravel() / side
        x, y = np.meshgrid(positions, positions)
        self._cells = side
        self._samples = np.stack([x.ravel(), y.ravel()], axis=1)

    def find(self, color: ImageArray, region: Region | None = None) -> list[MarkerDetection]:
        """Return the markers in a picture (H, W, 3) uint8 BGR, the likeliest of each number first.

        Args:
            color: the picture.
            region: where to look; everywhere when left out.
        """
        height, width = color.shape[:2]
        part = region or Region(0, 0, width, height)
        if part.right - part.left < MIN_SIDE_PX or part.bottom - part.top < MIN_SIDE_PX:
            return []
        grey = cv2.cvtColor(color[part.top : part.bottom, part.left : part.right], cv2.COLOR_BGR2GRAY)
        corners, ids, _ = self._detector(max(grey.shape)).detectMarkers(grey)
        found = []
        shift = np.array([part.left, part.top], dtype=np.float64)
        # Without any marker `ids` is None.
        indices = np.asarray([] if not corners else ids, dtype=int).ravel()
        for quad, index in zip(corners, indices.tolist(), strict=True):
            rough = np.asarray(quad, dtype=np.float64).reshape(4, 2)
            uv, sigma_px = refine_corners(np.asarray(grey, dtype=np.uint8), rough, self._cells)
            side_px = float(np.sqrt(max(cv2.contourArea(uv.astype(np.float32)), 0.0)))
            if side_px < MIN_SIDE_PX:
                continue
            marker_id = self._ids[index]
            likeness = self._likeness(np.asarray(grey, dtype=np.uint8), uv, marker_id)
            if likeness >= MIN_LIKENESS:
                found.append(MarkerDetection(marker_id, uv + shift, sigma_px, likeness, side_px))
        return sorted(found, key=lambda detection: -detection.likeness)

    def _detector(self, extent_px: int) -> cv2.aruco.ArucoDetector:
        """Return the detector for pictures whose longer side is `extent_px`: OpenCV states sizes as shares of it."""
        # Few classes of sizes, so that detectors are made once.
        extent_px = 1 << int(np.ceil(np.log2(extent_px)))
        if extent_px not in self._detectors:
            parameters = self._parameters
            parameters.minMarkerPerimeterRate = 4.0 * MIN_SIDE_PX / extent_px
            parameters.maxMarkerPerimeterRate = 4.0
            self._detectors[extent_px] = cv2.aruco.ArucoDetector(self._dictionary, parameters)
        return self._detectors[extent_px]

    def _likeness(self, grey: ImageArray, corners: FloatArray, marker_id: int) -> float:
        square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=np.float32)
        H = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
        uv = np.asarray(cv2.perspectiveTransform(self._samples[None], H), dtype=np.float32)[0]
        values = sample_picture(grey, uv)
        return float(_normalised(np.asarray(values)) @ self._patterns[marker_id])


def _normalised(values: NDArray[np.generic]) -> FloatArray:
    flat = np.asarray(values, dtype=np.float64).ravel()
    centred: FloatArray = flat - flat.mean()
    return centred / max(float(np.linalg.norm(centred)), 1e-9)
