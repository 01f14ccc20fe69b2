"""Colours of all markers from a few picks in pictures: grow regions, fit classes, look for what they mistake.

Everything that was not picked is a counter-example. What the fitted colours still take for a marker elsewhere in the
same pictures joins the background as a class of its own, so that a look-alike in the room loses against itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.arrays import BoolArray, FloatArray, ImageArray
from rhot.rig.calibration import today
from rhot.rig.colors import ColorComponent, ColorsFile, GaussianColor, log_ratio
from rhot.rig.config import MarkerConfig
from rhot.rig.marker_config import own_paints, worn_paints
from rhot_calibration.colors.model.balance import balanced, camera_gains
from rhot_calibration.colors.model.fit import COUNTER_FLOOR, MARKER_FLOOR, fit_component, fit_mixture, with_gloss
from rhot_calibration.colors.model.quality import MarkerQuality, class_pixels, marker_quality, quality_as_plain
from rhot_calibration.colors.model.samples import ClassPixels, marker_pixels
from rhot_calibration.colors.model.separability import Separability, separability
from rhot_calibration.colors.model.skin import are_skin
from rhot_calibration.colors.picking.checks import check_places, check_quality, check_regions
from rhot_calibration.colors.picking.picks import Places
from rhot_calibration.colors.picking.regions import regions
from rhot_capture.detection.blob import find_blobs
from rhot_capture.detection.color_table import build_color_table

_MARKER_COMPONENTS: Final = 3
_PIXELS_PER_COMPONENT: Final = 400
_BACKGROUND_COMPONENTS: Final = 12
_LIMIT: Final = 3.5
_PATCH_LIMIT: Final = 5.0
"""Limits in standard deviations. A flat patch changes its colour as a whole when its gloss changes: at 3.5, a patch in
plain view broke into pieces 8 to 15 pixels off in one of eleven rendered worlds. Limits from 4.2 to 6 give the same
live coverage (93.5 %) and 95th percentile (5.1 mm) over all of them."""
_PATCH_GLOSS: Final = 30.0
"""Standard deviation of the gloss of a patch that reflects a lamp, grey levels. A flat patch does so as a whole, a
curved fingertip only in a spot."""
_GLOSSY: Final = 0.02
"""Share of a patch's pixels that are seen in this condition. In one of 22 rendered sequences, the patch had broken into
pieces of its rim and the hand was 68 mm off; with these components, 20 mm. The detections of the other 21 are the same
to 0.1 %. At 0.05, the patch is found in one of three photographs without markers."""
_LOOKALIKE_ROUNDS: Final = 3
_MAX_LOOKALIKES: Final = 64
_LOOKALIKE_WEIGHT: Final = 0.02
_LOOKALIKE_AREA_SHARE: Final = 0.5
_CLEARANCE: Final = np.ones((7, 7), np.uint8)


@dataclass(frozen=True, slots=True)
class ColorCalibration:
    """Colours and how good they are.

    Attributes:
        colors: to be written as `colors.json`.
        markers: quality of each paint that was shown, by the marker that stands for it.
        regions: for each picture the same to its pixels, (H, W) bool.
        pixels: of all classes, in the pictures.
        separability: how well the colours can be told apart.
    """

    colors: ColorsFile
    markers: dict[str, MarkerQuality]
    regions: tuple[dict[str, BoolArray], ...]
    pixels: ClassPixels
    separability: Separability


def calibrate(
    images: Sequence[ImageArray],
    places: Sequence[Places],
    markers: Mapping[str, MarkerConfig],
    region_of: Callable[[int], dict[str, BoolArray]] | None = None,
    cameras: Sequence[str | None] | None = None,
) -> ColorCalibration:
    """Fit colours to markers shown in pictures; a marker that is not shown gets none.

    Args:
        images: (H, W, 3) uint8 BGR each.
        places: for each image marker name to (u, v), pixels, on the marker or within about 10 px of it, or to a
            rectangle around the marker.
        markers: the rig's markers by name.
        region_of: returns what `regions` says of a picture by its place among `images`, where that is known.
        cameras: of each image; None = not known. Those that differ are balanced where enough paints tell how.

    Raises:
        CalibrationError: no place at all, an unknown marker, a place outside its picture, or nothing there that is
            of a marker's size and differs from its surroundings.
    """
    check_places(images, places, markers)
    known = region_of or (lambda number: regions(images[number], places[number]))
    found = [known(number) for number in range(len(images))]
    check_regions(found, places, markers)
    worn = worn_paints(markers)
    found = [_by_paint(shown, worn) for shown in found]
    names = [name for name in own_paints(markers) if any(name in shown for shown in found)]
    cameras = cameras or [None] * len(images)
    gains = camera_gains(images, found, cameras)
    images = balanced(images, cameras, gains)
    features = [log_ratio(image[..., ::-1].astype(np.float64)) for image in images]
    painted = {name: marker_pixels(images, found, name) for name in names}
    fitted = {name: _fit_marker(log_ratio(own), markers[name].kind) for name, own in painted.items()}
    free = [_free(chosen, image.shape[:2]) for chosen, image in zip(found, images, strict=True)]
    others = np.concatenate([each[where] for each, where in zip(features, free, strict=True)])
    background = fit_mixture(others, _BACKGROUND_COMPONENTS, COUNTER_FLOOR)
    limits = {name: _PATCH_LIMIT if markers[name].kind == "patch" else _LIMIT for name in names}
    colors = _assemble(fitted, limits, background, features, found)
    lookalikes: list[ColorComponent] = []
    for _ in range(_LOOKALIKE_ROUNDS):
        new = _lookalikes(colors, names, images, features, found, markers)
        room = _MAX_LOOKALIKES - len(lookalikes)
        if not new or room <= 0:
            break
        lookalikes += new[:room]
        colors = _assemble(fitted, limits, [*background, *lookalikes], features, found)
    table = build_color_table(colors, names)
    quality = marker_quality(table, images, found, free)
    check_quality(quality)
    pixels = class_pixels(painted, colors, table, images, found, free)
    apart = separability(colors, table, pixels)
    colors = colors.model_copy(update={"quality": quality_as_plain(quality, apart), "gains": gains})
    return ColorCalibration(colors, quality, tuple(found), pixels, apart)


def _by_paint(regions: Mapping[str, BoolArray], worn: Mapping[str, str]) -> dict[str, BoolArray]:
    """Return the regions of a picture by paint: those of two markers that wear the same one become one."""
    paints: dict[str, BoolArray] = {}
    for name, region in regions.items():
        before = paints.get(worn[name])
        paints[worn[name]] = region if before is None else region | before
    return paints


def _fit_marker(samples: FloatArray, kind: str) -> list[ColorComponent]:
    count = min(_MARKER_COMPONENTS, len(samples) // _PIXELS_PER_COMPONENT)
    parts = [fit_component(samples, MARKER_FLOOR)] if count <= 1 else fit_mixture(samples, count, MARKER_FLOOR)
    usual = [with_gloss(part) for part in parts]
    if kind != "patch":
        return usual
    glossy = [with_gloss(part, _PATCH_GLOSS) for part in parts]
    return [*_weighted(usual, 1.0 - _GLOSSY), *_weighted(glossy, _GLOSSY)]


def _weighted(components: Sequence[ColorComponent], share: float) -> list[ColorComponent]:
    return [component.model_copy(update={"weight": share * component.weight}) for component in components]


def _free(chosen: Mapping[str, BoolArray], shape: tuple[int, ...]) -> BoolArray:
    taken = np.zeros(shape, np.uint8)
    for region in chosen.values():
        taken |= region
    free: BoolArray = np.asarray(cv2.dilate(taken, _CLEARANCE)) == 0
    return free


def _assemble(
    fitted: Mapping[str, Sequence[ColorComponent]],
    limits: Mapping[str, float],
    counters: Sequence[ColorComponent],
    features: Sequence[FloatArray],
    found: Sequence[Mapping[str, BoolArray]],
) -> ColorsFile:
    told = are_skin(counters, features, found)
    skin = [component for component, is_skin in zip(counters, told, strict=True) if is_skin]
    counter = [component for component, is_skin in zip(counters, told, strict=True) if not is_skin]
    return ColorsFile(
        date=today(),
        markers={name: GaussianColor(components=tuple(parts), limit=limits[name]) for name, parts in fitted.items()},
        skin=GaussianColor(components=tuple(skin)) if skin else None,
        background=GaussianColor(components=tuple(counter)) if counter else None,
    )


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
