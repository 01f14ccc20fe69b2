"""`rhot calibrate colors`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import click
import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from rhot.errors import ConfigError
from rhot.rig import Rig, load_rig, write_json_model
from rhot_capture.color_calibration import ColorCalibration, calibrate
from rhot_capture.color_table import ImageArray, build_color_table
from rhot_capture.detector import Detection, MarkerDetector
from rhot_capture.preview import preview_jpeg

_NUMBER: Final = r"\s*([-+]?\d+(?:\.\d+)?)\s*"
_PICK: Final = re.compile(rf"([^=]+)={_NUMBER},{_NUMBER}(?:@\s*(\d+)\s*)?")


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--pick",
    "picks",
    multiple=True,
    required=True,
    metavar="NAME=U,V[@N]",
    help="A place on a marker, pixels from the upper left; @2 picks in the second image. Repeat for each marker.",
)
@click.option(
    "--rig",
    "rig_path",
    required=True,
    type=click.Path(path_type=Path),
    help="Rig folder; colors.json is written into it.",
)
@click.option(
    "--preview",
    "preview_path",
    type=click.Path(path_type=Path),
    help="Write the first image with what is found in it as a JPEG.",
)
def colors(images: tuple[Path, ...], picks: tuple[str, ...], rig_path: Path, preview_path: Path | None) -> None:
    """Learn the markers' colours from pictures of the painted hand.

    \b
    rhot calibrate colors hand.jpg --pick thumb=281,215 --pick index=250,290 --rig myrig
    rhot calibrate colors bright.jpg dark.jpg --pick thumb=281,215 --pick thumb=300,220@2 --rig myrig

    Take the pictures with the tracker's own cameras, locked as they will run:
    rhot get --raw 'rhot/preview/left' > hand.jpg. One picture per camera and light makes the colours robust. A marker
    without a pick gets no colour and is never reported.
    """  # noqa: D301
    rig = load_rig(rig_path)
    pictures = [_read(path) for path in images]
    chosen = parse_picks(picks, images)
    with Console(stderr=True).status(f"learning colours from {len(pictures)} picture(s)"):
        result = calibrate(pictures, chosen, rig.config.markers)
        write_json_model(rig.colors_path, result.colors)
        detections = [_detect(rig, result, picture) for picture in pictures]
    _report(result, images, detections, rig.colors_path)
    if preview_path is not None:
        try:
            preview_path.write_bytes(preview_jpeg(pictures[0], detections[0]))
        except OSError as error:
            raise ConfigError(f"{preview_path}: cannot be written: {error.strerror or error}") from error


def parse_picks(picks: Sequence[str], images: Sequence[Path]) -> list[dict[str, tuple[float, float]]]:
    """Return for each image the picks in it: marker name to (u, v), pixels.

    Args:
        picks: `NAME=U,V` for the first image, `NAME=U,V@N` for the N-th, counted from 1.
        images: the images.

    Raises:
        ConfigError: not of that form, a number without an image, or a marker picked twice in one image.
    """
    chosen: list[dict[str, tuple[float, float]]] = [{} for _ in images]
    for pick in picks:
        match = _PICK.fullmatch(pick)
        if match is None:
            raise ConfigError(f"--pick {pick}: not NAME=U,V or NAME=U,V@N, such as thumb=281,215 or thumb=281,215@2")
        name, u, v, number = match[1].strip(), float(match[2]), float(match[3]), int(match[4] or 1)
        if not 1 <= number <= len(images):
            raise ConfigError(f"--pick {pick}: there is no image {number}; {len(images)} given")
        if name in chosen[number - 1]:
            raise ConfigError(f"--pick {pick}: {name} is picked twice in {images[number - 1]}; keep one")
        chosen[number - 1][name] = (u, v)
    return chosen


def _read(path: Path) -> ImageArray:
    if not path.is_file():
        raise ConfigError(f"{path}: no such image")
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ConfigError(f"{path}: not an image that OpenCV can read (JPEG or PNG)")
    return np.asarray(image, dtype=np.uint8)


def _detect(rig: Rig, result: ColorCalibration, picture: ImageArray) -> dict[str, Detection]:
    names = list(rig.config.markers)
    detector = MarkerDetector(
        rig.config.markers, build_color_table(result.colors, names), picture.shape[1], picture.shape[0]
    )
    return detector.detect(picture)


def _report(
    result: ColorCalibration, images: Sequence[Path], detections: Sequence[dict[str, Detection]], written: Path
) -> None:
    console = Console()
    table = Table(title="Colours found", title_justify="left")
    several = len(images) > 1
    table.add_column("marker")
    if several:
        table.add_column("image")
    for heading in ("u", "v", "area px", "score", "kept"):
        table.add_column(heading, justify="right")
    table.add_column("most like")
    table.add_column("mixed up", justify="right")
    for name, quality in result.markers.items():
        for path, found in zip(images, detections, strict=True):
            detection = found.get(name)
            place = (
                ("-", "-", "-", "not seen")
                if detection is None
                else (f"{detection.u:.1f}", f"{detection.v:.1f}", f"{detection.area:.0f}", f"{detection.score:.2f}")
            )
            kept, mixed = f"{100 * quality.recovered:.0f} %", f"< {100 * quality.confusion:.1f} %"
            label = (name, path.name) if several else (name,)
            table.add_row(*label, *place, kept, quality.nearest or "-", mixed if quality.nearest else "-")
    console.print(table)
    for first, second, bound in result.confusable:
        console.print(
            f"warning: {first} and {second} may be mixed up (up to {100 * bound:.0f} % of pixels); choose paints that "
            "differ more in hue, or give picks in more pictures",
            style="yellow",
        )
    console.print(f"{written} written; look at it live with `rhot get --raw 'rhot/preview/<camera>?overlay=markers'`")
