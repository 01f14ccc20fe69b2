"""Colours of all markers from a few picks in pictures: grow regions, fit classes, look for what they mistake.

Everything that was not picked is a counter-example. What the fitted colours still take for a marker elsewhere in the
same pictures joins the background as a class of its own, so that a look-alike in the room loses against itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.anatomy.markers import own_paints, worn_paints
from rhot.arrays import BoolArray, FloatArray, ImageArray, IndexArray
from rhot.errors import CalibrationError
from rhot.rig.calibration import today
from rhot.rig.colors import ColorComponent, ColorsFile, Gains, GaussianColor, log_ratio
from rhot.rig.config import MarkerConfig
from rhot_calibration.colors.model.fit import (
    COUNTER_FLOOR,
    MARKER_FLOOR,
    ClassPixels,
    fit_component,
    fit_mixture,
    inner,
    marker_pixels,
    with_gloss,
)
from rhot_calibration.colors.model.separability import (
    MarkerQuality,
    Separability,
    class_pixels,
    marker_quality,
    quality_as_plain,
    separability,
)
from rhot_calibration.colors.picking import regions as picked
from rhot_calibration.colors.picking.picks import Box, Pick, Picks, place_text
from rhot_capture.detection.blob import find_blobs
from rhot_capture.detection.color_table import build_color_table, component_distances, in_balance

# Refusing what no colours can be learnt from, with the place and the remedy.

_LEAST_BOX_PX: Final = 4
_LEAST_MARKED: Final = 0.4
"""Share of a marker's own pixels that must be told from the surroundings, whichever marker they are given to."""


def check_places(images: Sequence[ImageArray], places: Sequence[Picks], markers: Mapping[str, MarkerConfig]) -> None:
    """Check what was pointed out against pictures and markers.

    Raises:
        CalibrationError: nothing at all, an unknown marker, a place outside its picture or a rectangle without area.
    """
    if len(images) != len(places) or not any(places):
        raise CalibrationError(
            "no picks: name each marker with a place on it, for example --pick thumb=281,215, or with a rectangle "
            "around it, for example --box thumb=269,202,25,26"
        )
    for number, (image, shown) in enumerate(zip(images, places, strict=True), start=1):
        height, width = image.shape[:2]
        for name, place in shown.items():
            said = f"{_kind(place)} {name} = {place_text(place)}"
            if name not in markers:
                raise CalibrationError(
                    f"{_kind(place)} {name}: no such marker in rig.toml, which has {', '.join(markers)}"
                )
            if isinstance(place, Box) and min(place.width, place.height) < _LEAST_BOX_PX:
                raise CalibrationError(
                    f"{said} in picture {number}: width and height must be at least {_LEAST_BOX_PX} px; "
                    "the numbers are left, top, width, height"
                )
            inside = [place] if isinstance(place, tuple) else [(place.u, place.v), _far_corner(place)]
            if any(not (0 <= u <= width - 1 and 0 <= v <= height - 1) for u, v in inside):
                raise CalibrationError(f"{said} lies outside picture {number}, which is {width}x{height}")


def _kind(place: Pick) -> str:
    return "box" if isinstance(place, Box) else "pick"


def _far_corner(box: Box) -> tuple[float, float]:
    return box.u + box.width - 1.0, box.v + box.height - 1.0


def check_regions(
    found: Sequence[Mapping[str, BoolArray]], places: Sequence[Picks], markers: Mapping[str, MarkerConfig]
) -> None:
    """Check what was found at the places.

    Raises:
        CalibrationError: too little of one colour, or two markers at one patch of colour.
    """
    for number, (regions, shown) in enumerate(zip(found, places, strict=True), start=1):
        for name, region in regions.items():
            area = int(np.count_nonzero(region))
            least = markers[name].min_area_px
            if area < least:
                place = shown[name]
                remedy = (
                    "draw the box around the whole marker with some of its surroundings"
                    if isinstance(place, Box)
                    else "pick the middle of the painted area"
                )
                raise CalibrationError(
                    f"{_kind(place)} {name} = {place_text(place)} in picture {number}: only {area} px of one colour "
                    f"stand out there, a marker has at least {least:g}; {remedy}, or lower min_area_px"
                )
        for name, region in regions.items():
            for other, other_region in regions.items():
                if name < other and np.count_nonzero(region & other_region) > 0.5 * np.count_nonzero(region):
                    raise CalibrationError(
                        f"picks {name} and {other} in picture {number} found the same patch of colour; pick each on "
                        "its own marker"
                    )


def check_quality(quality: Mapping[str, MarkerQuality]) -> None:
    """Check that every marker stands out from what surrounds it.

    Raises:
        CalibrationError: a marker's colour is that of its surroundings.
    """
    for name, each in quality.items():
        if each.marked < _LEAST_MARKED:
            raise CalibrationError(
                f"pick {name}: the colour found near {each.u:.0f},{each.v:.0f} is that of its surroundings "
                f"({100 * each.marked:.0f} % of it can be told apart, {100 * _LEAST_MARKED:.0f} % is the least); "
                "pick the painted area itself, or use a paint that stands out"
            )


# Which colours of the surroundings are skin: those of its hue that are found rather on the hand than elsewhere.
#
# The hue alone does not tell: wooden desks and cardboard have that of skin, and dark skin in weak light is as dark as
# many a desk. But what lies between and around the painted markers is mostly the hand, and most of the picture is not.

_BRIGHTNESS: Final = math.log(85.0)
"""Least brightness of skin where the pictures do not tell where the hand is: shadows have its hue, too."""
_FEWEST: Final = 4
"""Markers of a picture needed to tell where the hand is: fewer do not enclose any of it."""
_ROOM: Final = np.ones((21, 21), np.uint8)
"""The hand reaches 10 pixels beyond the hull of its markers."""
_STEP: Final = 2
"""Every second row and column is looked at."""
_OFTENER: Final = 1.5
"""Skin is this many times as frequent within the hull of the markers as elsewhere. About half of the hull is desk, seen
between the fingers, so a desk's colours are half as frequent there as elsewhere. Chosen."""


def are_skin(
    components: Sequence[ColorComponent], features: Sequence[FloatArray], found: Sequence[Mapping[str, BoolArray]]
) -> list[bool]:
    """Tell which components of the surroundings are skin.

    Args:
        components: normal distributions of the surroundings' colours.
        features: of each picture, (H, W, 3) colours in log-ratio space.
        found: of each picture, the pixels (H, W) of its markers.
    """
    if not components:
        return []
    surroundings, count = GaussianColor(components=tuple(components)), len(components)
    on_hand, elsewhere = np.zeros(count), np.zeros(count)
    for each, regions in zip(features, found, strict=True):
        if len(regions) < _FEWEST:
            continue
        painted: BoolArray = np.logical_or.reduce(list(regions.values()))
        hull, free = _hull(painted)[::_STEP, ::_STEP] > 0, ~painted[::_STEP, ::_STEP]
        squared = component_distances(surroundings, each[::_STEP, ::_STEP].reshape(-1, 3))
        nearest = squared.argmin(axis=0).reshape(hull.shape)
        on_hand += _shares(nearest[hull & free], count)
        elsewhere += _shares(nearest[~hull & free], count)
    if on_hand.any():
        likely: list[bool] = (on_hand > _OFTENER * elsewhere).tolist()
    else:
        likely = [float(component.mean()[2]) >= _BRIGHTNESS for component in components]
    return [is_likely and _has_hue(component) for component, is_likely in zip(components, likely, strict=True)]


def _shares(nearest: IndexArray, count: int) -> FloatArray:
    """Return the share of each of `count` components among pixels (N,) of these components."""
    shares: FloatArray = np.bincount(nearest, minlength=count) / max(float(len(nearest)), 1.0)
    return shares


def _hull(painted: BoolArray) -> ImageArray:
    """Return the convex hull of pixels (H, W), with some room around it, (H, W) uint8, nonzero inside."""
    v, u = np.nonzero(painted)
    drawn: ImageArray = np.zeros(painted.shape, np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(np.column_stack([u, v]).astype(np.int32)), 1)
    return np.asarray(cv2.dilate(drawn, _ROOM), dtype=np.uint8)


def _has_hue(component: ColorComponent) -> bool:
    red, blue, _ = component.mean()
    # Bounds of ln(R/G) and ln(B/G) of skin in any ordinary light: more red than green, more green than blue.
    (red_low, red_high), (blue_low, blue_high) = ((0.02, 0.90), (-1.60, -0.02))
    return bool(red_low <= red <= red_high and blue_low <= blue <= blue_high)


# How the cameras of a rig differ in white balance and exposure, from the paints that several of them show.
#
# Two cameras with an automatic white balance of their own show one paint in two colours. One class for both would be as
# wide as they are apart, and take in what lies between. So what a camera does to all colours alike is told apart from
# the paints: it multiplies red, green and blue by three factors (von Kries).


def camera_gains(
    images: Sequence[ImageArray], found: Sequence[Mapping[str, BoolArray]], cameras: Sequence[str | None]
) -> dict[str, Gains]:
    """Return by what to multiply red, green and blue of each camera's pictures to have them alike.

    Args:
        images: (H, W, 3) uint8 BGR each.
        found: for each image paint to its pixels, (H, W) bool.
        cameras: of each image; None = not known.

    Returns:
        factors by camera, relative to the mean of the cameras; nothing where cameras are surely not unlike, share too
        few paints, or when a picture's camera is not known, as it could not be balanced alike.
    """
    names = sorted({camera for camera in cameras if camera is not None})
    if len(names) < 2 or None in cameras:
        return {}
    paints = sorted({paint for shown in found for paint in shown})
    levels = np.full((len(names), len(paints), 3), np.nan)
    for row, name in enumerate(names):
        own = [(image, shown) for image, shown, camera in zip(images, found, cameras, strict=True) if camera == name]
        for column, paint in enumerate(paints):
            if parts := [image[inner(shown[paint])] for image, shown in own if paint in shown]:
                levels[row, column] = np.log(np.maximum(np.median(np.concatenate(parts), axis=0)[::-1], 1.0))
    # Grey levels; brighter ones may be cut off, and their ratios say nothing.
    levels[levels > np.log(250.0)] = np.nan
    seen_by_all = np.isfinite(levels).all(axis=0)
    # Paints that tell a camera's factors: of two that disagree none is known to be the wrong one.
    if np.any(np.count_nonzero(seen_by_all, axis=0) < 3):
        return {}
    relative = np.where(seen_by_all, levels - levels.mean(axis=0), np.nan)
    middle = np.nanmedian(relative, axis=1)
    # Of a median, by the median of the deviations from it, for a normal distribution.
    deviation = np.nanmedian(np.abs(relative - middle[:, None]), axis=1)
    error = 1.2533 * 1.4826 * deviation / np.sqrt(np.count_nonzero(seen_by_all, axis=0))
    # Standard errors by which cameras must differ: two views of a paint differ in light and shade, too.
    # Half a per cent: rounding to whole grey levels of a dark channel.
    if np.all(np.abs(middle) <= 3.0 * np.maximum(error, 0.005)):
        return {}
    factors = np.exp(-middle)
    return {name: _rounded(each) for name, each in zip(names, factors, strict=True)}


def balanced(
    images: Sequence[ImageArray], cameras: Sequence[str | None], gains: Mapping[str, Gains]
) -> list[ImageArray]:
    """Return pictures as a camera between all of them would have taken them; one without factors as it is."""
    return [
        image
        if camera is None or camera not in gains
        else np.rint(in_balance(image[..., ::-1].astype(np.float64), gains[camera])).astype(np.uint8)[..., ::-1]
        for image, camera in zip(images, cameras, strict=True)
    ]


def _rounded(factors: FloatArray) -> Gains:
    red, green, blue = (round(float(factor), 4) for factor in factors)
    return red, green, blue


_MARKER_COMPONENTS: Final = 3
_PIXELS_PER_COMPONENT: Final = 400
_BACKGROUND_COMPONENTS: Final = 12
_LIMIT: Final = 3.5
_PATCH_LIMIT: Final = 5.0
"""Limits in standard deviations. A flat patch changes its colour as a whole when its gloss changes: at 3.5, a patch in
plain view broke into pieces 8 to 15 pixels off in one of eleven rendered worlds. Limits from 4.2 to 6 give the same
live coverage (93.5 %) and 95th percentile (5.1 mm) over all of them."""
_GLOSSY: Final = 0.02
"""Share of a patch's pixels that are seen in this condition. In one of 22 rendered sequences, the patch had broken into
pieces of its rim and the hand was 68 mm off; with these components, 20 mm. The detections of the other 21 are the same
to 0.1 %. At 0.05, the patch is found in one of three photographs without markers."""
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
    places: Sequence[Picks],
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
    known = region_of or (lambda number: picked.regions(images[number], places[number]))
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
    lookalike_rounds = 3
    for _ in range(lookalike_rounds):
        new = _lookalikes(colors, names, images, features, found, markers)
        max_lookalikes = 64
        room = max_lookalikes - len(lookalikes)
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
    # Standard deviation of the gloss of a patch that reflects a lamp, grey levels. A flat patch does so as a
    # whole, a curved fingertip only in a spot.
    glossy = [with_gloss(part, 30.0) for part in parts]
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
            lookalike_area_share = 0.5
            least = lookalike_area_share * markers[name].min_area_px
            for blob in find_blobs(labels, label, least, float(labels.size)):
                inside = (blob.mask > 0) & (labels[blob.window] == label)
                apart = inside & free[blob.window]
                if np.count_nonzero(apart) > 0.5 * np.count_nonzero(inside):
                    lookalike_weight = 0.02
                    component = fit_component(each[blob.window][apart], COUNTER_FLOOR, lookalike_weight)
                    components.append((blob.area, component))
    return [component for _, component in sorted(components, key=lambda each: -each[0])]
