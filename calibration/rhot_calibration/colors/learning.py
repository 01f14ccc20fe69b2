"""What the clicks so far give: colours, how well they do, and pictures that show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.calibration_step import Figures, Remark
from rhot.rig.colors import ColorsFile
from rhot.rig.config import MarkerConfig
from rhot_calibration.colors.calibration import ColorCalibration, calibrate
from rhot_calibration.colors.picking.clicks import ClickedPicture
from rhot_calibration.colors.picking.picks import Places
from rhot_calibration.colors.report.console import suggestions, warnings
from rhot_calibration.colors.report.picture import overlay_picture
from rhot_capture.detection.color_table import ColorTable, build_color_table
from rhot_capture.detection.detector import Detection, MarkerDetector
from rhot_capture.preview import preview_jpeg

_OVERLAY_WIDTH: Final = 480


@dataclass(frozen=True, slots=True)
class Learnt:
    """Colours and how they do.

    Attributes:
        colors: to be tried.
        remarks: what will be mixed up and what to do about it.
        table: how well each can be told apart.
        pictures: title to JPEG: what was learnt from and what is found, and what the colours take in.
    """

    colors: ColorsFile
    remarks: tuple[Remark, ...]
    table: Figures
    pictures: Mapping[str, bytes]


def learn(pictures: Sequence[ClickedPicture], places: Sequence[Places], markers: Mapping[str, MarkerConfig]) -> Learnt:
    """Learn colours from clicks.

    Args:
        pictures: with at least one click each.
        places: of each picture at the moment of asking; those of `pictures` may go on changing.
        markers: the rig's markers by name.

    Raises:
        CalibrationError: something cannot be learnt from; names marker and picture.
    """
    images = [each.image for each in pictures]
    result = calibrate(images, places, markers, lambda number: pictures[number].regions(places[number]))
    table = build_color_table(result.colors, list(markers))
    detections = [
        MarkerDetector(dict(markers), table, image.shape[1], image.shape[0]).detect(image) for image in images
    ]
    remarks = [Remark(line.removeprefix("warning: "), "warning") for line in warnings(result)]
    remarks += [Remark(line) for line in suggestions(result)]
    if not remarks:
        remarks = [Remark("The colours can be told apart.", "good")]
    for each, clicked, found in zip(pictures, places, detections, strict=True):
        unseen = [name for name in clicked if name not in found]
        if unseen:
            text = (
                f"{each.camera}: {', '.join(unseen)} clicked but not found by the tracker: is the paint large enough "
                "in the picture, and evenly lit?"
            )
            remarks.insert(0, Remark(text, "warning"))
    return Learnt(
        result.colors, tuple(remarks), _table(result, detections), _pictures(pictures, result, table, detections)
    )


def _pictures(
    pictures: Sequence[ClickedPicture],
    result: ColorCalibration,
    table: ColorTable,
    detections: Sequence[Mapping[str, Detection]],
) -> dict[str, bytes]:
    """Return pictures with what is found, and what all colours together take in, by title."""
    shown = {}
    cameras = len({each.camera for each in pictures})
    for number, (each, found) in enumerate(zip(pictures, detections, strict=True)):
        title = each.camera if number < cameras else f"{each.camera}, picture {number + 1}"
        overlay = overlay_picture(each.image, result, number, found, _OVERLAY_WIDTH)
        shown[f"{title}: white = learnt from, green = found"] = preview_jpeg(overlay)
        mask = np.where(table.classify(each.image)[0] > 0, 255, 0).astype(np.uint8)
        shown[f"{title}: what the colours take in"] = preview_jpeg(each.image, None, mask)
    return shown


def _table(result: ColorCalibration, detections: Sequence[Mapping[str, Detection]]) -> Figures:
    rows = []
    for name, quality in result.markers.items():
        nearest, mixed = result.separability.nearest(name)
        rows.append(
            (
                name,
                f"{sum(name in each for each in detections)} of {len(detections)}",
                f"{100 * quality.recovered:.0f} %",
                nearest or "-",
                f"{100 * mixed:.1f} %" if nearest else "-",
            )
        )
    return Figures("How well they can be told apart", ("marker", "found", "kept", "most like", "mixed up"), tuple(rows))
