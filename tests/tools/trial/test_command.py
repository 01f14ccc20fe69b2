from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from marker_streams import Motion, calibration, pinhole_cameras, thesis_cameras, watch

from rhot.bus import Bus
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.geometry.rotations import rotation_from_vector
from rhot.messages import MarkerFrame
from rhot.rig import BusConfig, CameraCalibration, CamerasFile, Rig, write_json_model
from rhot_tools.trial.moved_cameras import calibration as command


def run(rig: Rig, *arguments: str | Path) -> Result:
    return CliRunner().invoke(
        command, [*map(str, arguments), "--rig", str(rig.path)], catch_exceptions=False, standalone_mode=False
    )


def pitched(cameras: dict[str, CameraCalibration], degrees: float) -> dict[str, CameraCalibration]:
    """Return two cameras whose second was turned up."""
    moved = cameras["camera1"]
    T = np.array(moved.T_rig_camera)
    T[:3, :3] = T[:3, :3] @ rotation_from_vector(np.array([np.radians(degrees), 0.0, 0.0]))
    return {**cameras, "camera1": calibration(np.array(moved.K), np.array(moved.distortion), T)}


def seen(make_rig: Callable[..., Rig], degrees: float, duration_s: float = 3.0) -> tuple[Rig, list[MarkerFrame]]:
    """Return a calibrated rig and what its cameras see after the second was turned up by some degrees."""
    cameras = pinhole_cameras(2)
    frames = [one.frame for one in watch(make_rig(pitched(cameras, degrees)), Motion(), duration_s)]
    return make_rig(cameras), frames


def record(folder: Path, frames: list[MarkerFrame]) -> Path:
    for camera in {frame.camera for frame in frames}:
        rows = ["frame,t_ns,marker,u,v"]
        rows += [
            f"{frame.frame},{frame.t_ns},{name},{marker.u:.3f},{marker.v:.3f}"
            for frame in frames
            if frame.camera == camera
            for name, marker in frame.markers.items()
        ]
        (folder / camera).mkdir(parents=True)
        (folder / camera / "markers.csv").write_text("\n".join(rows) + "\n")
    return folder


def test_the_real_rig_had_turned_by_a_degree(make_rig: Callable[..., Rig], thesis_rig: Path) -> None:
    """Its calibration is older than the recording; the recording's notes speak of about 1° of roll."""
    rig = make_rig(thesis_cameras(thesis_rig))
    done = run(rig, thesis_rig / "recordings" / "hand_recovered", "--json")
    assert done.return_value == 1
    report = json.loads(done.stdout)
    assert report["verdict"] == "bumped"
    turn = report["pairs"]["left-right"]["turn_deg"]
    assert turn["roll"]["value"] == pytest.approx(1.27, abs=0.15)
    assert turn["pitch"]["value"] == pytest.approx(-0.49, abs=0.05)
    assert turn["roll"]["observable"]
    assert not turn["yaw"]["observable"]
    line = report["pairs"]["left-right"]["line"]["values"]
    assert np.degrees(np.arctan(line["b"])) == pytest.approx(-1.3, abs=0.2)


def test_a_recording_of_a_rig_that_stood_still_is_good(make_rig: Callable[..., Rig], tmp_path: Path) -> None:
    rig, frames = seen(make_rig, 0.0)
    done = run(rig, record(tmp_path / "recording", frames))
    assert done.return_value == 0
    assert "good: the calibration holds" in done.output
    assert "rhot calibrate cameras RECORDING" not in done.output


def test_a_bumped_rig_is_told_with_remedy(make_rig: Callable[..., Rig], tmp_path: Path) -> None:
    rig, frames = seen(make_rig, 0.3)
    write_json_model(rig.path / "cameras.json", CamerasFile(date="2026-01-02", cameras=rig.cameras))
    done = run(rig, record(tmp_path / "recording", frames))
    assert done.return_value == 1
    assert "camera1 against camera0 turned by pitch +" in done.output
    assert "yaw not observable" in done.output
    assert "bumped: the cameras have moved since they were calibrated (calibrated 2026-01-02)" in done.output
    assert f"rhot calibrate cameras RECORDING --rig {rig.path}" in done.output


def test_calls_that_cannot_work_say_why(make_rig: Callable[..., Rig], tmp_path: Path) -> None:
    nominal = make_rig()
    with pytest.raises(CalibrationError, match=r"cameras\.json is not there"):
        run(nominal, tmp_path)
    rig, frames = seen(make_rig, 0.0, 1.0)
    with pytest.raises(ConfigError, match="either a RECORDING or --live"):
        run(rig)
    with pytest.raises(ConfigError, match="either a RECORDING or --live"):
        run(rig, tmp_path, "--live", "5")
    with pytest.raises(ConfigError, match="no such recording"):
        run(rig, tmp_path / "absent")
    alone = record(tmp_path / "alone", [frame for frame in frames if frame.camera == "camera0"])
    with pytest.raises(CalibrationError, match=r"only 1 of 2 cameras gave frames \(none from camera1\)"):
        run(rig, alone)
    with pytest.raises(CalibrationError, match="no two cameras saw the same markers"):
        run(rig, record(tmp_path / "short", frames[:12]))


async def test_a_running_rig_is_judged(make_rig: Callable[..., Rig], router: BusConfig, endpoint: str) -> None:
    rig, frames = seen(make_rig, 0.3)
    async with await Bus.open(router) as bus:
        publishers = {name: bus.publisher(f"rhot/markers/{name}", MarkerFrame) for name in rig.cameras}

        async def publish() -> None:
            for publisher in publishers.values():
                while not await publisher.wait_for_reader(0.1):
                    pass
            for frame in frames:
                publishers[frame.camera].put(frame)
                await asyncio.sleep(0.001)

        publishing = asyncio.create_task(publish())
        done = await asyncio.to_thread(run, rig, "--live", "8", "--json", "--connect", endpoint)
        await publishing
    assert done.return_value == 1
    assert json.loads(done.stdout)["verdict"] == "bumped"


async def test_a_silent_rig_is_told(make_rig: Callable[..., Rig], router: BusConfig, endpoint: str) -> None:
    rig = make_rig(pinhole_cameras(2))
    with pytest.raises(BusError, match="no marker frame came in 2 s"):
        await asyncio.to_thread(run, rig, "--live", "2", "--connect", endpoint)


def test_pictures_of_a_board_tell_as_well(make_rig: Callable[..., Rig], thesis_rig: Path, tmp_path: Path) -> None:
    """The pictures that the calibration was made of: rows agree to half a pixel; some pairs were taken after a bump."""
    rig = make_rig(thesis_cameras(thesis_rig))
    # The author's folder names are the wrong way round.
    (tmp_path / "boards").mkdir()
    (tmp_path / "boards" / "left").symlink_to(thesis_rig / "chessboard" / "right")
    (tmp_path / "boards" / "right").symlink_to(thesis_rig / "chessboard" / "left")
    done = run(rig, tmp_path / "boards", "--board", "9x6", "--json")
    pair = json.loads(done.stdout)["pairs"]["left-right"]
    assert pair["observations"] > 500
    assert 0.3 < pair["systematic_px"] < 0.9
    assert pair["noise_px"] < 0.4
    assert pair["change"]["step_px"] > 0.5
    assert "picture" in pair["change"]
    with pytest.raises(CalibrationError, match="9x6"):
        run(rig, tmp_path / "boards", "--board", "nine")
    with pytest.raises(ConfigError, match="--board needs"):
        run(rig, "--live", "5", "--board", "9x6")
