"""Files for Foxglove, Lichtblick and Rerun, read back by programs that are not ours."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from hand_messages import hand_pose, marker_frame, object_pose, point_set
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from rhot.errors import ConfigError
from rhot.messages import HandPose, Message, ServiceStatus, encode, encoding_of
from rhot.recording.attached import unpack_rig
from rhot.recording.camera_picture import CameraPicture
from rhot.recording.mcap.writer import McapWriter, rig_files
from rhot.recording.picture_folder import PictureFolder
from rhot.rig import load_rig
from rhot_tools.recordings.export import export

T_NS = 1_700_000_000_123_456_789
JPEG = bytes(cv2.imencode(".jpg", np.full((480, 640, 3), 90, np.uint8))[1])


@pytest.fixture
def recording(tmp_path: Path, rig_folder: Path) -> Path:
    """One moment of everything, with pictures beside it and the rig inside."""
    messages: list[tuple[str, Message]] = [
        ("rhot/status/ik/main", ServiceStatus(t_ns=0, service="ik", instance="main", state="waiting")),
        ("rhot/markers/left", marker_frame("left", T_NS)),
        ("rhot/points", point_set(T_NS + 1)),
        ("rhot/hand/right", hand_pose(0.3, T_NS + 2)),
        ("rhot/object/cube", object_pose(T_NS + 3, 0.25)),
    ]
    file = tmp_path / "take-001.mcap"
    with McapWriter(tmp_path / "take.mcap", now_ns=0, max_bytes=1 << 20, attachments=rig_files(rig_folder)) as writer:
        for key, message in messages:
            writer.write(key, encoding_of(type(message)), encode(message), message.t_ns, 0, T_NS)
    with PictureFolder(tmp_path / "take") as folder:
        folder.write(
            CameraPicture(t_ns=T_NS - 8_000_000, camera="left", frame=0, exposure_s=0.004, readout_s=0.012, jpeg=JPEG)
        )
    return file


def read(file: Path) -> dict[str, tuple[str, int, Any]]:
    found: dict[str, tuple[str, int, Any]] = {}
    with file.open("rb") as stream:
        decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        for schema, channel, message, value in decoded:
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            found.setdefault(channel.topic, (schema.name, message.log_time, value))
    return found


def xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def test_foxglove_sees_hand_points_objects_and_pictures(recording: Path, tmp_path: Path, rig_folder: Path) -> None:
    file = tmp_path / "fox.mcap"
    result = CliRunner().invoke(export, [str(recording), "--foxglove", str(file)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    found = read(file)
    name, t_ns, scene = found["/hand/right"]
    hand = hand_pose(0.3, T_NS + 2)
    assert isinstance(hand, HandPose)
    assert (name, t_ns) == ("foxglove.SceneUpdate", T_NS + 2)
    (entity,) = scene.entities
    assert entity.timestamp.ToNanoseconds() == T_NS + 2
    assert entity.frame_id == "rig"
    places = [xyz(ball.pose.position) for ball in entity.spheres]
    assert places == [joint.position for joint in hand.joints.values()]
    assert entity.spheres[0].size.x == 2.0 * hand.joints["palm"].radius
    assert len(entity.lines[0].points) == 2 * 25
    assert found["/points"][2].entities[0].texts[0].text == "index"
    assert xyz(found["/object/cube"][2].pose.position) == (0.25, 0.0, 0.5)
    circle = found["/markers/left/annotations"][2].circles[0]
    assert (circle.position.x, circle.position.y) == (320.75, 241.0), "their pixel centres are on halves"
    name, t_ns, picture = found["/camera/left/image"]
    assert (name, t_ns, picture.format) == ("foxglove.CompressedImage", T_NS, "jpeg")
    assert picture.data == JPEG
    camera = load_rig(rig_folder).cameras["left"]
    lens = found["/camera/left/calibration"][2]
    assert (list(lens.K), list(lens.D)) == (np.ravel(camera.K).tolist(), [0.0] * 5)
    assert not any("status" in topic for topic in found)


def test_without_the_sdk_it_is_said_what_to_install(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove.messages", None)
    for name in ("foxglove", "foxglove_scene"):
        monkeypatch.delitem(sys.modules, f"rhot_tools.export.{name}", raising=False)
    with pytest.raises(ConfigError, match=r"pip install 'rhot\[foxglove\]'"):
        CliRunner().invoke(export, [str(recording), "--foxglove", str(tmp_path / "x.mcap")], catch_exceptions=False)


def test_a_folder_that_cannot_be_written_is_told(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere"):
        CliRunner().invoke(
            export, [str(recording), "--foxglove", str(tmp_path / "nowhere" / "x.mcap")], catch_exceptions=False
        )


@pytest.mark.skipif(importlib.util.find_spec("rerun") is not None, reason="rerun is installed")
def test_without_rerun_it_is_said_what_to_install(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"pip install 'rhot\[rerun\]'"):
        CliRunner().invoke(export, [str(recording), "--rerun", str(tmp_path / "x.rrd")], catch_exceptions=False)


def test_rerun_file(recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the extra `rerun`")
    file = tmp_path / "x.rrd"
    result = CliRunner().invoke(export, [str(recording), "--rerun", str(file)], catch_exceptions=False)
    assert "4 messages" in result.output
    assert file.read_bytes()[:4] == b"RRF2"


def test_an_attached_rig_stays_in_its_folder(tmp_path: Path) -> None:
    inside = unpack_rig({"rig/rig.toml": b"a", "rig/../out": b"b", "rig/..": b"c", "other": b"d"}, tmp_path, Path("x"))
    assert [file.name for file in inside.iterdir()] == ["rig.toml"]
    assert [file.name for file in tmp_path.iterdir()] == ["rig"]
    with pytest.raises(ConfigError, match="--rig"):
        unpack_rig({"other": b"d"}, tmp_path, Path("x"))
