"""Feet beside a recording of cameras, or alone, with the core that runs live."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from rhot.core import Output
from rhot.errors import ConfigError
from rhot.messages import HeadPose, Side
from rhot.recording import Recording
from rhot.recording.feet_tables import HEAD_FILE, HEAD_HEADER, read_table, sensor_file
from rhot.rig import Rig
from rhot_feet.foot_core import RIG_FRAME, FootCore
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.sources.depth_camera.recorded_frames import load_depth_recording
from rhot_feet.sources.imu.recorded import read_samples

HEAD_KEY: Final = "rhot/head"
PERIOD_NS: Final = 10_000_000
"""Between two poses of a foot, as live."""
_HEAD_AHEAD_NS: Final = 150_000_000
"""How far the head's poses are known ahead of a picture: as long as a live one waits for them."""

_FARTHEST_M: Final = 1e3
"""What a message may carry."""


class RecordedFeet:
    """Plays what `rhot record --frames` wrote of the feet, everything in the order in which it happened.

    Args:
        rig: whose feet.
        recording: with a depth camera.

    Raises:
        ConfigError: the rig has no feet, or a file is missing or cannot be used.
    """

    def __init__(self, rig: Rig, recording: Recording) -> None:
        feet, folder = rig.config.feet, recording.depth_camera
        if feet is None:
            raise ConfigError(f"{rig.path / 'rig.toml'} names no feet; add [feet.left] or [feet.right] with marker_id")
        if folder is None:
            raise ConfigError(f"{recording.path}: holds no depth camera's pictures; `rhot record --frames` takes them")
        self._stage = FootCore(feet, rig.T_head_camera)
        self._frames = load_depth_recording(folder, complete=recording.complete)
        self._heads = recorded_heads(folder)
        self._sensors: dict[Side, ImuSamples] = {
            side: read_samples(folder / sensor_file(side))
            for side in feet.feet
            if (folder / sensor_file(side)).exists()
        }
        self._next_frame = 0
        self._next_heads = {"stage": 0, "published": 0}
        self._next_sample: dict[Side, int] = dict.fromkeys(self._sensors, 0)
        self._tick_ns = int(self._frames.t_ns[0])
        self._published_ns = 0

    @property
    def frame_count(self) -> int:
        """How many pictures there are."""
        return len(self._frames)

    @property
    def frames_done(self) -> int:
        """How many of them were looked at."""
        return self._next_frame

    @property
    def end_ns(self) -> int:
        """Time of the last picture."""
        return int(self._frames.t_ns[-1])

    def until(self, t_ns: int) -> list[Output]:
        """Return the head's poses and the feet up to a time; times do not go back.

        Raises:
            ConfigError: a picture cannot be read.
        """
        outputs: list[Output] = []
        while self._tick_ns <= min(t_ns, self.end_ns):
            outputs += self._step(self._tick_ns)
            self._tick_ns += PERIOD_NS
        return outputs

    def _step(self, now_ns: int) -> list[Output]:
        """Take in what happened up to a time, and return where the feet are then."""
        times = self._frames.t_ns
        while self._next_frame < len(times) and times[self._next_frame] <= now_ns:
            frame_ns = int(times[self._next_frame])
            self._feed_motion(frame_ns)
            self._stage.process(self._frames.frame(self._next_frame))
            self._next_frame += 1
        self._feed_motion(now_ns)
        outputs: list[Output] = [(HEAD_KEY, pose) for pose in self._heads_until("published", now_ns)]
        due_ns = self._stage.due_ns(now_ns)
        if due_ns > self._published_ns:
            outputs += self._stage.poses(due_ns)
            self._published_ns = due_ns
        return outputs

    def _feed_motion(self, t_ns: int) -> None:
        for pose in self._heads_until("stage", t_ns + _HEAD_AHEAD_NS):
            self._stage.add_head_pose(pose)
        for side, samples in self._sensors.items():
            first = self._next_sample[side]
            last = int(np.searchsorted(samples.t_ns, t_ns, side="right"))
            if last > first:
                self._stage.add_imu_samples(side, samples.rows(first, last))
                self._next_sample[side] = last

    def _heads_until(self, reader: str, t_ns: int) -> list[HeadPose]:
        first = last = self._next_heads[reader]
        while last < len(self._heads) and self._heads[last].t_ns <= t_ns:
            last += 1
        self._next_heads[reader] = last
        return self._heads[first:last]


def recorded_heads(folder: Path) -> list[HeadPose]:
    """Return the head's poses beside a depth camera's pictures.

    Raises:
        ConfigError: there are none, or the file cannot be used.
    """
    file = folder / HEAD_FILE
    if not file.exists():
        raise ConfigError(
            f"{file} is not there: without the head's poses nobody knows where the camera was; `rhot objects`, or what "
            "else publishes rhot/head, has to run while it is recorded"
        )
    t_ns, values = read_table(file, HEAD_HEADER)
    norms = np.linalg.norm(values[:, 3:], axis=1)
    wrong = np.flatnonzero((np.abs(norms - 1.0) > 1e-3) | (np.abs(values[:, :3]) > _FARTHEST_M).any(axis=1))
    if len(wrong):
        raise ConfigError(
            f"{file}, line {wrong[0] + 2}: {values[wrong[0]].tolist()} is no pose: x, y, z within {_FARTHEST_M:g} m "
            "and a unit quaternion are needed"
        )
    return [
        HeadPose(
            t_ns=at_ns,
            seq=number,
            frame=RIG_FRAME,
            position=(x, y, z),
            orientation=(qx, qy, qz, qw),
            state="measured",
        )
        for number, (at_ns, (x, y, z, qx, qy, qz, qw)) in enumerate(zip(t_ns.tolist(), values.tolist(), strict=True))
    ]
