"""Learning colours, for the command and for the page: fitted colours, what the tracker finds with them, advice."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rhot.anatomy.markers import own_paints
from rhot.arrays import BoolArray, ImageArray
from rhot.bus import CONNECT_S, Bus, Reply
from rhot.calibration_step import Figures, Remark
from rhot.errors import BusError, DeviceError
from rhot.recording.picture_file import decode_picture
from rhot.rig import BusConfig
from rhot.rig.colors import ColorsFile
from rhot.rig.config import MarkerConfig
from rhot_calibration.colors.calibration import ColorCalibration, calibrate
from rhot_calibration.colors.picking.clicks import ClickedPicture
from rhot_calibration.colors.picking.picks import Picks
from rhot_calibration.colors.report.picture import overlay_picture, suggestions, warnings
from rhot_capture.detection.color_table import ColorTable, camera_tables
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.result import Detection
from rhot_capture.preview import preview_jpeg

# Pictures from the cameras of a running rig, by the previews that its capture services answer with.


async def live_pictures(bus: BusConfig, cameras: Sequence[str]) -> dict[str, ImageArray]:
    """Return the newest picture of each camera, (H, W, 3) uint8 BGR.

    Raises:
        BusError: no router, or no capture service answers for a camera.
        DeviceError: a camera has no picture yet, or what came is none.
    """
    async with await Bus.open(bus, timeout_s=CONNECT_S) as session:
        # PNG where the service knows it; JPEG blurs colours over blocks of pixels.
        answer_timeout_s = 3.0
        return {
            camera: decoded(camera, await session.get(f"rhot/preview/{camera}?format=png", timeout_s=answer_timeout_s))
            for camera in cameras
        }


def decoded(camera: str, replies: Sequence[Reply]) -> ImageArray:
    """Return the picture in the answers to a preview query.

    Raises:
        BusError: there is no answer.
        DeviceError: only refusals, or bytes that are no picture.
    """
    if not replies:
        raise BusError(
            f"camera {camera}: no capture service answers; `rhot status` shows who is there, "
            f"`rhot capture --camera {camera}` starts one"
        )
    pictures = [reply for reply in replies if not reply.error]
    if not pictures:
        raise DeviceError(f"camera {camera}: {replies[0].error}")
    data = pictures[0].payload
    image = decode_picture(data)
    if image is None:
        raise DeviceError(
            f"camera {camera}: the preview is no picture but {len(data)} bytes of {pictures[0].encoding}; do the "
            "capture service and this program have the same version?"
        )
    return np.asarray(image, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class LearntColors:
    """Fitted colours and what the tracker makes of them.

    Attributes:
        calibration: the colours and their quality.
        tables: of the colours of all markers of the rig, in the balance of each picture's camera.
        detections: what the tracker finds in each picture with them.
        warnings: what will be mixed up.
        suggestions: what to do about it.
    """

    calibration: ColorCalibration
    tables: tuple[ColorTable, ...]
    detections: tuple[dict[str, Detection], ...]
    warnings: tuple[str, ...]
    suggestions: tuple[str, ...]


def learn_colors(
    images: Sequence[ImageArray],
    places: Sequence[Picks],
    markers: Mapping[str, MarkerConfig],
    region_of: Callable[[int], dict[str, BoolArray]] | None = None,
    cameras: Sequence[str | None] | None = None,
) -> LearntColors:
    """Fit colours and try them on the pictures that they were fitted to; arguments and errors as of `calibrate`."""
    cameras = cameras or [None] * len(images)
    result = calibrate(images, places, markers, region_of, cameras)
    by_camera = camera_tables(result.colors, list(own_paints(markers)), set(cameras))
    tables = tuple(by_camera[camera] for camera in cameras)
    detections = tuple(
        MarkerDetector(markers, table, image.shape[1], image.shape[0]).detect(image)
        for image, table in zip(images, tables, strict=True)
    )
    return LearntColors(result, tables, detections, tuple(warnings(result)), tuple(suggestions(result)))


@dataclass(frozen=True, slots=True)
class Learnt:
    """Colours as the page shows them.

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


def learn(pictures: Sequence[ClickedPicture], places: Sequence[Picks], markers: Mapping[str, MarkerConfig]) -> Learnt:
    """Learn colours from clicks.

    Args:
        pictures: with at least one click each.
        places: of each picture at the moment of asking; those of `pictures` may go on changing.
        markers: the rig's markers by name.

    Raises:
        CalibrationError: something cannot be learnt from; names marker and picture.
    """
    images = [each.image for each in pictures]
    learnt = learn_colors(
        images,
        places,
        markers,
        lambda number: pictures[number].regions(places[number]),
        [each.camera for each in pictures],
    )
    remarks = [Remark(line.removeprefix("warning: "), "warning") for line in learnt.warnings]
    remarks += [Remark(line) for line in learnt.suggestions]
    if not remarks:
        remarks = [Remark("The colours can be told apart.", "good")]
    for each, clicked, found in zip(pictures, places, learnt.detections, strict=True):
        unseen = [name for name in clicked if name not in found]
        if unseen:
            text = (
                f"{each.camera}: {', '.join(unseen)} clicked but not found by the tracker: is the paint large enough "
                "in the picture, and evenly lit?"
            )
            remarks.insert(0, Remark(text, "warning"))
    return Learnt(learnt.calibration.colors, tuple(remarks), _table(learnt), _pictures(pictures, learnt))


def _pictures(pictures: Sequence[ClickedPicture], learnt: LearntColors) -> dict[str, bytes]:
    """Return pictures with what is found, and what all colours together take in, by title."""
    shown = {}
    cameras = len({each.camera for each in pictures})
    for number, (each, found) in enumerate(zip(pictures, learnt.detections, strict=True)):
        title = each.camera if number < cameras else f"{each.camera}, picture {number + 1}"
        overlay_width = 480
        overlay = overlay_picture(each.image, learnt.calibration, number, found, overlay_width)
        shown[f"{title}: white = learnt from, green = found"] = preview_jpeg(overlay)
        mask = np.where(learnt.tables[number].classify(each.image)[0] > 0, 255, 0).astype(np.uint8)
        shown[f"{title}: what the colours take in"] = preview_jpeg(each.image, None, mask)
    return shown


def _table(learnt: LearntColors) -> Figures:
    result, detections = learnt.calibration, learnt.detections
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
