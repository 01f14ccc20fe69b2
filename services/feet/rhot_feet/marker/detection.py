"""Finding the feet's markers in a picture: where their corners are, and how surely they are markers at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray, ImageArray
from rhot.geometry.region import Region
from rhot_feet.marker.edges import refine_corners, sample_picture

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
