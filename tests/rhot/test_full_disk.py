"""Full and read-only disks at every write: one clear error, what was there stays, nothing half written is left."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from hand_messages import hand_pose, marker_frame, point_set
from machine.failing_disk import Disk, Failure, small_disk

from rhot.cli import main
from rhot.errors import ConfigError
from rhot.messages import Message, encode, encoding_of
from rhot.recording.camera_picture import CameraPicture
from rhot.recording.mcap.reader import open_mcap
from rhot.recording.mcap.writer import McapWriter
from rhot.recording.picture_folder import PictureFolder
from rhot.rig import HandFile
from rhot.rig.folder import write_text_atomic
from rhot.rig.kept_file import KeptFile
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file

T_NS = 1_800_000_000_000_000_000
JPEG = bytes(cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1])
FAILURES: tuple[Failure, ...] = ("full", "read-only")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    with small_disk(tmp_path / "disk") as made:
        yield made


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Messages, and marker tracks to process."""
    folder = tmp_path_factory.mktemp("recording")
    with McapWriter(folder / "take.mcap", now_ns=0) as writer:
        for step in range(20):
            t_ns = T_NS + step * 10_000_000
            messages: list[tuple[str, Message]] = [
                ("rhot/markers/left", marker_frame("left", t_ns)),
                ("rhot/points", point_set(t_ns)),
                ("rhot/hand/right", hand_pose(0.01 * step, t_ns)),
            ]
            for key, message in messages:
                writer.write(key, encoding_of(type(message)), encode(message), t_ns, step, t_ns)
    for camera in ("left", "right"):
        (folder / "tracks" / camera).mkdir(parents=True)
        rows = [f"{n},{T_NS + n * 16_000_000},index,{300 + n},{200}" for n in range(5)]
        (folder / "tracks" / camera / "markers.csv").write_text("frame,t_ns,marker,u,v\n" + "\n".join(rows) + "\n")
    (folder / "rig").mkdir()
    (folder / "rig" / "rig.toml").write_text(rig_template(folder="rig", name="test"))
    return folder


def command(*words: str) -> None:
    """Run a command; when it fails, it has said so in one line, which becomes the error."""
    result = CliRunner().invoke(main, ["-q", *words])
    if result.exit_code:
        assert result.exit_code == 2, result.output
        assert result.stderr.count("rhot: error:") == 1
        assert "Traceback" not in result.output
        raise ConfigError(result.stderr)


def rig(folder: Path) -> KeptFile[HandFile]:
    if not (folder / "rig.toml").exists():
        (folder / "rig.toml").write_text(rig_template(folder="rig", name="test"))
    return KeptFile(folder / "hand.json", HandFile)


def tried(folder: Path) -> KeptFile[HandFile]:
    kept = rig(folder)
    kept.try_out(HandFile(length_m=0.18))
    return kept


WRITES: dict[str, Callable[[Path, Path], Callable[[], object]]] = {
    "rig.toml": lambda disk, _: (
        rig(disk),
        lambda: change_rig_file(disk, {("hand",): {"length_m": 0.2}}),
    )[1],
    "try": lambda disk, _: (kept := rig(disk), lambda: kept.try_out(HandFile(length_m=0.19)))[1],
    "try again": lambda disk, _: (kept := tried(disk), lambda: kept.try_out(HandFile(length_m=0.19)))[1],
    "init": lambda disk, _: lambda: command("init", str(disk / "new")),
    "process": lambda disk, source: (
        lambda: command(
            "process", str(source / "tracks"), "--rig", str(source / "rig"), "--out", str(disk / "out.jsonl")
        )
    ),
    **{
        f"export {option}": lambda disk, source, option=option, name=name: (
            lambda: command(  # type: ignore[misc]
                "export", str(source / "take.mcap"), f"--{option}", str(disk / name)
            )
        )
        for option, name in (("csv", "t"), ("parquet", "t"), ("bvh", "a.bvh"), ("foxglove", "a.mcap"))
    },
}


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("name", WRITES)
def test_a_write_fails_clearly_and_leaves_what_was_there(
    disk: Disk, recording: Path, failure: Failure, name: str
) -> None:
    if failure == "read-only" and not disk.mounted and os.geteuid() == 0:
        pytest.skip("root may write everywhere and this machine lets nothing be mounted")
    write = WRITES[name](disk.path, recording)
    before = disk.files()
    with disk.failing(failure), pytest.raises(ConfigError) as raised:
        write()
    said = str(raised.value)
    assert str(disk.path) in said
    assert "make room" in said if failure == "full" else "choose a folder" in said
    assert disk.files() == before
    write()
    after = disk.files()
    assert after != before
    if name == "init":
        return
    # The same over a file that is there: it stays whole.
    with disk.failing(failure), pytest.raises(ConfigError):
        write()
    assert disk.files() == after


@pytest.mark.parametrize("failure", FAILURES)
def test_saving_and_undoing_a_calibration_need_no_room(disk: Disk, failure: Failure) -> None:
    if failure == "read-only" and not disk.mounted:
        pytest.skip("needs a file system of its own, and this machine lets nothing be mounted")
    kept = tried(disk.path)
    kept.save()
    kept.try_out(HandFile(length_m=0.19))
    before = disk.files()
    with disk.failing(failure):
        if failure == "read-only":
            for step in (kept.save, kept.undo):
                with pytest.raises(ConfigError, match="Read-only"):
                    step()
            assert disk.files() == before
        else:
            kept.save()
    if failure == "read-only":
        kept.save()
    assert kept.content == HandFile(length_m=0.19)


def test_pictures_that_fill_a_disk_end_in_one_error_and_open_afterwards(disk: Disk) -> None:
    def picture(frame: int) -> CameraPicture:
        return CameraPicture(
            t_ns=T_NS + frame, seq=frame, camera="left", frame=frame, exposure_s=0.004, readout_s=0.0, jpeg=JPEG
        )

    with (
        pytest.raises(ConfigError, match=r"cannot be written any more: .*make room"),
        PictureFolder(disk.path / "take") as folder,
    ):
        for frame in range(10):
            folder.write(picture(frame))
        with disk.failing("full"):
            for frame in range(10, 20_000):
                folder.write(picture(frame))
    from rhot.recording import load_recording

    assert len(load_recording(disk.path / "take").cameras["left"].frames) >= 10


def test_messages_that_fill_a_disk_end_in_one_error_and_open_afterwards(disk: Disk) -> None:
    payload = np.random.default_rng(1).bytes(2000)
    writer = McapWriter(disk.path / "take.mcap", now_ns=0)
    with pytest.raises(ConfigError, match=r"take\.mcap: cannot be written any more: .*make room"), writer:
        for step in range(100_000):
            writer.write("rhot/x", "application/octet-stream", payload, None, None, T_NS + step)
            if step % 20 == 0:
                writer.flush()
    (disk.path / ".filler").unlink(missing_ok=True)
    assert len(list(open_mcap(disk.path / "take.mcap").samples())) > 20


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_output_that_cannot_be_written_is_one_line() -> None:
    command = [sys.executable, "-c", "from rhot.cli import main; main()", "--help"]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60.0, check=False)
    assert ended.returncode == 1
    assert ended.stderr == "rhot: error: standard output: cannot be written: No space left on device\n"


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_new_files_heed_the_umask_and_old_ones_keep_their_mode(tmp_path: Path, umask: int, mode: int) -> None:
    before = os.umask(umask)
    try:
        write_text_atomic(tmp_path / "new.json", "{}")
    finally:
        os.umask(before)
    assert (tmp_path / "new.json").stat().st_mode & 0o777 == mode
    (tmp_path / "new.json").chmod(0o640)
    write_text_atomic(tmp_path / "new.json", "[]")
    assert (tmp_path / "new.json").stat().st_mode & 0o777 == 0o640
