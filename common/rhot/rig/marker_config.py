"""What is painted on hands: markers, and which of them wear the same paint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import model_validator

from rhot.anatomy.skeleton import JOINTS
from rhot.messages import Name, Side
from rhot.rig.file_model import FileModel, Positive


class MarkerConfig(FileModel):
    """What a marker's name stands for.

    Attributes:
        hand: side of the hand that wears it.
        joint: OpenXR joint that it marks (`index_tip`, …; `wrist` or `palm` for the patch on the back).
        kind: a painted fingertip (`cap`), a flat rectangle (`patch`), or a ball or dot whose middle is what a camera
            sees (`ball`).
        size_m: of a patch, its extent across the hand and along it, metres.
        min_area_px, max_area_px: size gate, square pixels.
        paint_of: a marker of the other hand that wears the same paint; without it, the paint is this marker's own.
    """

    hand: Side = "right"
    joint: str
    paint_of: Name | None = None
    kind: Literal["cap", "patch", "ball"] = "cap"
    size_m: tuple[Positive, Positive] | None = None
    min_area_px: Positive = 12.0
    max_area_px: Positive = 40_000.0

    @model_validator(mode="after")
    def _consistent(self) -> MarkerConfig:
        if self.joint not in JOINTS:
            raise ValueError(f'joint = "{self.joint}" is not an OpenXR hand joint; one of: {", ".join(JOINTS)}')
        if self.kind == "patch" and self.size_m is None:
            raise ValueError('kind = "patch" needs `size_m = [width, length]` in metres')
        if self.min_area_px >= self.max_area_px:
            raise ValueError(f"min_area_px {self.min_area_px} must be below max_area_px {self.max_area_px}")
        return self


def own_paints(markers: Mapping[str, MarkerConfig]) -> dict[str, MarkerConfig]:
    """Return the markers that stand for a paint: all but those that wear the paint of another."""
    return {name: marker for name, marker in markers.items() if marker.paint_of is None}


def worn_paints(markers: Mapping[str, MarkerConfig]) -> dict[str, str]:
    """Return, by marker, the marker that stands for its paint."""
    return {name: marker.paint_of or name for name, marker in markers.items()}


def unshared_paints(markers: Mapping[str, MarkerConfig]) -> set[str]:
    """Return the markers whose paint no other one wears."""
    worn = [marker.paint_of for marker in markers.values()]
    return {name for name in own_paints(markers) if name not in worn}


def check_shared_paints(markers: Mapping[str, MarkerConfig]) -> None:
    """Check that hands whose markers share paints can be told apart.

    Raises:
        ValueError: a paint is shared by more than two markers, within one hand or from hand to hand, or a hand has no
            patch with a paint of its own.
    """
    own, shared = own_paints(markers), [m for m in markers.items() if m[1].paint_of is not None]
    worn = [marker.paint_of for _, marker in shared]
    for name, marker in shared:
        owner = own.get(marker.paint_of or "")
        if owner is None or owner.hand == marker.hand or worn.count(marker.paint_of) > 1:
            raise ValueError(f"markers.{name}: paint_of must name a marker of the other hand, each of them once")
    patches = {marker.hand for name, marker in own.items() if marker.kind == "patch" and name not in worn}
    if shared and len(patches) < 2:
        raise ValueError("paint_of needs a patch of a paint of its own on each hand: it tells the hands apart")
