"""`rhot evaluate paints`: how many paints a camera tells apart, and which."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from rhot.arrays import BoolArray, FloatArray
from rhot.cli.options import FiniteRange
from rhot.rig.colors import ColorComponent, RgbColor
from rhot_calibration.colors.model.fit import bhattacharyya
from rhot_calibration.colors.model.paints import PAINTS, TYPICAL_SKIN, Illumination

# Which paints can be worn together: sets of any size whose two most similar members differ most.
#
# Each paint is a normal distribution in log-ratio space about what a camera makes of it: paint in a picture is duller
# than paint from the tube (`SATURATION`), and light, shade and noise spread it (`SIGMA`). Two paints are as far apart
# as their Bhattacharyya distance D says: a share of at most ½·exp(−D) of their pixels is taken for the other
# (Kailath, IEEE Trans. Comm. Tech. 15(1), 1967). Skin and grey surroundings count as members of each set.

SIGMA: Final = (0.09, 0.09, 0.35)
"""Spread of a paint in log-ratio space, as in `rhot.rig.colors.nominal_colors`; three quarters of the paints in four
photos of the 2018 rig's hand spread by less in both ratios (0.085). Brightness as light changes by a third."""
SATURATION: Final = 0.3
"""How far from grey paint is in a picture, as a share of what it is from the tube: 0.29 in the 2018 rig's overhead
pictures (median of six paints), 0.44 in a telephone's."""
_GREYS: Final[tuple[RgbColor, ...]] = ((40.0, 40.0, 40.0), (120.0, 120.0, 120.0), (220.0, 220.0, 220.0))
"""Cloth, desk and paper."""
SURROUNDINGS: Final = ("skin", "grey")


@dataclass(frozen=True, slots=True)
class PaintSet:
    """Paints that are worn together.

    Attributes:
        paints: their names.
        nearest: the two most similar ones, skin and grey included.
        distance: Bhattacharyya distance of these.
    """

    paints: tuple[str, ...]
    nearest: tuple[str, str]
    distance: float

    @property
    def confusion(self) -> float:
        """The largest share of pixels of those two that is taken for the other, ½·exp(−D)."""
        return 0.5 * math.exp(-self.distance)


def as_seen(saturation: float = SATURATION) -> dict[str, RgbColor]:
    """Return `PAINTS` as a camera sees them in white light, by name."""
    light = Illumination((1.0, 1.0, 1.0), saturation, "given")
    return {name: light.seen(rgb) for name, rgb in PAINTS.items()}


def best_set(count: int, paints: Mapping[str, RgbColor], worn: Collection[str] = ()) -> PaintSet:
    """Return the set of so many paints whose two most similar members differ most.

    Args:
        count: of paints.
        paints: to choose from, name to red, green and blue in the picture.
        worn: paints that must be among them.

    Raises:
        ValueError: there are not so many paints.
    """
    if not len(worn) <= count <= len(paints):
        raise ValueError(f"{count} paints: there are {len(paints)} to choose from, of which {len(worn)} are given")
    names = [*worn, *(name for name in paints if name not in worn)]
    apart, beside = _distances([paints[name] for name in names])
    given = list(range(len(worn)))
    floor = np.minimum(apart, np.minimum(beside[:, None], beside[None, :]))
    best: list[int] = []
    # The largest threshold that leaves enough paints, of which each two are further apart than it.
    steps = np.unique(floor[~np.eye(len(names), dtype=bool)])
    low, high = 0, len(steps) - 1
    while low <= high:
        middle = (low + high) // 2
        found = _clique(floor >= steps[middle], given, [k for k in range(len(names)) if k not in given], count)
        if found is None:
            high = middle - 1
        else:
            best, low = found, middle + 1
    return described([names[k] for k in best], paints)


def described(chosen: Sequence[str], paints: Mapping[str, RgbColor]) -> PaintSet:
    """Return a set of paints with its two most similar members."""
    apart, beside = _distances([paints[name] for name in chosen])
    skin, grey = (_distances([paints[name] for name in chosen], only)[1] for only in SURROUNDINGS)
    a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
    pair, distance = (chosen[int(a)], chosen[int(b)]), float(apart[a, b])
    if float(beside.min()) < distance:
        k = int(np.argmin(beside))
        pair, distance = (chosen[k], SURROUNDINGS[0] if skin[k] <= grey[k] else SURROUNDINGS[1]), float(beside[k])
    return PaintSet(tuple(sorted(chosen)), pair, distance)


def _distances(colors: Sequence[RgbColor], only: str | None = None) -> tuple[FloatArray, FloatArray]:
    """Return distances (N, N) of paints, infinite on the diagonal, and (N,) to skin and grey, or `only` one of them."""
    parts = [ColorComponent(rgb=rgb, sigma=SIGMA) for rgb in colors]
    around = [] if only == "grey" else [TYPICAL_SKIN]
    around += [] if only == "skin" else list(_GREYS)
    counters = [ColorComponent(rgb=rgb, sigma=SIGMA) for rgb in around]
    apart = np.array([[math.inf if a is b else bhattacharyya(a, b) for b in parts] for a in parts])
    return apart, np.array([min(bhattacharyya(a, b) for b in counters) for a in parts])


def _clique(near: BoolArray, chosen: list[int], rest: list[int], count: int) -> list[int] | None:
    """Return `count` members of which each two are joined, `chosen` among them; None where there are none."""
    if any(not near[a, b] for a in chosen for b in chosen if a != b):
        return None
    rest = [k for k in rest if all(near[k, a] for a in chosen)]
    if len(chosen) >= count:
        return chosen[:count]
    for index, k in enumerate(rest):
        if len(chosen) + len(rest) - index < count:
            return None
        found = _clique(near, [*chosen, k], rest[index + 1 :], count)
        if found is not None:
            return found
    return None


_FEWEST: Final = 5
_MOST: Final = 12
"""The fingertips of one hand; tips and patches of both, each with a paint of its own."""


@click.command()
@click.option(
    "--saturation",
    type=FiniteRange(0.05, 1.0),
    default=SATURATION,
    show_default=True,
    help="How colourful pictures are beside the paint from the tube. The 2018 rig's: 0.29, a telephone's: 0.44.",
)
@click.option(
    "--have",
    "worn",
    multiple=True,
    metavar="PAINT",
    type=click.Choice(list(PAINTS)),
    help="A paint that you have and want to use. May be repeated.",
)
def paints(saturation: float, worn: tuple[str, ...]) -> None:
    """Choose paints: the sets of five to twelve whose two most similar ones differ most.

    Skin and grey surroundings count as members. The largest confusion is the share of pixels of these two that may be
    misclassified as the other; up to about a tenth is fine, because blobs are far more reliable than single pixels.
    Brands differ: when you have painted, `rhot calibrate colors` measures what your own cameras see.
    """
    table = Table(title=f"Paints that differ most, as seen with a saturation of {saturation:g}")
    for title in ("paints", "distance", "confusion", "most alike", "the set"):
        table.add_column(title, justify="right" if title in ("paints", "distance", "confusion") else "left")
    seen = as_seen(saturation)
    for count in range(max(_FEWEST, len(set(worn))), _MOST + 1):
        chosen = best_set(count, seen, tuple(dict.fromkeys(worn)))
        share = f"{100.0 * chosen.confusion:.1f} %"
        table.add_row(str(count), f"{chosen.distance:.2f}", share, ", ".join(chosen.nearest), ", ".join(chosen.paints))
    Console().print(table)
