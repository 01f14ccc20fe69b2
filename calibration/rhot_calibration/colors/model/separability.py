"""How well the colours can be told apart by the very table that the tracker uses.

Pixels of each class are put through the look-up table: the real ones of the pictures, and ones drawn from their
distribution in light up to 20 % brighter or darker. The share that comes out as another class is the confusion to
expect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import BoolArray, FloatArray, ImageArray
from rhot.rig.colors import ColorComponent, ColorsFile, GaussianColor, log_ratio
from rhot_calibration.colors.model.fit import ClassPixels, bhattacharyya, drawn, in_other_light, thinned
from rhot_capture.detection.color_table import ColorTable, mixture_fit

# How good each colour came out, measured on the pictures that it was learnt from.


@dataclass(frozen=True, slots=True)
class MarkerQuality:
    """How well one marker's colour came out.

    Attributes:
        u, v: middle of its region in the first picture where it was picked, pixels.
        area: of that region, square pixels.
        recovered: share of its own pixels that the finished colours give to it.
        marked: share of its own pixels that they give to any marker.
        false_share: share of all other pixels, in the pictures that show it, that they give to it wrongly.
    """

    u: float
    v: float
    area: float
    recovered: float
    marked: float
    false_share: float


def class_pixels(
    painted: Mapping[str, FloatArray],
    colors: ColorsFile,
    table: ColorTable,
    images: Sequence[ImageArray],
    found: Sequence[Mapping[str, BoolArray]],
    free: Sequence[BoolArray],
) -> ClassPixels:
    """Return the pixels of all classes; what is not paint is skin where skin is the likelier class.

    Args:
        painted: marker name to its pixels, (N, 3) red, green, blue.
        colors: the finished colours.
        table: built from them.
        images: (H, W, 3) uint8 BGR each.
        found: for each image marker name to its region, (H, W) bool.
        free: for each image where no marker is, (H, W) bool.
    """
    names = np.array(["", *table.names])
    parts = []
    for image, where, shown in zip(images, free, found, strict=True):
        pixels = image[where]
        # A marker that nobody pointed out in this picture is no background.
        hidden = ~np.isin(names, ["", *shown])[table.classify(image)[0][where]]
        parts.append(pixels[~hidden][:, ::-1])
    rest = thinned(np.concatenate(parts).astype(np.float64))
    is_skin = np.zeros(len(rest), bool)
    if colors.skin is not None:
        features = log_ratio(rest)
        others = -np.inf if colors.background is None else mixture_fit(colors.background, features)[0]
        is_skin = mixture_fit(colors.skin, features)[0] > others
    areas = {name: [np.count_nonzero(chosen[name]) for chosen in found if name in chosen] for name in painted}
    return ClassPixels(
        markers={name: thinned(own) for name, own in painted.items()},
        skin=rest[is_skin],
        others=rest[~is_skin],
        area={name: float(np.mean(own)) for name, own in areas.items()},
        others_area=sum(int(np.count_nonzero(where)) for where in free),
        pictures=len(images),
    )


def marker_quality(
    table: ColorTable,
    images: Sequence[ImageArray],
    found: Sequence[Mapping[str, BoolArray]],
    free: Sequence[BoolArray],
) -> dict[str, MarkerQuality]:
    """Return how well each marker's colour came out.

    Args:
        table: of the finished colours.
        images: (H, W, 3) uint8 BGR each.
        found: for each image marker name to its region, (H, W) bool.
        free: for each image where no marker is, (H, W) bool.
    """
    labels = [table.classify(image)[0] for image in images]
    result = {}
    for label, name in enumerate(table.names, start=1):
        shown = [(seen, chosen[name]) for seen, chosen in zip(labels, found, strict=True) if name in chosen]
        # Where nobody pointed the marker out it may be in the picture all the same.
        rest = [seen[where] for seen, chosen, where in zip(labels, found, free, strict=True) if name in chosen]
        own = sum(int(np.count_nonzero(region)) for _, region in shown)
        hit = sum(int(np.count_nonzero(seen[region] == label)) for seen, region in shown)
        marked = sum(int(np.count_nonzero(seen[region])) for seen, region in shown)
        wrong = sum(int(np.count_nonzero(seen == label)) for seen in rest)
        rows, columns = np.nonzero(shown[0][1])
        result[name] = MarkerQuality(
            u=float(columns.mean()),
            v=float(rows.mean()),
            area=float(len(rows)),
            recovered=hit / own,
            marked=marked / own,
            false_share=wrong / max(sum(len(seen) for seen in rest), 1),
        )
    return result


def quality_as_plain(quality: Mapping[str, MarkerQuality], apart: Separability) -> dict[str, dict[str, float | str]]:
    """Return the figures that `colors.json` carries along."""
    plain: dict[str, dict[str, float | str]] = {}
    for name, each in quality.items():
        nearest, confusion = apart.nearest(name)
        plain[name] = {
            "u": round(each.u, 2),
            "v": round(each.v, 2),
            "area_px": each.area,
            "recovered": round(each.recovered, 4),
            "false_share": round(each.false_share, 7),
            "nearest": nearest,
            "confusion": round(confusion, 6),
        }
    return plain


SKIN: Final = "skin"
BACKGROUND: Final = "background"
NOTHING: Final = "nothing"

CONFUSABLE: Final = 0.05
"""Where more than this share of pixels changes over, a warning names the pair."""

_DRAWN: Final = 8_000
_SEED: Final = 1


@dataclass(frozen=True, slots=True)
class Separability:
    """How well colours can be told apart.

    Attributes:
        names: the markers.
        classes: true classes, the rows of all tables: the markers, then skin and background where there are any.
        seen: what a pixel may be taken for, the columns: the markers, skin, background, nothing.
        expected: (rows, columns) share of a class's pixels in changing light that are taken for each.
        measured: (rows, columns) the same of the real pixels of the pictures.
        distance: (rows, rows) Bhattacharyya distance of the classes' nearest parts; NaN where a class is no
            statistical one.
        margin: (markers, rows) by how much the camera's colour balance may drift (relative change of the red or blue
            gain) until `CONFUSABLE` of a marker's pixels are taken for the other class; infinite beyond 50 %, NaN on
            the diagonal.
    """

    names: tuple[str, ...]
    classes: tuple[str, ...]
    seen: tuple[str, ...]
    expected: FloatArray
    measured: FloatArray
    distance: FloatArray
    margin: FloatArray

    def mixed_up(self, first: str, second: str) -> float:
        """Return the larger expected share of one class's pixels that are taken for the other, of two markers."""
        a, b = self.names.index(first), self.names.index(second)
        return float(max(self.expected[a, b], self.expected[b, a]))

    def pairs(self) -> list[tuple[str, str, float]]:
        """Return every pair of markers with its larger expected confusion, worst first."""
        pairs = [
            (first, second, self.mixed_up(first, second))
            for index, first in enumerate(self.names)
            for second in self.names[index + 1 :]
        ]
        return sorted(pairs, key=lambda pair: -pair[2])

    def nearest(self, name: str) -> tuple[str, float]:
        """Return the marker that one is most easily mixed up with, and how much; an empty name when it is alone."""
        row = self.names.index(name)
        others = [index for index in range(len(self.names)) if index != row]
        if not others:
            return "", 0.0
        # Among pairs that are never mixed up, the smaller distance decides.
        worst = max(others, key=lambda place: (self.mixed_up(name, self.names[place]), -self.distance[row, place]))
        return self.names[worst], self.mixed_up(name, self.names[worst])

    def confusable(self) -> list[tuple[str, str, float]]:
        """Return the pairs of markers of which more than `CONFUSABLE` is mixed up, worst first."""
        return [pair for pair in self.pairs() if pair[2] > CONFUSABLE]

    def skin_like(self) -> list[tuple[str, float]]:
        """Return the markers for which more than `CONFUSABLE` of the skin is taken, and that share, worst first."""
        if SKIN not in self.classes:
            return []
        shares = self.expected[self.classes.index(SKIN)]
        found = [(name, float(shares[self.seen.index(name)])) for name in self.names]
        return sorted((each for each in found if each[1] > CONFUSABLE), key=lambda each: -each[1])

    def lost(self) -> list[tuple[str, str, float]]:
        """Return the markers of which more than `CONFUSABLE` is taken for skin or background, worst first."""
        shares = [
            (name, other, float(self.expected[row, self.seen.index(other)]))
            for row, name in enumerate(self.names)
            for other in (SKIN, BACKGROUND)
        ]
        return sorted((each for each in shares if each[2] > CONFUSABLE), key=lambda each: -each[2])


def separability(colors: ColorsFile, table: ColorTable, pixels: ClassPixels) -> Separability:
    """Measure how well colours can be told apart.

    Args:
        colors: the colours.
        table: built from them, for the markers in `pixels`, in that order.
        pixels: of every class.
    """
    rng = np.random.default_rng(_SEED)
    names = tuple(pixels.markers)
    counters = {name: own for name, own in ((SKIN, pixels.skin), (BACKGROUND, pixels.others)) if len(own)}
    classes = (*names, *counters)
    seen = (*names, SKIN, BACKGROUND, NOTHING)
    new = {name: in_other_light(drawn(own, _DRAWN, rng), rng) for name, own in pixels.markers.items()}
    new |= {name: in_other_light(own, rng) for name, own in counters.items()}
    real = {**pixels.markers, **counters}
    return Separability(
        names=names,
        classes=classes,
        seen=seen,
        expected=np.stack([_shares(new[name], colors, table) for name in classes]),
        measured=np.stack([_shares(real[name], colors, table) for name in classes]),
        distance=_distances(colors, classes),
        margin=_margins(new, colors, table, names, classes),
    )


def labels_of(table: ColorTable, rgb: FloatArray) -> ImageArray:
    """Return the label of each colour (N, 3) red, green, blue, 0 to 255, as `ColorTable.classify` would."""
    whole = rgb.astype(np.int64)
    labels: ImageArray = table.labels[(whole[:, 0] >> 3) << 11 | (whole[:, 1] >> 2) << 5 | whole[:, 2] >> 3]
    return labels


def _shares(rgb: FloatArray, colors: ColorsFile, table: ColorTable) -> FloatArray:
    """Return what share of pixels is taken for each marker, skin, background and nothing."""
    labels = labels_of(table, rgb)
    count = len(table.names)
    marked = np.bincount(labels, minlength=count + 1)[1 : count + 1]
    unmarked = _counted_out(rgb[labels == 0], colors)
    return np.concatenate([marked, unmarked]) / max(len(rgb), 1)


def _counted_out(rgb: FloatArray, colors: ColorsFile) -> NDArray[np.int64]:
    """Return how many of the pixels that are no marker's go to skin, to background and to nothing at all."""
    within = [
        mixture_fit(color, log_ratio(rgb))[1] <= (color.limit * color.tolerance) ** 2
        for color in (colors.skin, colors.background)
        if color is not None and len(rgb)
    ]
    if not within:
        return np.array([0, 0, len(rgb)])
    density = np.full((2, len(rgb)), -np.inf)
    for row, color in enumerate((colors.skin, colors.background)):
        if color is not None:
            density[row] = mixture_fit(color, log_ratio(rgb))[0]
    known = np.any(within, axis=0)
    skin = known & (density[0] > density[1])
    return np.array([np.count_nonzero(skin), np.count_nonzero(known & ~skin), np.count_nonzero(~known)])


def _parts(colors: ColorsFile, name: str) -> tuple[ColorComponent, ...]:
    color = {SKIN: colors.skin, BACKGROUND: colors.background}.get(name, colors.markers.get(name))
    return color.components if isinstance(color, GaussianColor) else ()


def _distances(colors: ColorsFile, classes: Sequence[str]) -> FloatArray:
    distances = np.full((len(classes), len(classes)), np.nan)
    for row, first in enumerate(classes):
        for column, second in enumerate(classes):
            if {first, second} <= {SKIN, BACKGROUND} or row == column:
                continue
            each = [bhattacharyya(a, b) for a in _parts(colors, first) for b in _parts(colors, second)]
            distances[row, column] = min(each, default=np.nan)
    return distances


def _margins(
    pixels: dict[str, FloatArray],
    colors: ColorsFile,
    table: ColorTable,
    names: Sequence[str],
    classes: Sequence[str],
) -> FloatArray:
    margins = np.full((len(names), len(classes)), np.nan)
    label = {name: number for number, name in enumerate(table.names, start=1)}
    for row, name in enumerate(names):
        margin_pixels = 1_500
        own = pixels[name][:: max(1, len(pixels[name]) // margin_pixels)]
        for column, other in enumerate(classes):
            parts = _parts(colors, other)
            if row == column or not parts:
                continue
            # Skin, background and nothing all leave a pixel without a label.
            margins[row, column] = _drift(own, parts, table, label.get(other, 0))
    return margins


def _drift(own: FloatArray, towards: Sequence[ColorComponent], table: ColorTable, label: int) -> float:
    mean = log_ratio(own).mean(axis=0)
    offsets = np.array([part.mean() - mean for part in towards])
    offset = offsets[np.abs(offsets / (1.0, 1.0, 3.0)).max(axis=1).argmin(), :2]
    direction = offset / max(float(np.abs(offset).max()), 1e-9)
    margin_steps = 50
    for step in range(margin_steps + 1):
        margin_step = 0.01
        drift = step * margin_step
        gains = np.exp(np.log1p(drift) * np.array([direction[0], 0.0, direction[1]]))
        if np.mean(labels_of(table, np.clip(own * gains, 0.0, 255.0)) == label) > CONFUSABLE:
            return drift
    return float("inf")
