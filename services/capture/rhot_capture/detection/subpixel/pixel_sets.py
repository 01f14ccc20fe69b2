"""Sets of pixels as one long number, one bit a pixel, row after row.

All neighbours at once are one shift away: growing or shrinking a few thousand pixels takes less than a microsecond,
where one call on a picture takes ten. Pixels at the end of a row neighbour on the start of the next, so rows need a
gap between them as wide as sets are grown.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rhot_capture.detection.color_table import ImageArray


def bits_of(chosen: NDArray[np.bool_] | ImageArray) -> int:
    """Return the set of the pixels that are not 0; pixel i in memory is bit i."""
    return int.from_bytes(np.packbits(chosen, bitorder="little").tobytes(), "little")


def pixels_of(bits: int, count: int) -> ImageArray:
    """Return (count,) uint8, 1 for each of the first pixels that is in a set."""
    packed = np.frombuffer(bits.to_bytes((count + 7) // 8, "little"), np.uint8)
    return np.unpackbits(packed, count=count, bitorder="little")


def grown_by_cross(bits: int, width: int) -> int:
    """Return a set with the four neighbours of its pixels; `width` is that of a row."""
    return bits | bits << 1 | bits >> 1 | bits << width | bits >> width


def grown_by_square(bits: int, width: int) -> int:
    """Return a set with the eight neighbours of its pixels; `width` is that of a row."""
    row = bits | bits << 1 | bits >> 1
    return row | row << width | row >> width


def shrunk_by_cross(bits: int, width: int) -> int:
    """Return those pixels of a set all of whose four neighbours are in it; `width` is that of a row."""
    return bits & bits << 1 & bits >> 1 & bits << width & bits >> width


def shrunk_by_square(bits: int, width: int) -> int:
    """Return those pixels of a set all of whose eight neighbours are in it; `width` is that of a row."""
    row = bits & bits << 1 & bits >> 1
    return row & row << width & row >> width
