"""Colours of all markers from a few picks in pictures: grow regions, fit classes, look for what they mistake.

Everything that was not picked is a counter-example. What the fitted colours still take for a marker elsewhere in the
same pictures joins the background as a class of its own, so that a look-alike in the room loses against itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.errors import CalibrationError
from rhot.rig.calibration import today
from rhot.rig.colors import ColorComponent, ColorsFile, FloatArray, GaussianColor, log_ratio
from rhot.rig.config import MarkerConfig
from rhot_capture.blob import find_blobs
from rhot_capture.color_fit import COUNTER_FLOOR, MARKER_FLOOR, bhattacharyya, fit_component, fit_mixture
from rhot_capture.color_regions import BoolArray, regions
from rhot_capture.color_table import ImageArray, build_color_table

Picks = Mapping[str, tuple[float, float]]

CONFUSABLE: Final = 0.1
"""A pair that is mixed up in more than this share of pixels deserves a warning."""

_MARKER_COMPONENTS: Final = 3
_PIXELS_PER_COMPONENT: Final = 400
_BACKGROUND_COMPONENTS: Final = 12
_LIMIT: Final = 3.5
_LOOKALIKE_ROUNDS: Final = 3
_MAX_LOOKALIKES: Final = 64
_LOOKALIKE_WEIGHT: Final = 0.02
_LOOKALIKE_AREA_SHARE: Final = 0.5
_LEAST_RECOVERED: Final = 0.4
_CLEARANCE: Final = np.ones((7, 7), np.uint8)
_SKIN_HUE: Final = ((0.02, 0.90), (-1.60, -0.02))
"""Bounds of ln(R/G) and ln(B/G) of skin in any ordinary light: more red than green, more green than blue."""
_SKIN_BRIGHTNESS: Final = math.log(45.0)


@dataclass(frozen=True, slots=True)
class MarkerQuality:
    """How well one marker's colour came out.

    Attributes:
        u, v: middle of its region in the first picture where it was picked, pixels.
        area: of that region, square pixels.
        recovered: share of its own pixels that the finished colours give to it.
        false_share: share of all other pixels that they give to it wrongly.
        nearest: the marker that it is most easily taken for; empty when it is alone.
        confusion: bound of the share of pixels that the two mix up.
    """

    u: float
    v: float
    area: float
    recovered: float
    false_share: float
    nearest: str
    confusion: float


@dataclass(frozen=True, slots=True)
class ColorCalibration:
    """Colours and how good they are.

    Attributes:
        colors: to be written as `colors.json`.
        markers: quality of each picked marker.
        confusable: pairs of markers that are mixed up too easily, with the bound of their confusion, worst first.
    """

    colors: ColorsFile
    markers: dict[str, MarkerQuality]
    confusable: tuple[tuple[str, str, float], ...]


def calibrate(
    images: Sequence[ImageArray], picks: Sequence[Picks], markers: Mapping[str, MarkerConfig]
) -> ColorCalibration:
    """Fit colours to picked markers; a marker without a pick gets none.

    Args:
        images: (H, W, 3) uint8 BGR each.
        picks: for each image marker name to (u, v), pixels; on the marker or within about 10 px of it.
        markers: the rig's markers by name.

    Raises:
        CalibrationError: no pick at all, an unknown marker, a pick outside its picture, or nothing there that is
            of a marker's size and differs from its surroundings.
    """
    _check(images, picks, markers)
    found = [regions(image, chosen) for image, chosen in zip(images, picks, strict=True)]
    _check_areas(found, picks, markers)
    names = [name for name in markers if any(name in chosen for chosen in picks)]
    features = [log_ratio(image[..., ::-1].astype(np.float64)) for image in images]
    samples = {name: _marker_samples(name, features, found) for name in names}
    fitted = {name: _fit_marker(own) for name, own in samples.items()}
    free = [_free(chosen, image.shape[:2]) for chosen, image in zip(found, images, strict=True)]
    others = np.concatenate([each[where] for each, where in zip(features, free, strict=True)])
    background = fit_mixture(others, _BACKGROUND_COMPONENTS, COUNTER_FLOOR)
    colors = _assemble(fitted, background, [])
    lookalikes: list[ColorComponent] = []
    for _ in range(_LOOKALIKE_ROUNDS):
        new = _lookalikes(colors, names, images, features, found, markers)
        room = _MAX_LOOKALIKES - len(lookalikes)
        if not new or room <= 0:
            break
        lookalikes += new[:room]
        colors = _assemble(fitted, background, lookalikes)
    quality = _quality(colors, names, images, found, free)
    for name, each in quality.items():
        if each.recovered < _LEAST_RECOVERED:
            raise CalibrationError(
                f"pick {name}: the colour found near {each.u:.0f},{each.v:.0f} is that of its surroundings "
                f"({100 * each.recovered:.0f} % of it can be told apart, {100 * _LEAST_RECOVERED:.0f} % is the least); "
                "pick the painted area itself, or use a paint that stands out"
            )
    colors = colors.model_copy(update={"quality": _as_plain(quality)})
    return ColorCalibration(colors, quality, _confusable(colors, names))


def _check(images: Sequence[ImageArray], picks: Sequence[Picks], markers: Mapping[str, MarkerConfig]) -> None:
    if len(images) != len(picks) or not any(picks):
        raise CalibrationError("no picks: name each marker with a place on it, for example --pick thumb=281,215")
    for number, (image, chosen) in enumerate(zip(images, picks, strict=True), start=1):
        height, width = image.shape[:2]
        for name, (u, v) in chosen.items():
            if name not in markers:
                raise CalibrationError(f"pick {name}: no such marker in rig.toml, which has {', '.join(markers)}")
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                raise CalibrationError(
                    f"pick {name} = {u:g},{v:g} lies outside picture {number}, which is {width}x{height}"
                )


def _check_areas(
    found: Sequence[Mapping[str, BoolArray]], picks: Sequence[Picks], markers: Mapping[str, MarkerConfig]
) -> None:
    for number, (chosen, places) in enumerate(zip(found, picks, strict=True), start=1):
        for name, region in chosen.items():
            area = int(np.count_nonzero(region))
            least = markers[name].min_area_px
            if area < least:
                u, v = places[name]
                raise CalibrationError(
                    f"pick {name} = {u:g},{v:g} in picture {number}: only {area} px of one colour stand out there, a "
                    f"marker has at least {least:g}; pick the middle of the painted area, or lower min_area_px"
                )
        for name, region in chosen.items():
            for other, other_region in chosen.items():
                if name < other and np.count_nonzero(region & other_region) > 0.5 * np.count_nonzero(region):
                    raise CalibrationError(
                        f"picks {name} and {other} in picture {number} found the same patch of colour; pick each on "
                        "its own marker"
                    )


def _marker_samples(name: str, features: Sequence[FloatArray], found: Sequence[Mapping[str, BoolArray]]) -> FloatArray:
    parts = []
    for each, chosen in zip(features, found, strict=True):
        if name not in chosen:
            continue
        region = chosen[name]
        inner = cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        parts.append(each[inner if np.count_nonzero(inner) >= 20 else region])
    return np.concatenate(parts)


def _fit_marker(samples: FloatArray) -> list[ColorComponent]:
    count = min(_MARKER_COMPONENTS, len(samples) // _PIXELS_PER_COMPONENT)
    if count <= 1:
        return [fit_component(samples, MARKER_FLOOR)]
    return fit_mixture(samples, count, MARKER_FLOOR)


def _free(chosen: Mapping[str, BoolArray], shape: tuple[int, ...]) -> BoolArray:
    taken = np.zeros(shape, np.uint8)
    for region in chosen.values():
        taken |= region
    free: BoolArray = np.asarray(cv2.dilate(taken, _CLEARANCE)) == 0
    return free


def _assemble(
    fitted: Mapping[str, Sequence[ColorComponent]],
    background: Sequence[ColorComponent],
    lookalikes: Sequence[ColorComponent],
) -> ColorsFile:
    skin = [component for component in background if _is_skin(component)]
    rest = [component for component in background if not _is_skin(component)]
    counter = [*rest, *lookalikes]
    return ColorsFile(
        date=today(),
        markers={name: GaussianColor(components=tuple(parts), limit=_LIMIT) for name, parts in fitted.items()},
        skin=GaussianColor(components=tuple(skin)) if skin else None,
        background=GaussianColor(components=tuple(counter)) if counter else None,
    )


def _is_skin(component: ColorComponent) -> bool:
    red, blue, brightness = component.mean()
    (red_low, red_high), (blue_low, blue_high) = _SKIN_HUE
    return bool(red_low <= red <= red_high and blue_low <= blue <= blue_high and brightness >= _SKIN_BRIGHTNESS)


def _lookalikes(
    colors: ColorsFile,
    names: Sequence[str],
    images: Sequence[ImageArray],
    features: Sequence[FloatArray],
    found: Sequence[Mapping[str, BoolArray]],
    markers: Mapping[str, MarkerConfig],
) -> list[ColorComponent]:
    """Return a class for every blob that is taken for a marker but lies apart from all picked ones, largest first."""
    table = build_color_table(colors, names)
    components: list[tuple[float, ColorComponent]] = []
    for image, each, chosen in zip(images, features, found, strict=True):
        labels, _ = table.classify(image)
        labels = np.asarray(cv2.medianBlur(labels, 3), dtype=np.uint8)
        free = _free(chosen, image.shape[:2])
        for label, name in enumerate(names, start=1):
            if name not in chosen:
                continue
            least = _LOOKALIKE_AREA_SHARE * markers[name].min_area_px
            for blob in find_blobs(labels, label, least, float(labels.size)):
                inside = (blob.mask > 0) & (labels[blob.window] == label)
                apart = inside & free[blob.window]
                if np.count_nonzero(apart) > 0.5 * np.count_nonzero(inside):
                    component = fit_component(each[blob.window][apart], COUNTER_FLOOR, _LOOKALIKE_WEIGHT)
                    components.append((blob.area, component))
    return [component for _, component in sorted(components, key=lambda each: -each[0])]


def _quality(
    colors: ColorsFile,
    names: Sequence[str],
    images: Sequence[ImageArray],
    found: Sequence[Mapping[str, BoolArray]],
    free: Sequence[BoolArray],
) -> dict[str, MarkerQuality]:
    table = build_color_table(colors, names)
    labels = [table.classify(image)[0] for image in images]
    others = sum(int(np.count_nonzero(where)) for where in free)
    result = {}
    for label, name in enumerate(names, start=1):
        own = sum(int(np.count_nonzero(chosen[name])) for chosen in found if name in chosen)
        hit = sum(int(np.count_nonzero(seen[chosen[name]] == label)) for seen, chosen in _with(name, labels, found))
        wrong = sum(int(np.count_nonzero(seen[where] == label)) for seen, where in zip(labels, free, strict=True))
        rows, columns = np.nonzero(next(chosen[name] for chosen in found if name in chosen))
        nearest, confusion = _nearest(colors, name, names)
        result[name] = MarkerQuality(
            u=float(columns.mean()),
            v=float(rows.mean()),
            area=float(len(rows)),
            recovered=hit / own,
            false_share=wrong / max(others, 1),
            nearest=nearest,
            confusion=confusion,
        )
    return result


def _with(
    name: str, labels: Sequence[ImageArray], found: Sequence[Mapping[str, BoolArray]]
) -> list[tuple[ImageArray, Mapping[str, BoolArray]]]:
    return [(seen, chosen) for seen, chosen in zip(labels, found, strict=True) if name in chosen]


def _confusion(colors: ColorsFile, first: str, second: str) -> float:
    pair = colors.markers[first], colors.markers[second]
    if not (isinstance(pair[0], GaussianColor) and isinstance(pair[1], GaussianColor)):
        return 0.0
    return max(0.5 * math.exp(-bhattacharyya(a, b)) for a in pair[0].components for b in pair[1].components)


def _nearest(colors: ColorsFile, name: str, names: Sequence[str]) -> tuple[str, float]:
    others = [(other, _confusion(colors, name, other)) for other in names if other != name]
    return max(others, key=lambda other: other[1], default=("", 0.0))


def _confusable(colors: ColorsFile, names: Sequence[str]) -> tuple[tuple[str, str, float], ...]:
    pairs = [
        (first, second, _confusion(colors, first, second))
        for place, first in enumerate(names)
        for second in names[place + 1 :]
    ]
    return tuple(sorted((pair for pair in pairs if pair[2] > CONFUSABLE), key=lambda pair: -pair[2]))


def _as_plain(quality: Mapping[str, MarkerQuality]) -> dict[str, dict[str, float | str]]:
    return {
        name: {
            "u": round(each.u, 2),
            "v": round(each.v, 2),
            "area_px": each.area,
            "recovered": round(each.recovered, 4),
            "false_share": round(each.false_share, 7),
            "nearest": each.nearest,
            "confusion": round(each.confusion, 6),
        }
        for name, each in quality.items()
    }
