"""Look-up table from colour to marker, which classifies a frame in one operation.

A frame is converted to 16-bit 5-6-5 colours; the table has one entry for each of these 65,536 colours. The label of a
colour is the position of its marker in the list, counted from 1; 0 = no marker.

In paint that is seen obliquely, in shade or with motion blur, every pixel is mixed with the surroundings. The same
holds for strips two pixels wide, because cameras subsample colour. A second table also labels such faint colours: those
that are likelier paint than skin or background, but not typical of the paint.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray, ImageArray
from rhot.errors import ConfigError
from rhot.rig.colors import ColorComponent, ColorsFile, Gains, GaussianColor, HsvRangeColor, RgbBoxColor, log_ratio

TABLE_SIZE: Final = 1 << 16
_FAINT: Final = 2.0
"""Limit of faint colours, as a multiple of the paint's limit. Mixtures of half paint and half skin are about there:
skin and paints are 8 to 12 standard deviations apart in rendered and in real pictures, limits are at 3.5."""
_NO_GAINS: Final = (1.0, 1.0, 1.0)
_BOX_EDGE: Final = 3.0
"""Number of standard deviations to which the limit of a box or range is equivalent in likelihoods."""


@dataclass(frozen=True, slots=True)
class ColorTable:
    """The look-up tables of a set of markers.

    Attributes:
        names: markers; label i stands for `names[i - 1]`.
        middles: (N, 3) mean red, green, blue of the N paints, 0 to 255; 0 for one without statistics.
        labels: (65536,) uint8, label of each 5-6-5 colour, 0 = none.
        likelihoods: (65536,) uint8, likelihood of the colour given its label: 255 at the centre of the class, about 0
            at its limit.
        faint: (65536,) uint8, as `labels`, with faint colours in addition; without statistics of skin, background or
            the paint there are none.
        skin: (65536,) uint8, 1 for colours that are likelier skin than background or paint; None without statistics of
            skin and background.
    """

    names: tuple[str, ...]
    middles: FloatArray
    labels: ImageArray
    likelihoods: ImageArray
    faint: ImageArray
    skin: ImageArray | None = None

    def classify(self, image: ImageArray) -> tuple[ImageArray, NDArray[np.uint16]]:
        """Return the label and the 5-6-5 colour of every pixel.

        Args:
            image: (H, W, 3) uint8 BGR.

        Returns:
            (H, W) uint8 labels, (H, W, 1) uint16 colours.
        """
        packed = pack(image)
        labels = np.asarray(cv2.LUT(packed, self.labels), dtype=np.uint8).reshape(image.shape[:2])
        return labels, packed


def pack(image: ImageArray) -> NDArray[np.uint16]:
    """Return the 5-6-5 colours (H, W, 1) of an image (H, W, 3) uint8 BGR."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2BGR565)).view(np.uint16)


def table_colors() -> FloatArray:
    """Return the (65536, 3) red, green, blue at the centre of each cell of the 5-6-5 table, 0 to 255."""
    index = np.arange(TABLE_SIZE)
    red, green, blue = index >> 11, (index >> 5) & 63, index & 31
    return np.column_stack([red * 8 + 3.5, green * 4 + 1.5, blue * 8 + 3.5])


def packed_of(rgb: FloatArray) -> NDArray[np.int64]:
    """Return the numbers of the cells of (N, 3) red, green, blue, 0 to 255, in the 5-6-5 table."""
    red, green, blue = (rgb.astype(np.int64) >> (3, 2, 3)).T
    return np.asarray(red << 11 | green << 5 | blue)


def hsv_of(rgb: FloatArray) -> FloatArray:
    """Return hue in degrees, saturation and value, 0 to 1, of (N, 3) red, green, blue, 0 to 255."""
    picture = (rgb / 255.0).astype(np.float32).reshape(1, -1, 3)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)[0], dtype=np.float64)


def in_balance(rgb: FloatArray, gains: Gains) -> FloatArray:
    """Return (..., 3) red, green, blue multiplied by a camera's gains, 0 to 255; clipped values remain clipped."""
    return np.asarray(np.minimum(rgb * gains, 255.0))


def build_color_table(colors: ColorsFile, names: Sequence[str], camera: str | None = None) -> ColorTable:
    """Build the tables of markers.

    Args:
        colors: the colours; markers without one get no label.
        names: markers in the order of their labels, at most 255.
        camera: of the pictures to classify; None = a camera with the white balance of the colours.

    Raises:
        ConfigError: too many markers.
    """
    if len(names) > 255:
        raise ConfigError(f"{len(names)} markers: at most 255 fit into one colour table")
    rgb = table_colors()
    labels = np.zeros(TABLE_SIZE, np.uint8)
    distances = np.full(TABLE_SIZE, np.inf)
    faint = np.zeros(TABLE_SIZE, np.uint8)
    gains = colors.gains.get(camera or "", _NO_GAINS)
    skin = _assign_statistical(colors, names, in_balance(rgb, gains), labels, distances, faint)
    _assign_boxes(colors, names, rgb, labels, distances)
    likelihoods = np.where(labels > 0, np.round(255.0 * np.exp(-0.5 * distances**2)), 0.0).astype(np.uint8)
    faint = np.where(labels > 0, labels, faint)
    for table in (labels, likelihoods, faint, *(() if skin is None else (skin,))):
        table.setflags(write=False)
    return ColorTable(tuple(names), _middles(colors, names, gains), labels, likelihoods, faint, skin)


def _middles(colors: ColorsFile, names: Sequence[str], gains: Gains) -> FloatArray:
    """Return the mean red, green, blue of each paint in a camera's pictures, (N, 3); 0 for one without statistics."""
    middles = np.zeros((len(names), 3))
    for place, name in enumerate(names):
        color = colors.markers.get(name)
        if isinstance(color, GaussianColor):
            weights = [component.weight for component in color.components]
            middles[place] = np.average([component.rgb for component in color.components], axis=0, weights=weights)
    return middles / gains


def _assign_statistical(
    colors: ColorsFile,
    names: Sequence[str],
    rgb: FloatArray,
    labels: ImageArray,
    distances: FloatArray,
    faint: ImageArray,
) -> ImageArray | None:
    """Assign the labels of colours with statistics; return which colours are skin, None if that is not known."""
    features = log_ratio(rgb)
    best = np.full(TABLE_SIZE, -np.inf)
    likeliest = np.full(TABLE_SIZE, -np.inf)
    reach = 1.0 if colors.skin is None or colors.background is None else _FAINT
    for label, name in enumerate(names, start=1):
        color = colors.markers.get(name)
        if not isinstance(color, GaussianColor):
            continue
        log_likelihood, squared = mixture_fit(color, features)
        limit = color.limit * color.tolerance
        wins = (squared <= limit**2) & (log_likelihood > best)
        labels[wins] = label
        best[wins] = log_likelihood[wins]
        distances[wins] = np.sqrt(squared[wins]) * (_BOX_EDGE / limit)
        near = (squared <= (reach * limit) ** 2) & (log_likelihood > likeliest)
        faint[near] = label
        likeliest[near] = log_likelihood[near]
    counters = []
    for counter in (colors.skin, colors.background):
        if counter is not None:
            log_likelihood, _ = mixture_fit(counter, features)
            labels[log_likelihood > best] = 0
            faint[log_likelihood > likeliest] = 0
            counters.append(log_likelihood)
    if len(counters) < 2:
        return None
    skin, background = counters
    return ((skin > background) & (skin > likeliest)).astype(np.uint8)


def camera_tables(
    colors: ColorsFile, names: Sequence[str], cameras: Collection[str | None]
) -> dict[str | None, ColorTable]:
    """Return the tables of several cameras, see `build_color_table`; cameras with equal gains share one."""
    gains = {camera: colors.gains.get(camera or "", _NO_GAINS) for camera in cameras}
    one_of = {each: camera for camera, each in gains.items()}
    tables = {each: build_color_table(colors, names, camera) for each, camera in one_of.items()}
    return {camera: tables[each] for camera, each in gains.items()}


def mixture_fit(color: GaussianColor, features: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the log-density and the Mahalanobis distance of colours for a class.

    Args:
        color: the class, a Gaussian mixture.
        features: (N, 3) colours in log-ratio space.

    Returns:
        (N,) logarithm of the mixture's density, normalised to an integral of 1 (all classes have the same prior); (N,)
        squared Mahalanobis distance to the nearest component.
    """
    form, constants = _quadratic_forms(color.components)
    squared = _squared_distances(form, features)
    densities = constants[:, None] - 0.5 * squared
    if len(squared) == 1:
        return densities[0], squared[0]
    highest = densities.max(axis=0)
    # The same as `np.logaddexp.reduce` in a third of the time.
    density: FloatArray = highest + np.log(np.exp(densities - highest).sum(axis=0))
    return density, squared.min(axis=0)


def component_distances(color: GaussianColor, features: FloatArray) -> FloatArray:
    """Return the squared Mahalanobis distances (C, N) of colours (N, 3) to the components of a class."""
    form, _ = _quadratic_forms(color.components)
    return _squared_distances(form, features)


def _squared_distances(form: FloatArray, features: FloatArray) -> FloatArray:
    # One row per component: numpy reduces over rows several times as fast as over short columns.
    squared: FloatArray = np.maximum(form @ _monomials(features), 0.0)
    return squared


def _quadratic_forms(components: Sequence[ColorComponent]) -> tuple[FloatArray, FloatArray]:
    """Return the squared Mahalanobis distances to C components as one product with `_monomials`.

    Returns:
        (C, 10) coefficients, and (C,) the logarithm of each component's weight and normaliser.
    """
    means = np.array([component.mean() for component in components])
    covariances = np.array([component.covariance() for component in components])
    A = np.linalg.inv(covariances)
    linear = -2.0 * np.einsum("cij,cj->ci", A, means)
    constant = np.einsum("ci,cij,cj->c", means, A, means)
    form: FloatArray = np.column_stack(
        [A[:, 0, 0], A[:, 1, 1], A[:, 2, 2], 2 * A[:, 0, 1], 2 * A[:, 0, 2], 2 * A[:, 1, 2], linear, constant]
    )
    weights = np.array([component.weight for component in components])
    weights /= weights.sum()
    _, log_determinant = np.linalg.slogdet(covariances)
    return form, np.log(weights) - 0.5 * log_determinant - 1.5 * float(np.log(2.0 * np.pi))


def _monomials(features: FloatArray) -> FloatArray:
    """Return x², y², z², xy, xz, yz, x, y, z and 1 of (N, 3) features, (10, N)."""
    x, y, z = features.T
    return np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, np.ones(len(features))])


def _assign_boxes(
    colors: ColorsFile, names: Sequence[str], rgb: FloatArray, labels: ImageArray, distances: FloatArray
) -> None:
    nearest = np.full(TABLE_SIZE, np.inf)
    for label, name in enumerate(names, start=1):
        color = colors.markers.get(name)
        if isinstance(color, RgbBoxColor):
            relative = _box_distance(color, rgb)
        elif isinstance(color, HsvRangeColor):
            relative = _hsv_distance(color, rgb)
        else:
            continue
        wins = (relative <= 1.0) & (relative < nearest)
        nearest[wins] = relative[wins]
        labels[wins] = label
        distances[wins] = relative[wins] * _BOX_EDGE


def _range_distance(values: FloatArray, low: float, high: float, tolerance: float, cell: float) -> FloatArray:
    """Return distances from the middle of a range in units of its half width; cells that overlap it are inside."""
    half = max(0.5 * (high - low) * tolerance, 1e-9)
    return np.asarray(np.maximum(np.abs(values - 0.5 * (low + high)) - 0.5 * cell, 0.0) / half)


def _box_distance(color: RgbBoxColor, rgb: FloatArray) -> FloatArray:
    # A tolerance of half a cell (4, 2, 4 grey levels), so that a box narrower than a cell still contains its colour.
    relative: FloatArray = np.max(
        [
            _range_distance(rgb[:, axis], color.low[axis], color.high[axis], color.tolerance, cell)
            for axis, cell in enumerate((7.0, 3.0, 7.0))
        ],
        axis=0,
    )
    return relative


def _hsv_distance(color: HsvRangeColor, rgb: FloatArray) -> FloatArray:
    hsv = hsv_of(rgb)
    start, end = color.hue_deg
    width = (end - start) % 360.0 if end - start != 360.0 else 360.0
    middle = start + 0.5 * width
    hue_offset = np.abs((hsv[:, 0] - middle + 180.0) % 360.0 - 180.0)
    relative: FloatArray = np.max(
        [
            hue_offset / max(0.5 * width * color.tolerance, 1e-9),
            _range_distance(hsv[:, 1], *color.saturation, color.tolerance, 0.0),
            _range_distance(hsv[:, 2], *color.value, color.tolerance, 0.0),
        ],
        axis=0,
    )
    return relative
