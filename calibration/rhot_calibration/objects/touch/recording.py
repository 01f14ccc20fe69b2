"""Touches from a recording of `rhot record`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rhot.errors import ConfigError, WireError
from rhot.messages import Control, HandPose, ObjectPose
from rhot.recording.mcap.reader import open_mcap
from rhot.service.control_link import CONTROL_KEY
from rhot_calibration.objects.touch.collector import TouchCollector
from rhot_calibration.objects.touch.fit import Touch
from rhot_calibration.objects.touch.streams import TouchTask, feed


def touches_recorded(
    file: Path, task: TouchTask, collector: TouchCollector, taken: Callable[[Touch], None] = lambda _: None
) -> None:
    """Fill a collector from an MCAP recording.

    A session that is started within the recording starts the touches over.

    Args:
        file: the recording.
        task: what was touched; its registration must be the one that held then.
        collector: filled until it is done or the recording ends.
        taken: called with each touch.

    Raises:
        ConfigError: not a recording, or neither hand nor object is in it.
    """
    recording = open_mcap(file)
    for key in (task.hand_key, task.object_key):
        if key not in recording.keys:
            raise ConfigError(f"{file}: no {key} in it; record hand and object together while the object is touched")
    from_ns = 0
    for sample in recording.samples():
        if collector.done:
            return
        if sample.key not in (task.hand_key, task.object_key, CONTROL_KEY):
            continue
        try:
            message = sample.message()
        except WireError:
            continue
        if isinstance(message, Control) and message.action == "start":
            collector.start_over()
            from_ns = message.start_t_ns
        elif isinstance(message, HandPose | ObjectPose) and message.t_ns >= from_ns:
            touch = feed(task, collector, sample.key, message)
            if touch is not None:
                taken(touch)
