"""Drawings of how far colours lie apart: the plane of colour ratios with the classes' ellipses, and the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray, ImageArray
from rhot.rig.colors import ColorsFile, GaussianColor, log_ratio
from rhot_calibration.colors.model.fit import ClassPixels
from rhot_calibration.colors.model.separability import CONFUSABLE, Separability

INK: Final = (40, 40, 40)
PAPER: Final = (255, 255, 255)
_FAINT: Final = (225, 225, 225)
_SKIN_INK: Final = (110, 150, 200)
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_MARGIN_PX: Final = 56


def write(
    canvas: ImageArray, text: str, place: tuple[int, int], scale: float = 0.42, color: Sequence[int] = INK
) -> None:
    """Write one line; `place` is the lower left corner of its first letter, pixels."""
    cv2.putText(canvas, text, place, _FONT, scale, tuple(color), 1, cv2.LINE_AA)


def text_width(text: str, scale: float = 0.42) -> int:
    """Return how wide a line of text is, pixels."""
    (width, _), _ = cv2.getTextSize(text, _FONT, scale, 1)
    return int(width)


def ratio_plot(colors: ColorsFile, pixels: ClassPixels, size: int) -> ImageArray:
    """Return a square picture of the plane ln(R/G), ln(B/G): pixels in their own colours, ellipses of two σ.

    Args:
        colors: the classes.
        pixels: of the markers, skin and surroundings.
        size: of the picture, pixels.
    """
    canvas = np.full((size, size, 3), PAPER, np.uint8)
    features = {name: log_ratio(own)[:, :2] for name, own in _clouds(pixels).items()}
    everything = np.concatenate([features[name] for name in pixels.markers])
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle, span = 0.5 * (low + high), max(float((high - low).max()) * 1.25, 0.5)
    scale = (size - 2 * _MARGIN_PX) / span

    def placed(points: FloatArray) -> FloatArray:
        relative: FloatArray = (points - middle) * scale * (1.0, -1.0) + 0.5 * size
        return relative

    _axes(canvas, middle, span, scale)
    for name, own in _clouds(pixels).items():
        for (x, y), rgb in zip(placed(features[name]), own, strict=True):
            if _MARGIN_PX < x < size - _MARGIN_PX and _MARGIN_PX < y < size - _MARGIN_PX:
                cv2.circle(canvas, (round(x), round(y)), 2, tuple(float(c) for c in rgb[::-1]), cv2.FILLED, cv2.LINE_AA)
    background_ink = (170, 170, 170)
    for counter, ink in ((colors.background, background_ink), (colors.skin, _SKIN_INK)):
        if counter is not None:
            _ellipses(canvas, counter, ink, middle, scale)
    for name in pixels.markers:
        color = colors.markers[name]
        if isinstance(color, GaussianColor):
            _ellipses(canvas, color, INK, middle, scale)
    _names(canvas, {name: placed(features[name]) for name in pixels.markers})
    write(canvas, "colour ratios: ellipses of 2 sigma", (_MARGIN_PX, 22), 0.5)
    write(canvas, "skin", (_MARGIN_PX, 42), 0.42, _SKIN_INK)
    write(canvas, "background", (_MARGIN_PX + 44, 42), 0.42, (140, 140, 140))
    return canvas


def _clouds(pixels: ClassPixels) -> dict[str, FloatArray]:
    clouds = {"background": pixels.others, "skin": pixels.skin, **pixels.markers}
    dots = 350
    return {name: own[:: max(1, len(own) // dots)] for name, own in clouds.items() if len(own)}


def _axes(canvas: ImageArray, middle: FloatArray, span: float, scale: float) -> None:
    size = canvas.shape[0]
    step = next(each for each in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0) if span / each <= 8.0 or each == 5.0)
    near, far = _MARGIN_PX, size - _MARGIN_PX
    for axis in range(2):
        first = np.ceil((middle[axis] - 0.5 * span) / step) * step
        for value in np.arange(first, middle[axis] + 0.5 * span + 1e-9, step):
            offset = (value - middle[axis]) * scale
            text = f"{value:.1f}".replace("-0.0", "0.0")
            if axis == 0:
                x = round(0.5 * size + offset)
                cv2.line(canvas, (x, near), (x, far), _FAINT, 1)
                write(canvas, text, (x - text_width(text, 0.38) // 2, far + 16), 0.38)
            else:
                y = round(0.5 * size - offset)
                cv2.line(canvas, (near, y), (far, y), _FAINT, 1)
                write(canvas, text, (near - 8 - text_width(text, 0.38), y + 4), 0.38)
    cv2.rectangle(canvas, (near, near), (far, far), INK, 1)
    label = "ln(R/G)   redder >"
    write(canvas, label, (far - text_width(label), far + 36))
    write(canvas, "ln(B/G), bluer ^", (8, near - 4), 0.38)


def _ellipses(canvas: ImageArray, color: GaussianColor, ink: Sequence[int], middle: FloatArray, scale: float) -> None:
    size = canvas.shape[0]
    layer = canvas.copy()
    for component in color.components:
        values, vectors = np.linalg.eigh(component.covariance()[:2, :2])
        centre = (component.mean()[:2] - middle) * scale * (1.0, -1.0) + 0.5 * size
        ellipse_sigmas = 2.0
        axes = ellipse_sigmas * np.sqrt(values[::-1]) * scale
        angle = -float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        place, half = (round(centre[0]), round(centre[1])), (max(round(axes[0]), 1), max(round(axes[1]), 1))
        cv2.ellipse(layer, place, half, angle, 0, 360, tuple(ink), 1, cv2.LINE_AA)
    inside = slice(_MARGIN_PX, size - _MARGIN_PX)
    canvas[inside, inside] = layer[inside, inside]


def _names(canvas: ImageArray, clouds: dict[str, FloatArray]) -> None:
    """Write each marker's name beside its cloud, moved down where another name stands already."""
    taken: list[tuple[int, int, int]] = []
    for name, points in clouds.items():
        x, y = np.median(points, axis=0)
        place = [round(x) + 10, round(y) - 10]
        wide = text_width(name, 0.5)
        place[0] = min(place[0], canvas.shape[1] - _MARGIN_PX - wide - 4)
        while any(
            abs(place[1] - other[1]) < 16 and place[0] < other[2] and other[0] < place[0] + wide for other in taken
        ):
            place[1] += 16
        taken.append((place[0], place[1], place[0] + wide))
        corner = (place[0] - 3, place[1] - 13)
        cv2.rectangle(canvas, corner, (place[0] + wide + 3, place[1] + 5), PAPER, cv2.FILLED)
        write(canvas, name, (place[0], place[1]), 0.5)


def matrix_picture(apart: Separability, width: int) -> ImageArray:
    """Return the table of expected confusion as a picture; a row is a true class, a column what it is taken for.

    Args:
        apart: the figures.
        width: of the picture, pixels.
    """
    heading, row_height, left = 64, 28, 104
    cell = (width - left - 8) // len(apart.seen)
    canvas = np.full((heading + row_height * len(apart.classes) + 12, width, 3), PAPER, np.uint8)
    write(canvas, "expected share of pixels in light 20 % brighter or darker, per cent", (8, 20), 0.5)
    for column, name in enumerate(apart.seen):
        text = name if text_width(name) < cell - 4 else name[: max(3, cell // 9)] + "."
        write(canvas, text, (left + column * cell + (cell - text_width(text)) // 2, heading - 12))
    for row, name in enumerate(apart.classes):
        top = heading + row * row_height
        write(canvas, name, (8, top + 19))
        for column, share in enumerate(apart.expected[row]):
            corner = (left + column * cell, top)
            own = name == apart.seen[column]
            paint_at_stake = own or name in apart.names or apart.seen[column] in apart.names
            tint = _tint(float(share), own) if paint_at_stake else PAPER
            cv2.rectangle(canvas, corner, (corner[0] + cell - 2, top + row_height - 2), tint, cv2.FILLED)
            text = share_text(float(share))
            write(canvas, text, (corner[0] + (cell - text_width(text)) // 2, top + 19))
    return canvas


def share_text(share: float) -> str:
    """Return a share in per cent, short: two digits, `<.1` for traces and nothing for zero."""
    percent = 100.0 * share
    if percent == 0.0:
        return ""
    return "<.1" if percent < 0.1 else f"{percent:.1f}" if percent < 9.95 else f"{percent:.0f}"


def _tint(share: float, own: bool) -> tuple[float, ...]:
    """Green for what is right, red for what is mixed up: full at twice the limit of a warning."""
    alert = (70, 70, 235)
    target = np.array((150, 215, 160) if own else alert, np.float64)
    weight = share if own else min(1.0, share / (2.0 * CONFUSABLE))
    return tuple(float(value) for value in np.array(PAPER) + weight * (target - np.array(PAPER)))
