"""Rectangles of an image."""

from __future__ import annotations

from typing import NamedTuple


class Region(NamedTuple):
    """Columns left to right − 1 and rows top to bottom − 1 of an image, pixels."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def area(self) -> int:
        """Number of pixels."""
        return (self.right - self.left) * (self.bottom - self.top)

    def overlaps(self, other: Region) -> bool:
        """Return whether the regions have common pixels."""
        across = self.left < other.right and other.left < self.right
        return across and self.top < other.bottom and other.top < self.bottom

    def joined(self, other: Region) -> Region:
        """Return the smallest region that contains both."""
        return Region(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )
