"""What is painted on hands, as far as geometry cares: markers, and which of them wear the same paint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Protocol, TypeVar

from rhot.types import Side


class PaintedMarker(Protocol):
    """What a marker's name stands for; `rhot.rig.MarkerConfig` is one."""

    @property
    def hand(self) -> Side:
        """Side of the hand that wears it."""
        ...

    @property
    def joint(self) -> str:
        """OpenXR joint that it marks."""
        ...

    @property
    def kind(self) -> Literal["cap", "patch", "ball"]:
        """A painted fingertip (`cap`), a flat rectangle (`patch`), or a ball or dot whose middle a camera sees."""
        ...

    @property
    def size_m(self) -> tuple[float, float] | None:
        """Of a patch, its extent across the hand and along it, metres."""
        ...

    @property
    def paint_of(self) -> str | None:
        """A marker of the other hand that wears the same paint."""
        ...

    @property
    def min_area_px(self) -> float:
        """Size gate, square pixels."""
        ...

    @property
    def max_area_px(self) -> float:
        """Size gate, square pixels."""
        ...


M = TypeVar("M", bound=PaintedMarker)


def own_paints(markers: Mapping[str, M]) -> dict[str, M]:
    """Return the markers that stand for a paint: all but those that wear the paint of another."""
    return {name: marker for name, marker in markers.items() if marker.paint_of is None}


def worn_paints(markers: Mapping[str, M]) -> dict[str, str]:
    """Return, by marker, the marker that stands for its paint."""
    return {name: marker.paint_of or name for name, marker in markers.items()}


def unshared_paints(markers: Mapping[str, M]) -> set[str]:
    """Return the markers whose paint no other one wears."""
    worn = [marker.paint_of for marker in markers.values()]
    return {name for name in own_paints(markers) if name not in worn}
