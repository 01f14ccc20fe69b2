"""ArUco markers of the feet: their dictionaries by name, and how a marker sits on a foot.

OpenCV has no dictionary with 3x3 bits. `3X3_32` is the project's own: 32 of the 2⁹ patterns, taken one by one so that
each lies as many bits as possible from those before it and from its own turns, the lowest number first where several
do. It needs no random numbers, so a printed marker stays valid whatever the version of OpenCV.

A marker lies on the instep with its upper edge towards the toes. With OpenCV's marker axes (x right, y up, z out of the
paper), X_foot = R_FOOT_MARKER · X_marker; the origins coincide, see `rhot.messages.FootPose`.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.errors import ConfigError

Bits = NDArray[np.uint8]

R_FOOT_MARKER: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
R_FOOT_MARKER.setflags(write=False)

_OWN_NAME: Final = "3X3_32"
_OWN_BITS: Final = 3


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a dictionary of markers: `3X3_32`, or one of OpenCV's by its name without `DICT_`, such as `4X4_50`.

    Raises:
        ConfigError: there is none of this name.
    """
    if name == _OWN_NAME:
        codes = [cv2.aruco.Dictionary.getByteListFromBits(bits) for bits in _own_patterns()]
        return cv2.aruco.Dictionary(np.concatenate(codes), _OWN_BITS, 0)
    predefined = getattr(cv2.aruco, f"DICT_{name}", None)
    if predefined is None:
        found = map(re.compile(r"^DICT_(\d+X\d+_\d+)$").match, dir(cv2.aruco))
        known = ", ".join([_OWN_NAME, *sorted(match[1] for match in found if match)])
        raise ConfigError(f'[feet] dictionary = "{name}": no such dictionary of markers; one of {known}')
    return cv2.aruco.getPredefinedDictionary(predefined)


def marker_cells(name: str, marker_id: int) -> Bits:
    """Return the cells (n + 2, n + 2) of a marker of n x n bits with its black border, 0 black and 1 white.

    Raises:
        ConfigError: there is no such dictionary, or the dictionary has no such marker.
    """
    dictionary = marker_dictionary(name)
    count = len(dictionary.bytesList)
    if not 0 <= marker_id < count:
        raise ConfigError(f'marker_id = {marker_id}: dictionary "{name}" has the markers 0 to {count - 1}')
    side = dictionary.markerSize + 2
    cells: Bits = (dictionary.generateImageMarker(marker_id, side) > 0).astype(np.uint8)
    return cells


def marker_corners_m(size_m: float) -> FloatArray:
    """Return the corners (4, 3) of a marker's black square, metres, foot frame, in the order of OpenCV's detector.

    That is upper left, upper right, lower right, lower left as the marker is printed.
    """
    half = size_m / 2.0
    corners = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    in_foot: FloatArray = corners @ R_FOOT_MARKER.T
    return in_foot


@lru_cache(maxsize=1)
def _own_patterns() -> tuple[Bits, ...]:
    numbers = np.arange(1 << _OWN_BITS**2)
    patterns: Bits = ((numbers[:, None] >> np.arange(_OWN_BITS**2)) & 1).astype(np.uint8).reshape(-1, 3, 3)
    rotated = np.stack([np.rot90(patterns, turns, axes=(1, 2)) for turns in range(4)], axis=1)
    # A marker that looks alike after a quarter turn would leave the foot's direction open.
    distances = np.stack([(patterns != rotated[:, turns]).sum(axis=(1, 2)) for turns in (1, 2, 3)]).min(axis=0)
    # Nearly black and nearly white patterns look like shadows and like paper.
    distances[np.abs(patterns.sum(axis=(1, 2)) - 4.5) > 2.0] = 0
    chosen: list[int] = []
    own_count = 32
    for _ in range(own_count):
        chosen.append(int(np.argmax(distances)))
        to_newest = (patterns[:, None] != rotated[chosen[-1]]).sum(axis=(2, 3)).min(axis=1)
        distances = np.minimum(distances, to_newest)
    return tuple(patterns[number] for number in chosen)
