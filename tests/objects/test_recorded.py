from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot_objects.pose import Pose
from rhot_objects.sources.recorded import RecordedSource, read_poses

HEADER = "t_ns,x,y,z,qx,qy,qz,qw\n"
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
QUARTER_ABOUT_Z = "0,0,1,1"


def write(folder: Path, *rows: str) -> Path:
    path = folder / "cup.csv"
    path.write_text(HEADER + "".join(f"{row}\n" for row in rows), encoding="utf-8")
    return path


def pose_at(source: RecordedSource, seconds: float) -> Pose | None:
    now_ns = START + round(seconds * SECOND)
    sample = source.read(now_ns).get("cup")
    if sample is None:
        return None
    assert sample.t_ns == now_ns
    return sample.pose


@pytest.fixture
def two_seconds(tmp_path: Path) -> Path:
    """A recording that begins at its own time 5 s: 1 m along x in the first second, then still for one more."""
    return write(
        tmp_path,
        f"{5 * SECOND},0,0,0,0,0,0,1",
        f"{6 * SECOND},1,0,0,{QUARTER_ABOUT_Z}",
        f"{7 * SECOND},1,0,0,{QUARTER_ABOUT_Z}",
    )


def test_plays_from_the_start_of_the_session(two_seconds: Path) -> None:
    source = RecordedSource("cup", two_seconds)
    source.open(START)
    assert pose_at(source, -0.001) is None
    for seconds, x, angle_deg in [
        (0.0, 0.0, 0.0),
        (0.25, 0.25, 22.5),
        (1.0, 1.0, 90.0),
        (1.7, 1.0, 90.0),
        (2.0, 1.0, 90.0),
    ]:
        pose = pose_at(source, seconds)
        assert pose is not None
        np.testing.assert_allclose(pose.position, (x, 0.0, 0.0), atol=1e-9)
        half = np.radians(angle_deg) / 2.0
        np.testing.assert_allclose(pose.orientation_xyzw, (0.0, 0.0, np.sin(half), np.cos(half)), atol=1e-9)
    assert pose_at(source, 2.001) is None


def test_a_loop_begins_again(two_seconds: Path) -> None:
    source = RecordedSource("cup", two_seconds, loop=True)
    source.open(START)
    for seconds in (0.25, 2.25, 2000.25):
        pose = pose_at(source, seconds)
        assert pose is not None
        np.testing.assert_allclose(pose.position, (0.25, 0.0, 0.0), atol=1e-9)
    assert pose_at(source, -0.25) is None


def test_a_closed_source_tracks_nothing(two_seconds: Path) -> None:
    source = RecordedSource("cup", two_seconds)
    source.open(START)
    source.close()
    source.close()
    assert pose_at(source, 0.5) is None


def test_a_single_pose_can_only_loop(tmp_path: Path) -> None:
    path = write(tmp_path, "0,1,2,3,0,0,0,1")
    with pytest.raises(ConfigError, match=r"cup\.csv: holds a single pose.*loop = true"):
        RecordedSource("cup", path).open(START)
    source = RecordedSource("cup", path, loop=True)
    source.open(START)
    pose = pose_at(source, 12.5)
    assert pose is not None
    np.testing.assert_allclose(pose.position, (1, 2, 3))


def test_quaternions_are_normalised(tmp_path: Path) -> None:
    _, poses = read_poses(write(tmp_path, "0,0,0,0,0,0,0,-7", "1,0,0,0,2,0,0,0"))
    np.testing.assert_allclose([pose.orientation_xyzw for pose in poses], [(0, 0, 0, -1), (1, 0, 0, 0)])


def test_what_spreadsheets_write_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "cup.csv"
    path.write_bytes(b"\xef\xbb\xbft_ns, x, y, z, qx, qy, qz, qw\r\n0,1.5e-1,0,0,0,0,0,1\r\n\r\n5,0,0,0,0,0,0,1\r\n")
    times, poses = read_poses(path)
    assert times.tolist() == [0, 5]
    assert poses[0].position[0] == 0.15


@pytest.mark.parametrize(
    ("rows", "complaint"),
    [
        (["0,0,0,0,0,0,0,1", "5,0,0,0,0,0,0,0"], r"line 3: the quaternion .* has no length"),
        (["0,0,0,0,0,0,0,1", "0,0,0,0,0,0,0,1"], r"line 3: t_ns 0 is not after the row before \(0\)"),
        (["0,0,0,0,0,0,1"], r"line 2: 7 values instead of 8"),
        (["0,0,0,0,0,0,0,1,9"], r"line 2: 9 values instead of 8"),
        (["0.5,0,0,0,0,0,0,1"], r"line 2: t_ns '0\.5' is not a whole number"),
        (["-1,0,0,0,0,0,0,1"], r"line 2: t_ns -1 is not between"),
        (["99999999999999999999,0,0,0,0,0,0,1"], r"line 2: t_ns 9+ is not between"),
        (["0,0,zero,0,0,0,0,1"], r"line 2: y 'zero' is not a number"),
        (["0,0,0,nan,0,0,0,1"], r"line 2: z 'nan' is out of bounds"),
        (["0,0,0,0,inf,0,0,1"], r"line 2: qx 'inf' is out of bounds"),
        (["0,1e9,0,0,0,0,0,1"], r"line 2: x '1e9' is out of bounds"),
        ([], r"holds no rows"),
    ],
)
def test_each_fault_is_named_with_file_and_line(tmp_path: Path, rows: list[str], complaint: str) -> None:
    with pytest.raises(ConfigError, match=r"cup\.csv.*" + complaint):
        read_poses(write(tmp_path, *rows))


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", r"line 1: the header must be t_ns,x,y,z,qx,qy,qz,qw"),
        (b"t_ns,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n", r"line 1: the header must be"),
        (b"\xff\xfe\x00", r"cannot be read"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "cup.csv"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=complaint):
        read_poses(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.csv: cannot be read"):
        RecordedSource("cup", tmp_path / "nowhere.csv").open(START)
