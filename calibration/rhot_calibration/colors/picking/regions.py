"""From a pick near a marker to the marker's own pixels.

A click is rarely on the middle and may even miss. Paint is rare in a picture while cloth, desk and skin are not, so
the seed is the place near the click whose whole neighbourhood has rare colours; from there the region grows over
connected pixels that fit its own normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from rhot.arrays import BoolArray, FloatArray, ImageArray
from rhot.rig.colors import GaussianColor, log_ratio
from rhot_calibration.colors.model.fit import COUNTER_FLOOR, fit_component, fit_mixture
from rhot_calibration.colors.picking.picks import Box, Pick, Picks
from rhot_capture.detection.color_table import mixture_fit

# From a rectangle around a marker to the marker's own pixels: the dominant colour in it that is not around it.

_RING_SHARE: Final = 0.5
_LEAST_RING_PX: Final = 6
_BOXES_SURROUNDINGS: Final = 6
_MODE_SCALE: Final = (0.10, 0.10, 0.35)
"""Width of the neighbourhood in log-ratio space in which colours count as one paint when the dominant one is sought."""
_MODE_SAMPLES: Final = 400
_FIT_FLOOR: Final = (0.045, 0.045, 0.15)
_LIMIT: Final = 3.0
_ROUNDS: Final = 6
_LEAST_SHARE: Final = 0.1
"""A marker fills at least this share of its rectangle."""


def box_region(features: FloatArray, box: Box, others: BoolArray) -> BoolArray:
    """Return the marker's pixels in a rectangle, (H, W) bool; all False where nothing in it stands out.

    Args:
        features: (H, W, 3) float64, the picture in log-ratio space.
        box: the rectangle, at least partly inside the picture.
        others: (H, W) bool, where other markers are: they do not count as surroundings.
    """
    height, width = others.shape
    inside = _window(box, 0, height, width)
    reach = max(_LEAST_RING_PX, round(_RING_SHARE * max(box.width, box.height)))
    around = np.zeros(others.shape, bool)
    around[_window(box, reach, height, width)] = True
    around[inside] = False
    region = np.zeros(others.shape, bool)
    # A rectangle drawn inside its marker has the same paint around it: the rest of the picture is the reference then.
    far = np.ones(others.shape, bool)
    far[_window(box, 3 * reach, height, width)] = False
    for reference in (around & ~others, far & ~others):
        samples = features[reference]
        if len(samples) < _MODE_SAMPLES // 4:
            continue
        found = _dominant(features[inside], samples)
        if np.count_nonzero(found) >= _LEAST_SHARE * found.size:
            region[inside] = found
            return region
    return region


def _window(box: Box, reach: int, height: int, width: int) -> tuple[slice, slice]:
    left, top = round(box.u) - reach, round(box.v) - reach
    right, bottom = round(box.u + box.width) + reach, round(box.v + box.height) + reach
    return slice(max(top, 0), min(bottom, height)), slice(max(left, 0), min(right, width))


def _dominant(inside: FloatArray, around: FloatArray) -> BoolArray:
    """Return the pixels of the dominant colour in a rectangle, (h, w) bool.

    Args:
        inside: (h, w, 3) the rectangle in log-ratio space.
        around: (N, 3) what surrounds it.
    """
    shape = inside.shape[:2]
    flat = inside.reshape(-1, 3)
    reference = GaussianColor(components=tuple(fit_mixture(around, _BOXES_SURROUNDINGS, COUNTER_FLOOR)))
    surroundings, _ = mixture_fit(reference, flat)
    # Logarithm of how much rarer a colour must be around the rectangle than evenly spread colours would be.
    even_density = 0.0
    candidates = flat[surroundings < even_density - 2.0]
    if len(candidates) < _LEAST_SHARE * len(flat):
        return np.zeros(shape, bool)
    own = candidates[_near(candidates, _mode(candidates))]
    region = np.zeros(shape, bool)
    for _ in range(_ROUNDS):
        color = GaussianColor(components=(fit_component(own, _FIT_FLOOR),))
        density, squared = mixture_fit(color, flat)
        fits = ((squared <= _LIMIT**2) & (density > surroundings)).reshape(shape)
        grown = _largest(fits)
        if not grown.any() or np.array_equal(grown, region):
            break
        region = grown
        own = inside[region]
    return region


def _mode(samples: FloatArray) -> FloatArray:
    """Return the colour with the most like it."""
    chosen = samples[:: -(-len(samples) // _MODE_SAMPLES)]
    scaled = chosen / _MODE_SCALE
    squared = np.square(scaled[:, None] - scaled[None]).sum(axis=-1)
    mode: FloatArray = chosen[int(np.exp(-0.5 * squared).sum(axis=1).argmax())]
    return mode


def _near(samples: FloatArray, colour: FloatArray) -> BoolArray:
    near: BoolArray = np.square((samples - colour) / _MODE_SCALE).sum(axis=-1) <= _LIMIT**2 / 2.0
    return near


def _largest(fits: BoolArray) -> BoolArray:
    opened = cv2.morphologyEx(fits.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    contours, _ = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros(fits.shape, np.uint8)
    if contours:
        # Highlights inside the outline are paint too.
        cv2.drawContours(filled, [max(contours, key=cv2.contourArea)], -1, 1, cv2.FILLED)
    return filled > 0


SEARCH_PX: Final = 12
_PATCH_PX: Final = 2
_WINDOWS_PX: Final = (60, 130)
"""Half the width of what is looked at around a pick; the second has room for a marker in a close-up."""
_RARE_SEEDS: Final = 5
_AROUND_PX: Final = 8
_SEED_SPACING_PX: Final = 5
_NEAR_PX: Final = 6.0
_SIZE_WEIGHT: Final = 1.9
_EVENNESS_WEIGHT: Final = 12.0
_COMPACT_WEIGHT: Final = 6.0
_CENTRE_WEIGHT: Final = 3.0
_LIKENESS_WEIGHT: Final = 0.3
_LEAST_DENSITY: Final = -12.0
_DRIFT: Final = (0.40, 0.40, 0.9)
"""No pixel may lie further than this from the seed's own colour in log-ratio space, however the region drifts."""
_BINS: Final = (0.06, 0.06, 0.30)
_SURROUNDINGS: Final = 10


@dataclass(frozen=True, slots=True)
class PickImage:
    """A picture prepared for picking.

    Attributes:
        image: (H, W, 3) uint8 BGR.
        features: (H, W, 3) float64, smoothed colours in log-ratio space.
        commonness: (H, W) float64, natural logarithm of the share of the picture with a like colour.
        surroundings: colours of everything that was not picked.
    """

    image: ImageArray
    features: FloatArray
    commonness: FloatArray
    surroundings: GaussianColor


@dataclass(frozen=True, slots=True)
class _View:
    """A window of a prepared picture; the density is (h, w), its logarithm, of the surroundings' colours."""

    features: FloatArray
    commonness: FloatArray
    density: FloatArray


def prepare(image: ImageArray, places: Picks) -> PickImage:
    """Prepare a picture.

    Args:
        image: (H, W, 3) uint8 BGR.
        places: all markers shown in it.
    """
    smooth = cv2.GaussianBlur(image, (3, 3), 0)[..., ::-1].astype(np.float64)
    features = log_ratio(smooth)
    around = np.zeros(image.shape[:2], bool)
    for place in places.values():
        around |= _surroundings_of(place, image.shape[:2])
    return PickImage(image, features, _commonness(features), _colors_of(features[~around]))


def _surroundings_of(place: Pick, shape: tuple[int, ...]) -> BoolArray:
    """Return where a marker may be, generously, (H, W) bool."""
    around = np.zeros(shape, np.uint8)
    if isinstance(place, Box):
        corner, size = (round(place.u), round(place.v)), (max(round(place.width), 1), max(round(place.height), 1))
        cv2.rectangle(around, (*corner, *size), 1, cv2.FILLED)
    else:
        clearance_px = 25
        cv2.circle(around, (round(place[0]), round(place[1])), clearance_px, 1, cv2.FILLED)
    return around > 0


def regions(image: ImageArray, places: Picks) -> dict[str, BoolArray]:
    """Return each shown marker's pixels, (H, W) bool, in one picture.

    Args:
        image: (H, W, 3) uint8 BGR.
        places: marker name to a place on it or a rectangle around it, pixels.
    """
    picture = prepare(image, places)
    grown = {name: _region(picture, place, places) for name, place in places.items()}
    if not any(isinstance(place, tuple) for place in places.values()):
        return grown
    # Once the markers are known roughly, their surroundings are known exactly, and the rims come out sharper.
    taken = np.zeros(image.shape[:2], np.uint8)
    for region in grown.values():
        taken |= region
    free = cv2.dilate(taken, np.ones((7, 7), np.uint8)) == 0
    sharper = replace(picture, surroundings=_colors_of(picture.features[free]))
    return {name: grown[name] if isinstance(place, Box) else grow(sharper, *place) for name, place in places.items()}


def _region(picture: PickImage, place: Pick, places: Picks) -> BoolArray:
    if not isinstance(place, Box):
        return grow(picture, *place)
    others = np.zeros(picture.image.shape[:2], bool)
    for other in places.values():
        if other is not place:
            others |= _surroundings_of(other, others.shape)
    return box_region(picture.features, place, others)


def _colors_of(features: FloatArray) -> GaussianColor:
    return GaussianColor(components=tuple(fit_mixture(features, _SURROUNDINGS, COUNTER_FLOOR)))


def _commonness(features: FloatArray) -> FloatArray:
    bins = np.floor(features / _BINS).astype(np.int64)
    bins -= bins.min(axis=(0, 1)) - 1
    shape = bins.max(axis=(0, 1)) + 2
    flat = bins.reshape(-1, 3)
    index = np.ravel_multi_index((flat[:, 0], flat[:, 1], flat[:, 2]), tuple(shape))
    counts = np.bincount(index, minlength=int(np.prod(shape))).astype(np.float64).reshape(shape)
    for axis in range(3):
        counts = counts + np.roll(counts, 1, axis) + np.roll(counts, -1, axis)
    return np.asarray(np.log(counts.ravel()[index] / len(flat))).reshape(features.shape[:2])


def grow(picture: PickImage, u: float, v: float) -> BoolArray:
    """Return the marker's pixels around a pick, (H, W) bool.

    Of the regions that grow from several seeds the one counts that is large, rare in colour and near the pick: the
    rarest seed alone would often be a highlight.

    Args:
        picture: the prepared picture.
        u: the pick, pixels to the right.
        v: the pick, pixels down.
    """
    whole = np.zeros(picture.image.shape[:2], bool)
    for reach in _WINDOWS_PX:
        left, top = max(0, round(u) - reach), max(0, round(v) - reach)
        window = (slice(top, round(v) + reach + 1), slice(left, round(u) + reach + 1))
        features = picture.features[window]
        density, _ = mixture_fit(picture.surroundings, features.reshape(-1, 3))
        view = _View(features, picture.commonness[window], density.reshape(features.shape[:2]))
        best, best_worth = np.zeros(view.density.shape, bool), -np.inf
        for seed in _seeds(view, u - left, v - top):
            # A marker does not fill more of a picture than this; a region that does has leaked into its
            # surroundings.
            region = _grow_from(view, seed, 0.08 * whole.size)
            worth = _worth(view, region, u - left, v - top)
            if worth > best_worth:
                best, best_worth = region, worth
        rows, columns = np.nonzero(best)
        if len(rows) and max(np.abs(columns + left - u).max(), np.abs(rows + top - v).max()) < reach - 1:
            break
    whole[window] = best
    return whole


def _seeds(view: _View, u: float, v: float) -> list[tuple[int, int]]:
    """Return the pick, places around it, and the rarest places near it.

    The rarest alone may all lie in one highlight, those around the pick alone may all miss a small marker.
    """
    size = 2 * _PATCH_PX + 1
    patch_commonness = cv2.dilate(view.commonness, np.ones((size, size), np.uint8))
    rows, columns = np.mgrid[: patch_commonness.shape[0], : patch_commonness.shape[1]]
    away = np.hypot(columns - u, rows - v) / SEARCH_PX
    distance_weight = 1.2
    cost = patch_commonness + distance_weight * away**2
    cost[away > 1.0] = np.inf
    height, width = patch_commonness.shape
    around = [(0, 0), (_AROUND_PX, 0), (-_AROUND_PX, 0), (0, _AROUND_PX), (0, -_AROUND_PX)]
    seeds = [(min(max(round(u) + du, 0), width - 1), min(max(round(v) + dv, 0), height - 1)) for du, dv in around]
    for _ in range(_RARE_SEEDS):
        place = int(np.argmin(cost))
        row, column = divmod(place, cost.shape[1])
        if not np.isfinite(cost[row, column]):
            break
        seeds.append((column, row))
        cost[np.hypot(columns - column, rows - row) < _SEED_SPACING_PX] = np.inf
    return seeds


def _worth(view: _View, region: BoolArray, u: float, v: float) -> float:
    rows, columns = np.nonzero(region)
    if len(rows) == 0:
        return -np.inf
    away = float(np.hypot(columns - u, rows - v).min()) / _NEAR_PX
    off_centre = float(np.hypot(columns.mean() - u, rows.mean() - v)) / (SEARCH_PX + 0.3 * float(np.sqrt(len(rows))))
    hull = cv2.convexHull(np.column_stack([columns, rows]).astype(np.int32))
    solidity = min(1.0, len(rows) / (cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + 1.0))
    return (
        _SIZE_WEIGHT * float(np.log(len(rows)))
        - _EVENNESS_WEIGHT * float(view.features[region][:, 2].var())
        - float(view.commonness[region].mean())
        + _COMPACT_WEIGHT * float(np.log(solidity))
        - 2.0 * away**2
        - _CENTRE_WEIGHT * off_centre**2
        - _LIKENESS_WEIGHT * float(np.maximum(view.density[region], _LEAST_DENSITY).mean())
    )


def _grow_from(view: _View, seed: tuple[int, int], most_pixels: float) -> BoolArray:
    region = np.zeros(view.density.shape, bool)
    rows = slice(max(0, seed[1] - _PATCH_PX), seed[1] + _PATCH_PX + 1)
    columns = slice(max(0, seed[0] - _PATCH_PX), seed[0] + _PATCH_PX + 1)
    region[rows, columns] = True
    patch = region
    like_seed = np.all(np.abs(view.features - view.features[patch].mean(axis=0)) <= _DRIFT, axis=-1)
    grow_rounds = 8
    for _ in range(grow_rounds):
        grown = _grown(view, region, seed, like_seed)
        if np.count_nonzero(grown) > most_pixels:
            # Leaked into the surroundings, and the round before already had begun to.
            return patch
        if np.array_equal(grown, region):
            break
        region = grown
    return region


def _grown(view: _View, region: BoolArray, seed: tuple[int, int], allowed: BoolArray) -> BoolArray:
    inner = cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    min_fit_pixels = 20
    own = inner if np.count_nonzero(inner) >= min_fit_pixels else region
    grow_floor = (0.045, 0.045, 0.15)
    color = GaussianColor(components=(fit_component(view.features[own], grow_floor),))
    density, squared = mixture_fit(color, view.features[allowed])
    fits = np.zeros(region.shape, np.uint8)
    grow_limit = 3.0
    fits[allowed] = (squared <= grow_limit**2) & (density > view.density[allowed])
    opened = cv2.morphologyEx(fits, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(opened, connectivity=4)
    label = labels[seed[1], seed[0]]
    if label == 0:
        return region
    connected: BoolArray = np.asarray(labels == label)
    return _filled(connected)


def _filled(region: BoolArray) -> BoolArray:
    """Close holes: highlights and the shine of a nail are paint too."""
    contours, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros(region.shape, np.uint8)
    cv2.drawContours(filled, contours, -1, 1, cv2.FILLED)
    return filled > 0
