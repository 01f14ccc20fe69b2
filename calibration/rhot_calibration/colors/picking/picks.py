"""Where the markers are in the pictures, as people say it: a place on a marker, or a rectangle around one."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from rhot.errors import ConfigError

# Pictures that stand still, and which marker somebody clicked where in them.


_NUMBER: Final = r"\s*([-+]?\d+(?:\.\d+)?)\s*"
_PICTURE: Final = r"(?:@\s*(.+?)\s*)?"
_PICK: Final = re.compile(rf"([^=]+)={_NUMBER},{_NUMBER}{_PICTURE}")
_BOX: Final = re.compile(rf"([^=]+)={_NUMBER},{_NUMBER},{_NUMBER},{_NUMBER}{_PICTURE}")


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle around a marker; it may hold some of what surrounds the marker.

    Attributes:
        u, v: its upper left corner, pixels.
        width, height: pixels.
    """

    u: float
    v: float
    width: float
    height: float

    @property
    def middle(self) -> tuple[float, float]:
        """Its middle, pixels."""
        return self.u + 0.5 * (self.width - 1.0), self.v + 0.5 * (self.height - 1.0)

    def __str__(self) -> str:
        return f"{self.u:g},{self.v:g},{self.width:g},{self.height:g}"


Pick = tuple[float, float] | Box
"""A place (u, v) on a marker, pixels, or a rectangle around it."""
Picks = Mapping[str, Pick]


def place_text(place: Pick) -> str:
    """Return a place as it is written on the command line."""
    return str(place) if isinstance(place, Box) else f"{place[0]:g},{place[1]:g}"


def parse_places(picks: Sequence[str], boxes: Sequence[str], pictures: Sequence[str]) -> list[dict[str, Pick]]:
    """Return for each picture the markers shown in it: marker name to place or rectangle.

    Args:
        picks: `NAME=U,V` for the first picture, `NAME=U,V@N` for the N-th, counted from 1, or `NAME=U,V@PICTURE`.
        boxes: `NAME=U,V,W,H` with the upper left corner and the size, and `@` as for picks.
        pictures: the pictures' names: a camera, or the name of a file without its ending.

    Raises:
        ConfigError: not of that form, an unknown picture, or a marker shown twice in one picture.
    """
    chosen: list[dict[str, Pick]] = [{} for _ in pictures]
    for text in picks:
        match = _PICK.fullmatch(text)
        if match is None:
            raise ConfigError(f"--pick {text}: not NAME=U,V or NAME=U,V@N, such as thumb=281,215 or thumb=281,215@2")
        _add(chosen, f"--pick {text}", match[1].strip(), (float(match[2]), float(match[3])), match[4], pictures)
    for text in boxes:
        match = _BOX.fullmatch(text)
        if match is None:
            raise ConfigError(
                f"--box {text}: not NAME=U,V,W,H or NAME=U,V,W,H@N, such as thumb=269,202,25,26 with the upper left "
                "corner and the size in pixels"
            )
        box = Box(float(match[2]), float(match[3]), float(match[4]), float(match[5]))
        _add(chosen, f"--box {text}", match[1].strip(), box, match[6], pictures)
    return chosen


def _add(
    chosen: list[dict[str, Pick]], option: str, name: str, place: Pick, picture: str | None, pictures: Sequence[str]
) -> None:
    number = _number(option, picture, pictures)
    if name in chosen[number]:
        raise ConfigError(f"{option}: {name} is picked twice in picture {number + 1} ({pictures[number]}); keep one")
    chosen[number][name] = place


def _number(option: str, picture: str | None, pictures: Sequence[str]) -> int:
    if picture is None:
        return 0
    if picture.isdecimal() and 1 <= int(picture) <= len(pictures):
        return int(picture) - 1
    named = [number for number, name in enumerate(pictures) if name == picture]
    if len(named) > 1:
        raise ConfigError(
            f"{option}: {len(named)} pictures are called {picture}; say @{named[0] + 1} or @{named[1] + 1} instead"
        )
    if not named:
        given = ", ".join(f"@{number} = {name}" for number, name in enumerate(pictures, 1))
        raise ConfigError(f"{option}: there is no picture {picture}; say {given}")
    return named[0]
