"""How good each colour came out, measured on the pictures that it was learnt from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rhot.arrays import BoolArray, FloatArray, ImageArray
from rhot.rig.colors import ColorsFile, log_ratio
from rhot_calibration.colors.model.samples import ClassPixels, thinned
from rhot_calibration.colors.model.separability import Separability
from rhot_capture.detection.color_table import ColorTable, mixture_fit


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
