"""Pictures that stand still, and which marker somebody clicked where in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from rhot.arrays import BoolArray, ImageArray
from rhot_calibration.colors.picking.picks import Pick, Picks
from rhot_calibration.colors.picking.regions import regions
from rhot_capture.preview import mark_positions, preview_jpeg


@dataclass(slots=True)
class ClickedPicture:
    """One picture to click in.

    Attributes:
        camera: whose it is.
        image: (H, W, 3) uint8 BGR.
        places: marker name to where it was clicked.
    """

    camera: str
    image: ImageArray
    places: dict[str, Pick] = field(default_factory=dict)
    _grown: tuple[Picks, dict[str, BoolArray]] = field(default_factory=lambda: ({}, {}))

    def regions(self, places: Picks) -> dict[str, BoolArray]:
        """Return the pixels of the markers at some places, (H, W) bool each; at the same places as before at once.

        Growing regions is most of the work of learning colours, and a click changes those of its own picture only.
        """
        before, grown = self._grown
        if before != places:
            grown = regions(self.image, places)
            self._grown = (dict(places), grown)
        return grown

    @property
    def marked(self) -> ImageArray:
        """The picture with a cross at every place."""
        canvas = self.image.copy()
        places = {name: at if isinstance(at, tuple) else at.middle for name, at in self.places.items()}
        mark_positions(canvas, places)
        return canvas


class Clicks:
    """All pictures of all cameras, in the order in which they were taken, and the order of the clicks."""

    def __init__(self, markers: Iterable[str]) -> None:
        """Begin without pictures.

        Args:
            markers: in the order in which they are clicked.
        """
        self.pictures: list[ClickedPicture] = []
        self._markers = tuple(markers)
        self._order: list[tuple[ClickedPicture, str, Pick | None]] = []

    def add(self, images: Mapping[str, ImageArray]) -> None:
        """Take one more picture of each camera."""
        self.pictures += [ClickedPicture(camera, image) for camera, image in images.items()]

    def click(self, camera: str, marker: str, place: Pick) -> str:
        """Note a click in the newest picture of a camera and return the marker to go on with."""
        picture = self.newest[camera]
        self._order.append((picture, marker, picture.places.get(marker)))
        picture.places[marker] = place
        # The rest of this picture first, then those of the other cameras.
        rest = [name for each in (picture, *self.newest.values()) for name in self._markers if name not in each.places]
        return rest[0] if rest else marker

    def take_back(self) -> str:
        """Bring back what was before the last click and return its marker; call only with `can_take_back`."""
        picture, marker, former = self._order.pop()
        if former is None:
            del picture.places[marker]
        else:
            picture.places[marker] = former
        return marker

    @property
    def can_take_back(self) -> bool:
        """Whether there is a click."""
        return bool(self._order)

    @property
    def newest(self) -> dict[str, ClickedPicture]:
        """The newest picture of each camera."""
        return {each.camera: each for each in self.pictures}

    @property
    def missing(self) -> list[str]:
        """Markers that were clicked in no picture."""
        clicked = {name for each in self.pictures for name in each.places}
        return [name for name in self._markers if name not in clicked]

    @property
    def cameras_without(self) -> list[str]:
        """Cameras in whose pictures nothing was clicked."""
        clicked = {each.camera for each in self.pictures if each.places}
        return [camera for camera in self.newest if camera not in clicked]

    def held(self) -> dict[str, bytes]:
        """Return what stands still: the newest picture of each camera with its clicks, as JPEG."""
        return {camera: preview_jpeg(each.marked) for camera, each in self.newest.items()}
