"""A take of a simulated hand, as `rhot record` would have written it, made without running anything live."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from rhot.messages import HandPose, MarkerFrame, encode, encoding_of
from rhot.offline import track
from rhot.recording.camera_picture import CameraPicture, jpeg_of
from rhot.recording.mcap.writer import McapWriter, rig_files
from rhot.recording.picture_folder import PictureFolder
from rhot.rig import Rig, load_rig
from rhot_bench.speed.simulated import Cameras, Capture, moments, world_of
from rhot_sim.rig.folder import write_simulated_rig

DELAY_NS = 8_000_000
"""From when a message was true to when the recorder had it."""


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """The folder of `simulated_rig`; it goes when the tests end. Learning colours takes five seconds of computing."""
    folder = tempfile.TemporaryDirectory(prefix="rhot-tests-")
    write_simulated_rig(Path(folder.name) / "rig")
    return folder


def simulated_rig(path: Path, rate_hz: float = 60.0) -> Rig:
    """Write a simulated rig with colours into a folder that is not there yet, quickly, and return it loaded."""
    shutil.copytree(Path(_folder().name) / "rig", path)
    text = (path / "rig.toml").read_text()
    (path / "rig.toml").write_text(re.sub(r"rate_hz = 60(\.0)?\b", f"rate_hz = {rate_hz}", text))
    rig = load_rig(path)
    assert {camera.rate_hz for camera in rig.config.cameras.values()} == {rate_hz}
    return rig


def write_take(rig: Rig, file: Path, from_s: float, to_s: float, *, pictures: bool = False) -> dict[int, HandPose]:
    """Write what a rig publishes while a simulated hand moves, pictures beside it; return the hands by time."""
    cameras, capture = Cameras(rig, world_of(rig)), Capture(rig)
    folder = PictureFolder(file.with_suffix(""))

    def frames() -> Iterator[MarkerFrame]:
        for moment in moments(rig, from_s, to_s):
            image = cameras.picture(moment)
            frame = capture.frame(moment, image)
            config = rig.config.cameras[moment.camera]
            if pictures:
                folder.write(
                    CameraPicture(
                        t_ns=frame.t_ns - round(5e8 * (config.exposure_s + config.readout_s)),
                        camera=moment.camera,
                        frame=moment.number,
                        exposure_s=config.exposure_s,
                        readout_s=config.readout_s,
                        jpeg=jpeg_of(image),
                    )
                )
            yield frame

    hands: dict[int, HandPose] = {}
    with folder, McapWriter(file, now_ns=0, attachments=rig_files(rig.path)) as writer:
        for key, message in track(rig, frames()):
            payload, log_ns = encode(message), message.t_ns + DELAY_NS
            writer.write(key, encoding_of(type(message)), payload, message.t_ns, message.seq, log_ns)
            if isinstance(message, HandPose):
                hands[message.t_ns] = message
    return hands
