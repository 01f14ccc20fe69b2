"""`rhot evaluate pictures`: photo-real pictures of a stranger's rig, from calibration to the scored hand."""

from __future__ import annotations

import csv
import gzip
import io
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import click
import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from rhot.cli.options import FiniteRange
from rhot.messages import MarkerFrame, Side
from rhot.offline import track, track_smoothly
from rhot.recording import load_recording
from rhot.recording.picture_file import read_picture
from rhot.rig import Rig
from rhot_bench.motion.references.plain_ekf import plain_ekf
from rhot_bench.motion.references.spline_reference import spline_reference, views_of
from rhot_bench.pictures.rendered import (
    BOARDS,
    CAMERAS,
    COLOURS,
    SEQUENCES,
    Measures,
    at_rate_of,
    found_markers,
    prepare_rig,
    require_pictures,
)
from rhot_bench.pictures.scoring import Score, score_estimates, score_messages
from rhot_tools.measures.output import counted, json_option, show
from rhot_tools.measures.rows import Row, Section, check_output

# The rendered pictures made into other worlds: mirrored, smaller, half as often, paler, with another light.
#
# What was built while looking at one set of pictures may hold for that one alone. A changed copy is another rig: it is
# calibrated from its own chessboards and colours, and its truth is changed alike, so that the scorer beside it
# judges it as it judges the pictures themselves.

Image = NDArray[np.uint8]

_JPEG_QUALITY: Final = 95
"""That of the pictures themselves, by their README."""


def _as_it_is(image: Image) -> Image:
    return image


@dataclass(frozen=True, slots=True)
class Change:
    """What a changed copy differs by.

    Attributes:
        about: for people.
        scale: side of a picture, times that of the original.
        mirrored: left and right change places, in the picture and in the world: a left hand.
        every: every so manieth picture of a sequence is kept.
        picture: changes colours or sharpness of a picture.
        right_picture: the same for the right camera, where that differs.
        keeps_calibration: chessboards and colour reference stay as they are: the light changes after the calibration.
    """

    about: str
    scale: float = 1.0
    mirrored: bool = False
    every: int = 1
    picture: Callable[[Image], Image] = _as_it_is
    right_picture: Callable[[Image], Image] | None = None
    keeps_calibration: bool = False

    def of(self, sequence: str, camera: str) -> Callable[[Image], Image]:
        """Return what changes the pictures of a camera in a sequence."""
        if self.keeps_calibration and sequence not in SEQUENCES:
            return _as_it_is
        return self.right_picture if self.right_picture is not None and camera == CAMERAS[1] else self.picture


def _gained(blue: float, green: float, red: float) -> Callable[[Image], Image]:
    def gained(image: Image) -> Image:
        return _rounded(image.astype(np.float32) * np.array([blue, green, red], np.float32))

    return gained


def _pale(image: Image) -> Image:
    colours = image.astype(np.float32)
    return _rounded(0.55 * colours + 0.45 * colours.mean(axis=2, keepdims=True))


def _blurred(image: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.2), dtype=np.uint8)


def _compressed(image: Image) -> Image:
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)


def _noisy(image: Image) -> Image:
    """Return a picture with the noise of a small sensor in poor light: 3 grey levels in black, 10 in white."""
    rng = np.random.default_rng(int(image[::7, ::7].sum()))
    deviation = np.sqrt(3.0**2 + 0.35 * image)
    return _rounded((image + deviation * rng.standard_normal(image.shape)).astype(np.float32))


def _rounded(image: NDArray[np.float32]) -> Image:
    return np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)


CHANGES: Final[Mapping[str, Change]] = {
    "mirrored": Change("a left hand, with the cameras exchanged", mirrored=True),
    "smaller": Change("three quarters of the size", scale=0.75),
    "larger": Change("one and a half times the size", scale=1.5),
    "half-rate": Change("every second picture", every=2),
    "blurred": Change("out of focus, by 1.2 px", picture=_blurred),
    "pale": Change("paint and skin of about half the saturation", picture=_pale),
    "warm": Change("evening light, red x 1.25, blue x 0.75", picture=_gained(0.75, 0.95, 1.25)),
    "dark": Change("half the light", picture=_gained(0.5, 0.5, 0.5)),
    "overexposed": Change("1.45 times the light, clipped at white", picture=_gained(1.45, 1.45, 1.45)),
    "compressed": Change("JPEG quality 60", picture=_compressed),
    "noisy": Change("noise of a small sensor in poor light", picture=_noisy),
    "unbalanced": Change(
        "cameras with different white balance",
        picture=_gained(0.8, 1.0, 1.15),
        right_picture=_gained(1.15, 1.0, 0.85),
    ),
    "later": Change(
        "a third less light than at the calibration, and warmer",
        picture=_gained(0.6, 0.66, 0.75),
        keeps_calibration=True,
    ),
    **{
        f"{what}{percent:+d}": Change(
            f"{what} {percent:+d} % since the calibration",
            picture=_gained(*(1.0 + 0.01 * percent * share for share in shares)),
            keeps_calibration=True,
        )
        for what, shares, percents in (
            ("brightness", (1.0, 1.0, 1.0), (-40, -20, 20, 40)),
            ("colour", (-1.0, 0.0, 1.0), (-30, -20, -10, 10, 20, 30)),
        )
        for percent in percents
    },
}


def changed_copy(data: Path, name: str, folder: Path, advance: Callable[[], None] = lambda: None) -> Path:
    """Write a changed copy of the rendered pictures and of their truth; one that is whole already stays.

    Args:
        data: the rendered pictures.
        name: of the change, one of `CHANGES`.
        folder: of the copy.
        advance: called after each picture.

    Raises:
        ConfigError: a picture cannot be read.
    """
    change = CHANGES[name]
    if (folder / "score.py").exists():
        return folder
    calibration = json.loads((data / "calib.json").read_text(encoding="utf-8"))
    width, height = calibration["image_size"]
    pixels = _Pixels(width, height, round(change.scale * width), round(change.scale * height), change.mirrored)
    for sequence in (BOARDS, COLOURS, *SEQUENCES):
        every = change.every if sequence in SEQUENCES else 1
        for camera in CAMERAS:
            changed = change.of(sequence, camera)
            _copy_pictures(data / sequence / camera, folder / sequence / camera, changed, pixels, every, advance)
        shutil.copy(data / sequence / "recording.toml", folder / sequence)
        if sequence != BOARDS:
            _copy_frames(data / sequence, folder / sequence, pixels, every)
            _copy_motion(data / sequence, folder / sequence, change.mirrored)
    boxes = json.loads((data / COLOURS / "boxes.json").read_text(encoding="utf-8"))
    for camera in boxes["cameras"].values():
        for marker in camera.values():
            marker["box"] = pixels.box(*marker["box"])
    (folder / COLOURS / "boxes.json").write_text(json.dumps(boxes), encoding="utf-8")
    (folder / "calib.json").write_text(json.dumps(_changed_cameras(calibration, pixels)), encoding="utf-8")
    shutil.copy(data / "hand.json", folder)
    # Last: by it a copy that was interrupted is known.
    shutil.copy(data / "score.py", folder)
    return folder


@dataclass(frozen=True, slots=True)
class _Pixels:
    """Where pixels of the original lie in the copy; pixel centres on integers."""

    old_width: int
    old_height: int
    width: int
    height: int
    mirrored: bool

    @property
    def scales(self) -> tuple[float, float]:
        return self.width / self.old_width, self.height / self.old_height

    def u(self, u: float) -> float:
        scaled = (u + 0.5) * self.scales[0] - 0.5
        return self.width - 1 - scaled if self.mirrored else scaled

    def v(self, v: float) -> float:
        return (v + 0.5) * self.scales[1] - 0.5

    def box(self, left: float, top: float, right: float, bottom: float) -> list[float]:
        """Return a box whose edges are given in pixel edges: pixel i spans i to i + 1."""
        across, down = self.scales
        sides = sorted((self.width - across * x if self.mirrored else across * x) for x in (left, right))
        return [sides[0], down * top, sides[1], down * bottom]

    def image(self, image: Image) -> Image:
        if (self.width, self.height) != (self.old_width, self.old_height):
            method = cv2.INTER_AREA if self.width < self.old_width else cv2.INTER_CUBIC
            image = np.asarray(cv2.resize(image, (self.width, self.height), interpolation=method), dtype=np.uint8)
        return np.ascontiguousarray(image[:, ::-1]) if self.mirrored else image


def _copy_pictures(
    source: Path,
    folder: Path,
    changed: Callable[[Image], Image],
    pixels: _Pixels,
    every: int,
    advance: Callable[[], None],
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    head, *rows = (source / "timestamps.csv").read_text(encoding="utf-8").split()
    kept = [head]
    for row in rows:
        number = int(row.partition(",")[0])
        if number % every == 0:
            name = f"{number:06d}.jpg"
            image = changed(pixels.image(read_picture(source / name)))
            cv2.imwrite(str(folder / name), image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            kept.append(row)
        advance()
    (folder / "timestamps.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")


def _copy_frames(source: Path, folder: Path, pixels: _Pixels, every: int) -> None:
    """Copy the truth of each picture."""
    across, down = pixels.scales

    def changed(row: dict[str, str]) -> dict[str, str]:
        for key, move in (("u", pixels.u), ("vis_u", pixels.u), ("v", pixels.v), ("vis_v", pixels.v)):
            row[key] = row[key] and f"{move(float(row[key])):.3f}"
        row["visible_px"] = f"{float(row['visible_px']) * across * down:.2f}"
        if pixels.mirrored:
            row["x"] = f"{-float(row['x']):.3f}"
        return row

    with (source / "truth_frames.csv").open(encoding="utf-8") as lines:
        rows = [changed(row) for row in csv.DictReader(lines) if int(row["frame"]) % every == 0]
    (folder / "truth_frames.csv").write_text(_csv(rows), encoding="utf-8")


def _copy_motion(source: Path, folder: Path, mirrored: bool) -> None:
    """Copy the continuous truth; the scorer reads positions of it, and no rotation."""
    with gzip.open(source / "truth_500hz.csv.gz", "rt", encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    if mirrored:
        for row in rows:
            for key in row:
                if key.endswith("_x"):
                    row[key] = f"{-float(row[key]):.3f}"
    with gzip.open(folder / "truth_500hz.csv.gz", "wt", encoding="utf-8") as file:
        file.write(_csv(rows))


def _csv(rows: list[dict[str, str]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0])
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _changed_cameras(calibration: dict[str, Any], pixels: _Pixels) -> dict[str, Any]:
    """Return `calib.json` of the copy: mirrored by x alone, rotations stay rotations and lenses turn p2 about."""
    across, down = pixels.scales
    calibration["image_size"] = [pixels.width, pixels.height]
    for name in CAMERAS:
        K = calibration[name]["K"]
        K[0][0], K[0][2] = K[0][0] * across, pixels.u(K[0][2])
        K[1][1], K[1][2] = K[1][1] * down, pixels.v(K[1][2])
        if pixels.mirrored:
            calibration[name]["D"][3] *= -1.0
    if pixels.mirrored:
        flip = np.diag([-1.0, 1.0, 1.0])
        calibration["R"] = (flip @ np.array(calibration["R"]) @ flip).tolist()
        for key in ("T", "right_camera_centre_in_left_frame"):
            calibration[key] = (flip @ np.array(calibration[key]).ravel()).tolist()
    return calibration


@dataclass(frozen=True, slots=True)
class Targets:
    """Targets of one sequence: most millimetres, least coverage in percent.

    Attributes:
        live_mm, smooth_mm: median and p95 after one constant offset per marker.
        raw_mm: median, nothing removed.
        joints_mm: mean.
        live_coverage, smooth_coverage: percent.
    """

    live_mm: tuple[float, float]
    smooth_mm: tuple[float, float]
    joints_mm: float
    raw_mm: float = 2.0
    live_coverage: float = 95.0
    smooth_coverage: float = 98.0


_TARGETS: Final = {
    "G1": Targets((1.4, 6.0), (1.0, 5.5), 6.0),
    "G2": Targets((2.2, 7.0), (1.6, 6.0), 9.0),
}
_TITLES: Final = {"G1": "gestures", "G2": "a grasp"}
_OFFSET: Final = "after one constant offset per marker, along its bone and along the viewing ray"
_TIPS: Final = "the set's tips are the ends of the fingers; ours lie one radius inside, as OpenXR has them"


@click.command()
@click.argument("data_path", metavar="DATA", type=click.Path(path_type=Path))
@click.option(
    "--keep",
    "keep_path",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for the calibrated rig and the detected markers. A later run with the same folder uses them again and "
    "takes seconds. Delete it after changes to detection or calibration.",
)
@click.option(
    "--changed",
    "change",
    type=click.Choice(list(CHANGES)),
    help="Evaluate a changed copy of the pictures, with its own calibration: "
    + "; ".join(f"{name}: {change.about}" for name, change in CHANGES.items())
    + ".",
)
@click.option(
    "--width-mm",
    type=FiniteRange(40.0, 130.0),
    help="Width of the hand across the knuckles, measured with a ruler; DATA states only its length.  [default: 74 for "
    "a hand of 172, and in proportion]",
)
@click.option("--left", "is_left", is_flag=True, help="The pictures show a left hand.")
@json_option
def pictures(
    data_path: Path,
    keep_path: Path | None,
    change: str | None,
    width_mm: float | None,
    is_left: bool,
    json_path: Path | None,
) -> None:
    """Track photo-real pictures of another rig and hand, and compare with their ground truth.

    DATA is the folder of the rendered pictures, or its parent. Cameras and colours are calibrated with `rhot calibrate`
    from its chessboards and colour reference, the hand by two ruler measurements. Two references run on the same
    detections for comparison: a plain Kalman filter per marker (causal) and a cubic spline per camera and marker
    (offline). The errors are computed by the scorer in DATA.
    """
    check_output("--json", json_path)
    data = require_pictures(data_path)
    with ExitStack() as stack:
        keep = keep_path or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rhot-pictures-")))
        keep.mkdir(parents=True, exist_ok=True)
        progress = stack.enter_context(counted(Console(stderr=True, soft_wrap=True)))
        if change is not None:
            keep = keep / change
            task = progress.add_task("changing the pictures", total=len(list(data.glob("*/*/*.jpg"))))
            data = changed_copy(data, change, keep / "pictures", partial(progress.advance, task))
        mirrored = change is not None and CHANGES[change].mirrored
        side: Side = "left" if is_left != mirrored else "right"
        width_m = None if width_mm is None else 1e-3 * width_mm
        measures = Measures.of(data, width_m=width_m, side=side)
        task = progress.add_task("calibrating the rig", total=None)
        rig = prepare_rig(data, keep / "rig", measures)
        progress.remove_task(task)
        sections = []
        for name in SEQUENCES:
            recording = load_recording(data / name)
            total = sum(len(track.t_ns) for track in recording.cameras.values())
            task = progress.add_task(f"finding markers, {name}", total=total)
            frames = found_markers(rig, data, name, keep, partial(progress.advance, task))
            task = progress.add_task(f"tracking, {name}", total=4)
            timed = at_rate_of(rig, recording)
            scores = score_sequence(data, name, timed, frames, partial(progress.advance, task))
            rate_hz = next(iter(timed.config.cameras.values())).rate_hz
            title = f"{name}, {_TITLES[name]} at {rate_hz:.0f} fps{'' if change is None else f', {change}'}"
            sections.append(Section(title, _rows(_TARGETS[name], scores)))
    show("evaluate pictures", sections, json_path)


def score_sequence(
    data: Path, name: str, rig: Rig, frames: list[MarkerFrame], advance: Callable[[], None] = lambda: None
) -> dict[str, Score]:
    """Return the scores of one sequence: `live`, `smooth`, and the references `ekf` and `spline`.

    Args:
        data: the rendered pictures.
        name: of the sequence.
        rig: calibrated, at the sequence's rate.
        frames: markers found in its pictures.
        advance: called after each of the four.
    """
    names = list(rig.config.markers)
    views = views_of(frames, rig)
    steps: dict[str, Callable[[], Score]] = {
        "live": lambda: score_messages(data, name, track(rig, iter(frames))),
        "smooth": lambda: score_messages(data, name, track_smoothly(rig, iter(frames))),
        "ekf": lambda: score_estimates(data, name, plain_ekf(views, len(frames), len(names)), names),
        "spline": lambda: score_estimates(data, name, spline_reference(views, len(names)), names),
    }
    scores = {}
    for step, make in steps.items():
        scores[step] = make()
        advance()
    return scores


def _rows(targets: Targets, scores: dict[str, Score]) -> tuple[Row, ...]:
    rows: list[Row] = []
    for step, limit, coverage in (
        ("live", targets.live_mm, targets.live_coverage),
        ("smooth", targets.smooth_mm, targets.smooth_coverage),
    ):
        score, beside = scores[step], scores["ekf" if step == "live" else "spline"]
        other = "plain EKF" if step == "live" else "spline"

        def peer(value: float, unit: str = "mm", other: str = other) -> str:
            return f"{other}: {value:.2f} {unit}"

        rows += [
            Row(f"{step}, median", score.median_mm, "mm", most=limit[0], peer=peer(beside.median_mm), note=_OFFSET),
            Row(f"{step}, p95", score.p95_mm, "mm", most=limit[1], peer=peer(beside.p95_mm), note=_OFFSET),
            Row(
                f"{step}, nothing removed, median",
                score.raw_median_mm,
                "mm",
                most=targets.raw_mm,
                peer=peer(beside.raw_median_mm),
            ),
            Row(f"{step}, nothing removed, p95", score.raw_p95_mm, "mm", peer=peer(beside.raw_p95_mm)),
            Row(f"{step}, joints, mean", score.joints_mm, "mm", most=targets.joints_mm, note=_TIPS),
            Row(f"{step}, coverage", score.coverage, "%", least=coverage, peer=peer(beside.coverage, "%")),
            Row(f"{step}, wrong identity", score.swaps, most=0),
            Row(f"{step}, hallucinations", score.hallucinations, most=0),
            Row(f"{step}, told as measured with one view, median", score.one_view_median_mm, "mm"),
            Row(f"{step}, told as measured with one view, p95", score.one_view_p95_mm, "mm"),
            Row(f"{step}, told as seen by one camera, median", score.lone_median_mm, "mm"),
            Row(f"{step}, told as seen by one camera, p95", score.lone_p95_mm, "mm"),
        ]
    return tuple(rows)
