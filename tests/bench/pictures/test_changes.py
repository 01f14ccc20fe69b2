"""Changed copies of the rendered pictures: the truth of a copy is that of its pictures."""

from __future__ import annotations

import csv
import gzip
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rhot.rig import load_rig
from rhot_bench.pictures.command import CHANGES, changed_copy
from rhot_bench.pictures.rendered import Measures, write_rig

CALIBRATION = {
    "image_size": [640, 480],
    "left": {
        "K": [[524.6, 0.0, 313.85], [0.0, 523.9, 244.7], [0.0, 0.0, 1.0]],
        "D": [-0.06, 0.04, 0.0004, -0.0007, 0],
    },
    "right": {
        "K": [[533.2, 0.0, 327.4], [0.0, 532.7, 231.9], [0.0, 0.0, 1.0]],
        "D": [-0.05, 0.03, -0.0006, 0.0003, 0],
    },
    "R": cv2.Rodrigues(np.array([0.01, 0.1, 0.02]))[0].tolist(),
    "T": [-89.8, -1.6, 5.8],
    "right_camera_centre_in_left_frame": [89.9, 0.02, 3.2],
}
POINT = np.array([40.0, -60.0, 650.0])


def projected(calibration: dict[str, object], camera: str, point: np.ndarray) -> np.ndarray:
    lens = calibration[camera]
    assert isinstance(lens, dict)
    R, T = (np.eye(3), np.zeros(3)) if camera == "left" else (np.array(calibration["R"]), np.array(calibration["T"]))
    seen, _ = cv2.projectPoints(point, cv2.Rodrigues(R)[0], T, np.array(lens["K"]), np.array(lens["D"], np.float64))
    return np.asarray(seen, np.float64).ravel()


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """One moment of a set of pictures: a bright spot where `POINT` is seen."""
    folder = tmp_path / "data"
    for sequence in ("C", "K", "G1", "G2"):
        rows = []
        for camera in ("left", "right"):
            pictures = folder / sequence / camera
            pictures.mkdir(parents=True)
            u, v = projected(CALIBRATION, camera, POINT)
            y, x = np.indices((480, 640))
            spot = 255.0 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 50.0)
            image = np.repeat(spot[:, :, None], 3, axis=2).astype(np.uint8)
            for frame in range(2):
                cv2.imwrite(str(pictures / f"{frame:06d}.jpg"), image)
                rows.append([camera, frame, "index", 1000 + frame, u, v, *POINT, 1.0, 100.0, u, v])
            (pictures / "timestamps.csv").write_text("frame,t_ns\n0,1000\n1,1001\n")
        timing = "".join(f"[cameras.{name}]\nexposure_s = 0.005\nreadout_s = 0.014\n" for name in ("left", "right"))
        (folder / sequence / "recording.toml").write_text("version = 1\n" + timing)
        with (folder / sequence / "truth_frames.csv").open("w") as file:
            head = ["cam", "frame", "marker", "t_ns", "u", "v", "x", "y", "z", "visible_frac", "visible_px"]
            csv.writer(file).writerows([[*head, "vis_u", "vis_v"], *rows])
        with gzip.open(folder / sequence / "truth_500hz.csv.gz", "wt") as file:
            file.write("t_ns,index_x,index_y,index_z,hand_qx\n1000,40.0,-60.0,650.0,0.25\n")
    u, v = projected(CALIBRATION, "left", POINT)
    boxes = {"cameras": {"left": {"index": {"box": [u - 4.5, v - 2.5, u + 3.5, v + 1.5]}}}}
    (folder / "K" / "boxes.json").write_text(json.dumps(boxes))
    (folder / "calib.json").write_text(json.dumps(CALIBRATION))
    (folder / "hand.json").write_text("{}")
    (folder / "score.py").write_text("")
    return folder


@pytest.mark.parametrize("name", ["mirrored", "smaller", "larger"])
def test_picture_cameras_and_truth_of_a_copy_agree(data: Path, tmp_path: Path, name: str) -> None:
    copy = changed_copy(data, name, tmp_path / "copy")
    for camera in ("left", "right"):
        check_copy(copy, camera)


def check_copy(copy: Path, camera: str) -> None:
    """Check that the spot of a copy is where its truth and its cameras have it."""
    with (copy / "G1" / "truth_frames.csv").open() as lines:
        row = next(row for row in csv.DictReader(lines) if row["cam"] == camera)
    told = np.array([float(row["u"]), float(row["v"])])
    by_cameras = projected(
        json.loads((copy / "calib.json").read_text()), camera, np.array([float(row[axis]) for axis in "xyz"])
    )
    assert by_cameras == pytest.approx(told, abs=0.002)
    grey = np.asarray(cv2.imread(str(copy / "G1" / camera / "000000.jpg"), cv2.IMREAD_GRAYSCALE), np.float64)
    grey[grey < 8.0] = 0.0
    y, x = np.indices(grey.shape)
    assert [(grey * x).sum() / grey.sum(), (grey * y).sum() / grey.sum()] == pytest.approx(told, abs=0.1)


def test_a_mirrored_world_is_mirrored_everywhere(data: Path, tmp_path: Path) -> None:
    copy = changed_copy(data, "mirrored", tmp_path / "copy")
    with gzip.open(copy / "G1" / "truth_500hz.csv.gz", "rt") as lines:
        (row,) = csv.DictReader(lines)
    assert [float(row[f"index_{axis}"]) for axis in "xyz"] == [-40.0, -60.0, 650.0]
    assert row["hand_qx"] == "0.25"
    left, top, right, bottom = json.loads((copy / "K" / "boxes.json").read_text())["cameras"]["left"]["index"]["box"]
    u, v = projected(CALIBRATION, "left", POINT)
    assert [left, top, right, bottom] == pytest.approx([640 - u - 3.5, v - 2.5, 640 - u + 4.5, v + 1.5])
    # `rhot calibrate cameras` refuses cameras that do not stand as the rig says.
    measures = Measures(0.172, 0.074, (0.035, 0.025), (9, 6), 0.025, "left")
    for folder, sign in ((data, 1.0), (copy, -1.0)):
        rig = tmp_path / f"rig{sign}"
        rig.mkdir()
        write_rig(folder, rig, measures)
        assert sign * load_rig(rig).config.cameras["right"].position_m[0] > 0.0


def test_half_the_rate_keeps_every_second_picture_and_its_truth(data: Path, tmp_path: Path) -> None:
    copy = changed_copy(data, "half-rate", tmp_path / "copy")
    assert [path.name for path in (copy / "G2" / "left").glob("*.jpg")] == ["000000.jpg"]
    assert (copy / "G2" / "left" / "timestamps.csv").read_text().split() == ["frame,t_ns", "0,1000"]
    with (copy / "G2" / "truth_frames.csv").open() as lines:
        assert {row["frame"] for row in csv.DictReader(lines)} == {"0"}
    assert len(list((copy / "C" / "left").glob("*.jpg"))) == 2


@pytest.mark.parametrize("name", ["half-rate", "overexposed"])
def test_a_copy_is_another_picture_and_is_made_once(data: Path, tmp_path: Path, name: str) -> None:
    copy = changed_copy(data, name, tmp_path / "copy")
    made = (copy / "K" / "left" / "000000.jpg").read_bytes()
    if name != "half-rate":
        assert made != (data / "K" / "left" / "000000.jpg").read_bytes()
    (data / "K" / "left" / "000000.jpg").unlink()
    assert changed_copy(data, name, tmp_path / "copy") == copy


def test_each_change_of_colours_shows() -> None:
    image = np.random.default_rng(1).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    for name in ("blurred", "pale", "warm", "dark", "overexposed", "compressed", "noisy"):
        changed = CHANGES[name].picture(image)
        assert changed.shape == image.shape
        assert np.abs(changed.astype(int) - image).mean() > 2.0, name


def test_cameras_and_calibration_may_keep_colours_of_their_own() -> None:
    grey = np.full((4, 4, 3), 100, np.uint8)

    def blue_and_red(name: str, sequence: str, camera: str) -> list[int]:
        return CHANGES[name].of(sequence, camera)(grey)[0, 0, ::2].tolist()  # type: ignore[no-any-return]

    assert [blue_and_red("unbalanced", sequence, "left") for sequence in ("K", "G1")] == [[80, 115]] * 2
    assert blue_and_red("unbalanced", "G1", "right") == [115, 85]
    assert [blue_and_red("later", sequence, "left") for sequence in ("C", "K", "G2")] == [[100, 100]] * 2 + [[60, 75]]
