"""`rhot calibrate colors`."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import click
import cv2
from rich.console import Console

from rhot.anatomy.markers import own_paints
from rhot.arrays import ImageArray
from rhot.atomic_file import write_atomic
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.errors import CalibrationError, ConfigError
from rhot.recording.picture_file import read_picture
from rhot.rig import Rig, load_rig
from rhot.rig.calibration import today
from rhot.rig.colors import ColorsFile
from rhot_calibration.colors.import_2018 import load_box_calibration, load_camera_settings, rig_lines
from rhot_calibration.colors.learning import learn_colors, live_pictures
from rhot_calibration.colors.picking.picks import parse_places
from rhot_calibration.colors.report.picture import confusion_table, marker_table, report_picture
from rhot_calibration.options import live_option
from rhot_calibration.picture_light import BLACK, PictureLight
from rhot_calibration.writing import write_found
from rhot_capture.preview import preview_jpeg

_PICTURES: Final = (".png", ".jpg", ".jpeg")
_MOST_PIXELS: Final = 16_000_000
"""A phone's; colours are learnt from every pixel."""


@click.command()
@click.argument("images", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--pick",
    "picks",
    multiple=True,
    metavar="NAME=U,V[@PICTURE]",
    help="A point on a marker, in pixels from the upper left. Repeat for each marker.",
)
@click.option(
    "--box",
    "boxes",
    multiple=True,
    metavar="NAME=U,V,W,H[@PICTURE]",
    help="A rectangle around a marker: upper left corner and size, pixels. Some surroundings in it do no harm.",
)
@live_option("Take the pictures from the running capture services, one per camera.")
@click.option(
    "--save",
    "save_path",
    type=click.Path(path_type=Path, file_okay=False),
    help="Keep the pictures of --live in this folder; without picks that is all that happens.",
)
@rig_option
@click.option(
    "--report",
    "report_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write a picture (PNG or JPEG) of what each colour takes in and how far the colours lie apart.",
)
@click.option(
    "--preview",
    "preview_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write the first picture with what is found in it as a JPEG.",
)
@click.option(
    "--import",
    "import_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Take the colours from a colorCalibration.json of the 2018 tracker; no pictures are needed.",
)
@click.option(
    "--camera-settings",
    "settings_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="With --import: print the settings in its cameraCalib.json as lines for rig.toml.",
)
@bus_options
def colors(
    images: tuple[Path, ...],
    picks: tuple[str, ...],
    boxes: tuple[str, ...],
    live: bool,
    save_path: Path | None,
    rig_path: Path,
    report_path: Path | None,
    preview_path: Path | None,
    import_path: Path | None,
    settings_path: Path | None,
    connect: tuple[str, ...],
    namespace: str | None,
) -> None:
    """Learn the markers' colours from pictures of the painted hand.

    \b
    From pictures; @2 or @bright says which one, the first needs none:
      rhot calibrate colors hand.jpg --pick thumb=281,215 --box index=240,275,21,33 --rig myrig
      rhot calibrate colors dark.jpg bright.jpg --pick thumb=281,215 --pick thumb=300,220@bright --rig myrig
    From the running rig; hold the hand still between the two calls:
      rhot calibrate colors --live --save pictures --rig myrig
      rhot calibrate colors pictures/left.png pictures/right.png --pick thumb=281,215@left … --rig myrig
    From the files of the 2018 tracker:
      rhot calibrate colors --import colorCalibration.json --camera-settings cameraCalib.json --rig myrig

    Any image viewer shows the pixel under the mouse. Take the pictures with the tracker's own cameras, locked as they
    will run; one picture per camera and light makes the colours robust. Pictures named for a camera, or in a folder
    named for one (left.png, left/000000.jpg), let cameras differ in white balance and exposure. A marker that is not
    shown gets no colour and is never reported.

    Writes colors.json; the previous file is kept as colors.previous.json. Two tables show how well the colours can be
    distinguished: each marker's most similar other one, and the confusion matrix of all classes. Pairs that will be
    confused are listed, with a better paint.
    """
    _check_options(images, picks, boxes, live, save_path, import_path, settings_path)
    for path, suffixes in ((report_path, _PICTURES), (preview_path, (".jpg", ".jpeg"))):
        _check_target(path, suffixes)
    rig = load_rig(rig_path)
    if import_path is not None:
        _import(rig, import_path, settings_path)
        return
    titles, pictures = _live(rig, connect, namespace, save_path) if live else _read_all(images)
    console = Console()
    # Before anything is learnt: bad light may be why nothing can be.
    for remark in _light_remarks(titles, pictures):
        console.print(remark, style="yellow", markup=False, highlight=False, soft_wrap=True)
    cameras = titles if live else [_camera_of(path, rig) for path in images]
    if live and not picks and not boxes:
        return
    places = parse_places(picks, boxes, titles)
    with Console(stderr=True).status(f"learning colours from {len(pictures)} picture(s)"):
        learnt = learn_colors(pictures, places, rig.config.markers, cameras=cameras)
    result, detections = learnt.calibration, learnt.detections
    remarks = [*learnt.warnings, *learnt.suggestions]
    console.print(marker_table(result, titles, detections))
    console.print(confusion_table(result.separability))
    for remark in remarks:
        console.print(remark, style="yellow" if remark.startswith("warning") else "cyan", markup=False, highlight=False)
    if report_path is not None:
        _write_image(report_path, report_picture(pictures, titles, result, learnt.tables, detections, remarks))
    if preview_path is not None:
        write_atomic(preview_path, preview_jpeg(pictures[0], detections[0]))
    _write(console, rig, result.colors)


def _check_options(
    images: Sequence[Path],
    picks: Sequence[str],
    boxes: Sequence[str],
    live: bool,
    save_path: Path | None,
    import_path: Path | None,
    settings_path: Path | None,
) -> None:
    sources = [name for name, given in (("pictures", images), ("--live", live), ("--import", import_path)) if given]
    if len(sources) != 1:
        raise ConfigError(
            "no pictures: name some, or use --live with a running rig or --import with a file of the 2018 tracker"
            if not sources
            else f"{' and '.join(sources)} exclude each other; use one"
        )
    if import_path is not None and (picks or boxes):
        raise ConfigError("--pick and --box need pictures; --import brings finished colours")
    if settings_path is not None and import_path is None:
        raise ConfigError("--camera-settings goes with --import colorCalibration.json")
    if save_path is not None and not live:
        raise ConfigError("--save goes with --live: other pictures are files already")
    if live and not (picks or boxes or save_path):
        raise ConfigError(
            "--live without --pick or --box: look at the pictures first, `--live --save pictures` writes them there"
        )


def _live(
    rig: Rig, connect: tuple[str, ...], namespace: str | None, save_path: Path | None
) -> tuple[list[str], list[ImageArray]]:
    bus = tool_bus(rig.path, connect, namespace)
    pictures = asyncio.run(live_pictures(bus, list(rig.config.cameras)))
    if save_path is not None:
        try:
            save_path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{save_path}: cannot be made: {error.strerror or error}") from error
        for camera, picture in pictures.items():
            _write_image(save_path / f"{camera}.png", picture)
        files = " ".join(str(save_path / f"{camera}.png") for camera in pictures)
        click.echo(f"pictures written: {files}\nlearn from them with --pick NAME=U,V@{next(iter(pictures))} and so on")
    return list(pictures), list(pictures.values())


def _read_all(paths: Sequence[Path]) -> tuple[list[str], list[ImageArray]]:
    return [path.stem for path in paths], [read_picture(path) for path in paths]


def _light_remarks(titles: Sequence[str], pictures: Sequence[ImageArray]) -> list[str]:
    """Return warnings of pictures that are too dark or overexposed.

    Raises:
        CalibrationError: a picture is black, or larger than any camera of a rig takes it.
    """
    remarks = []
    for title, picture in zip(titles, pictures, strict=True):
        height, width = picture.shape[:2]
        if width * height > _MOST_PIXELS:
            raise CalibrationError(
                f"{title}: {width}x{height} pixels; take pictures with the tracker's own cameras, in the size they run "
                f"in (at most {_MOST_PIXELS / 1e6:g} megapixels)"
            )
        light = PictureLight.of(picture)
        if light.bright < BLACK:
            raise CalibrationError(
                f"{title}: the picture is black; is the lens covered, or the exposure far too short?"
            )
        if light.problem:
            remarks.append(f"warning: {title}: {light.problem}")
    return remarks


def _camera_of(path: Path, rig: Rig) -> str | None:
    """Return the camera that a picture is named for, or the folder that it lies in; None when that is none."""
    return next((name for name in (path.stem, path.absolute().parent.name) if name in rig.config.cameras), None)


def _check_target(path: Path | None, suffixes: Sequence[str]) -> None:
    """Refuse a picture that could not be written before any work is done."""
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise ConfigError(f"{path}: this picture is written as {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: cannot be written: there is no folder {path.parent}")


def _write_image(path: Path, picture: ImageArray) -> None:
    ok, data = cv2.imencode(path.suffix.lower(), picture)
    if not ok:
        raise ConfigError(f"{path}: a picture of {picture.shape[1]}x{picture.shape[0]} cannot be coded")
    write_atomic(path, bytes(data))


def _import(rig: Rig, import_path: Path, settings_path: Path | None) -> None:
    markers = list(own_paints(rig.config.markers))
    found = load_box_calibration(import_path, markers)
    settings = None if settings_path is None else load_camera_settings(settings_path)
    quality = {"source": f"imported from {import_path.name}"}
    click.echo(f"{', '.join(markers)}: in this order the colours of {import_path} were given to the rig's markers")
    if settings is not None:
        click.echo(
            f"\nfor {rig.path / 'rig.toml'}, which stays as it is:\n\n{rig_lines(settings, list(rig.config.cameras))}\n"
        )
        for remark in settings.remarks:
            click.echo(f"- {remark}")
    _write(Console(), rig, found.model_copy(update={"date": today(), "quality": quality}))


def _write(console: Console, rig: Rig, colors: ColorsFile) -> None:
    """Write `colors.json`, keep the one before as `colors.previous.json`, and say so."""
    missing = [name for name in own_paints(rig.config.markers) if name not in colors.markers]
    if missing:
        console.print(
            f"warning: no colour for {', '.join(missing)}, which will not be found; pick all markers, in one picture "
            "or in several",
            style="yellow",
            markup=False,
            highlight=False,
        )
    camera = next(iter(rig.config.cameras))
    write_found(
        console,
        rig.colors_path,
        colors,
        "Capture services that run on this folder take it over within a second; on a Pi copy it into the rig folder "
        f"there. Look with `rhot get --raw 'rhot/preview/{camera}?overlay=markers' > seen.jpg`",
    )
