"""The picture that shows a person how well the colours came out: overlay, masks, ratios and the table of confusion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from rhot.arrays import ImageArray
from rhot_calibration.colors.calibration import ColorCalibration
from rhot_calibration.colors.model.paints import Illumination, Suggestion, estimate_illumination, suggest
from rhot_calibration.colors.model.separability import BACKGROUND, CONFUSABLE, Separability
from rhot_calibration.colors.report.plot import INK, PAPER, matrix_picture, ratio_plot, share_text, text_width, write
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.result import Detection

# What a colour calibration says on the terminal: a table per marker, the matrix of confusion, warnings, advice.


def _new_table(title: str) -> Table:
    return Table(
        title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1), collapse_padding=True, pad_edge=False
    )


def marker_table(
    result: ColorCalibration, titles: Sequence[str], detections: Sequence[Mapping[str, Detection]]
) -> Table:
    """Return what the tracker finds with the new colours, marker by marker."""
    table = _new_table("Colours found")
    several = len(titles) > 1
    table.add_column("marker", no_wrap=True)
    if several:
        table.add_column("picture")
    for heading in ("u,v", "area", "score", "kept"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("most like", no_wrap=True)
    for heading in ("distance", "mixed up", "margin"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, quality in result.markers.items():
        for title, found in zip(titles, detections, strict=True):
            detection = found.get(name)
            place = (
                ("-", "-", "not seen")
                if detection is None
                else (f"{detection.u:.1f},{detection.v:.1f}", f"{detection.area:.0f}", f"{detection.score:.2f}")
            )
            label = (name, title) if several else (name,)
            table.add_row(*label, *place, f"{100 * quality.recovered:.0f} %", *_nearest(result.separability, name))
    return table


def _nearest(apart: Separability, name: str) -> tuple[str, str, str, str]:
    other, confusion = apart.nearest(name)
    if not other:
        return "-", "-", "-", "-"
    row, column = apart.names.index(name), apart.names.index(other)
    margin = min(apart.margin[row, column], apart.margin[column, row])
    return (
        other,
        f"{apart.distance[row, column]:.1f}",
        f"{100 * confusion:.1f} %",
        f"{100 * margin:.0f} %" if margin <= 0.5 else "> 50 %",
    )


def confusion_table(apart: Separability) -> Table:
    """Return the matrix of expected confusion; a row is what is there, a column what it is taken for."""
    table = _new_table("Taken for, % of pixels, in light 20 % brighter or darker")
    table.caption = "margin above: drift of the camera's red or blue gain until 5 % of the pixels change over"
    table.caption_justify = "left"
    table.add_column("is")
    for name in apart.seen:
        table.add_column(name if name != BACKGROUND else "backgr.", justify="right", no_wrap=True)
    for name, shares in zip(apart.classes, apart.expected, strict=True):
        cells = []
        for seen, share in zip(apart.seen, shares, strict=True):
            text = share_text(float(share))
            worse = name in apart.names and seen in apart.names and name != seen and share > CONFUSABLE
            cells.append(f"[yellow]{text}[/yellow]" if worse else text)
        table.add_row(name, *cells)
    return table


def warnings(result: ColorCalibration) -> list[str]:
    """Return a line for everything that will be confused, the worst first."""
    apart = result.separability
    lines = []
    for first, second, _ in apart.confusable():
        a, b = apart.names.index(first), apart.names.index(second)
        lines.append(
            f"warning: {first} and {second} will be mixed up: {100 * apart.expected[a, b]:.0f} % of {first} is taken "
            f"for {second} and {100 * apart.expected[b, a]:.0f} % of {second} for {first}"
        )
    for name, other, share in apart.lost():
        lines.append(f"warning: {name} fades into the {other}: {100 * share:.0f} % of its pixels are taken for it")
    for name, share in apart.skin_like():
        lines.append(
            f"warning: {100 * share:.0f} % of the skin is taken for {name}: was it picked on its paint? If so, use a "
            "paint that is less like skin"
        )
    for name, quality in result.markers.items():
        stray = quality.false_share * result.pixels.others_area / result.pixels.pictures
        if stray > result.pixels.area[name]:
            lines.append(
                f"warning: {stray:.0f} px of the surroundings look like {name}, which has "
                f"{result.pixels.area[name]:.0f} px itself; cover them, or use another paint"
            )
    return lines


def suggestions(result: ColorCalibration) -> list[str]:
    """Return advice for everything that will be confused: a better paint, or what else to try."""
    apart = result.separability
    pairs = [(first, second) for first, second, _ in apart.confusable()]
    pairs += [(name, other) for name, other, _ in apart.lost()]
    if not pairs:
        return []
    light = estimate_illumination(result.pixels)
    lines = []
    advised: set[str] = set()
    used: list[str] = []
    for first, second in pairs:
        if advised & {first, second}:
            continue
        found = suggest(result.colors, first, second, light, used)
        if found is None:
            what = (
                "a cloth of another colour" if second == BACKGROUND else "more even light, and picks in more pictures"
            )
            lines.append(f"{first} and {second}: no common paint would stand out better; try {what}")
            continue
        advised.add(found.marker)
        used.append(found.paint)
        lines.append(_advice(found, light))
    return lines


def _advice(found: Suggestion, light: Illumination) -> str:
    red, green, blue = (round(channel) for channel in found.rgb)
    return (
        f"suggestion: paint {found.marker} {found.paint} (about RGB {red}, {green}, {blue} in these pictures): its "
        f"distance to everything else would be {found.distance:.1f} instead of {found.present:.1f}. An estimate, light "
        f"judged by {light.source}; calibrate again to be sure"
    )


_WIDTH: Final = 1280
_OVERLAYS: Final = 4
_MASK_COLUMNS: Final = 4
_FOUND: Final = (80, 255, 80)
_LEARNT: Final = (255, 255, 255)
_SHADOW: Final = (0, 0, 0)


def report_picture(
    images: Sequence[ImageArray],
    titles: Sequence[str],
    result: ColorCalibration,
    tables: Sequence[ColorTable],
    detections: Sequence[Mapping[str, Detection]],
    remarks: Sequence[str] = (),
) -> ImageArray:
    """Return the report, (H, 1280, 3) uint8 BGR.

    Args:
        images: the pictures, (H, W, 3) uint8 BGR each.
        titles: their names.
        result: what was learnt from them.
        tables: of its colours, for each picture.
        detections: what the tracker finds in each picture.
        remarks: lines to write below the table, such as warnings.
    """
    shown = min(len(images), _OVERLAYS)
    columns = 1 if shown == 1 else 2
    overlays = [
        _titled(
            overlay_picture(images[n], result, n, detections[n], _WIDTH // columns),
            f"{titles[n]}: {_legend(n, result)}",
        )
        for n in range(shown)
    ]
    masks = [_mask_tile(images, titles, result, tables, name) for name in result.markers]
    plot = ratio_plot(result.colors, result.pixels, _WIDTH // 2)
    matrix = matrix_picture(result.separability, _WIDTH // 2)
    figures = _tiled([plot, _stacked(matrix, _remarks(remarks, _WIDTH // 2))], 2)
    parts = [_tiled(overlays, columns), _tiled(masks, min(_MASK_COLUMNS, len(masks))), figures]
    return np.concatenate([_padded(part, _WIDTH) for part in parts])


def _legend(number: int, result: ColorCalibration) -> str:
    learnt = len(result.regions[number])
    return f"white = learnt from ({learnt}), green = found by the tracker"


def overlay_picture(
    image: ImageArray, result: ColorCalibration, number: int, found: Mapping[str, Detection], width: int
) -> ImageArray:
    """Return a picture of this width with what its colours were learnt from and what the tracker finds.

    Args:
        image: (H, W, 3) uint8 BGR.
        result: what was learnt.
        number: of the picture among those that it was learnt from.
        found: what the tracker finds in it.
        width: pixels.
    """
    scale = width / image.shape[1]
    canvas = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR), np.uint8)
    for region in result.regions[number].values():
        large = cv2.resize(region.astype(np.uint8), (canvas.shape[1], canvas.shape[0]), interpolation=cv2.INTER_NEAREST)
        contours, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(canvas, contours, -1, _LEARNT, 1, cv2.LINE_AA)
    for name, detection in found.items():
        outline = np.zeros(image.shape[:2], np.uint8)
        columns, rows = np.rint(detection.outline).astype(np.int64).T
        outline[rows, columns] = 1
        large = cv2.resize(outline, (canvas.shape[1], canvas.shape[0]), interpolation=cv2.INTER_NEAREST)
        canvas[large > 0] = (0.4 * canvas[large > 0] + 0.6 * np.array(_FOUND)).astype(np.uint8)
        text = f"{name} {detection.score:.2f}"
        centre = (round((detection.u + 0.5) * scale), round((detection.v + 0.5) * scale))
        right = round((detection.outline[:, 0].max() + 2.0) * scale)
        x = right if right + text_width(text, 0.5) < canvas.shape[1] else centre[0] - text_width(text, 0.5)
        cv2.drawMarker(canvas, centre, _SHADOW, cv2.MARKER_CROSS, 13, 3)
        cv2.drawMarker(canvas, centre, _FOUND, cv2.MARKER_CROSS, 11, 1)
        place = (slice(max(centre[1] - 10, 0), centre[1] + 10), slice(max(x - 3, 0), x + text_width(text, 0.5) + 3))
        canvas[place] //= 3
        write(canvas, text, (x, centre[1] + 5), 0.5, _LEARNT)
    return canvas


def _mask_tile(
    images: Sequence[ImageArray],
    titles: Sequence[str],
    result: ColorCalibration,
    tables: Sequence[ColorTable],
    name: str,
) -> ImageArray:
    """Show what a marker's colour takes in, in the first picture that it was learnt from."""
    number = next(n for n, regions in enumerate(result.regions) if name in regions)
    image = images[number]
    table = tables[number]
    mask = table.classify(image)[0] == table.names.index(name) + 1
    dim = 6
    canvas = image // dim
    canvas[mask] = image[mask]
    width = _WIDTH // min(_MASK_COLUMNS, len(result.markers))
    height = round(width * image.shape[0] / image.shape[1])
    small = np.asarray(cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    quality = result.markers[name]
    # In whole pixels of the picture: a share of a large surroundings says nothing to a person.
    stray = quality.false_share * result.pixels.others_area / result.pixels.pictures
    title = f"{name}: {100 * quality.recovered:.0f} % kept, {stray:.0f} px elsewhere"
    return _titled(small, title + (f" ({titles[number]})" if number else ""))


def _titled(picture: ImageArray, title: str) -> ImageArray:
    heading = 26
    bar = np.full((heading, picture.shape[1], 3), PAPER, np.uint8)
    write(bar, title, (8, 18), 0.45, INK)
    return np.concatenate([bar, picture])


def _remarks(lines: Sequence[str], width: int) -> ImageArray:
    wrapped: list[str] = []
    for line in lines:
        words, current = line.split(), ""
        for word in words:
            if current and text_width(f"{current} {word}") > width - 24:
                wrapped.append(current)
                current = "   " + word
            else:
                current = f"{current} {word}" if current else word
        wrapped.append(current)
    canvas = np.full((18 * len(wrapped) + 12, width, 3), PAPER, np.uint8)
    for number, line in enumerate(wrapped):
        write(canvas, line, (8, 18 * number + 18))
    return canvas


def _padded(picture: ImageArray, width: int, height: int = 0) -> ImageArray:
    missing = (max(0, height - picture.shape[0]), max(0, width - picture.shape[1]))
    return np.pad(picture, ((0, missing[0]), (0, missing[1]), (0, 0)), constant_values=255)


def _stacked(*pictures: ImageArray) -> ImageArray:
    width = max(picture.shape[1] for picture in pictures)
    return np.concatenate([_padded(picture, width) for picture in pictures])


def _tiled(pictures: Sequence[ImageArray], columns: int) -> ImageArray:
    rows = []
    for start in range(0, len(pictures), columns):
        row = pictures[start : start + columns]
        height = max(picture.shape[0] for picture in row)
        rows.append(np.concatenate([_padded(picture, picture.shape[1], height) for picture in row], axis=1))
    return _stacked(*rows)
