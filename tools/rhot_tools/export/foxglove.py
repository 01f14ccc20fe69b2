"""A recording as an MCAP file that Foxglove and Lichtblick open: their schemas, messages in protobuf."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from mcap.writer import CompressionType, Writer

from rhot import __version__
from rhot.atomic_file import replacing
from rhot.errors import ConfigError
from rhot.messages import Message
from rhot.rig import CameraCalibration
from rhot_tools.export.foxglove_scene import Shown, Topic, picture_topic, rig_topics, topics
from rhot_tools.recordings.beside import StoredPicture

CODINGS: Final = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}
"""Ending of a picture's name to Foxglove's name of its format."""


def write_foxglove(
    file: Path,
    messages: Iterable[tuple[str, Message]],
    cameras: dict[str, CameraCalibration],
    pictures: Iterable[StoredPicture],
) -> dict[str, int]:
    """Write a file and return how many messages each topic has.

    Every message stands at its capture time; messages without one are left out.

    Args:
        file: to write.
        messages: of a recording.
        cameras: of its rig, where known.
        pictures: to show under the markers.

    Raises:
        ConfigError: it, or a picture, cannot be written or read.
    """
    with replacing(file) as part, part.open("wb") as stream:
        writer = _TopicWriter(Writer(stream, compression=CompressionType.ZSTD))
        start_ns = 0
        for key, message in messages:
            if not message.t_ns:
                continue
            if not start_ns:
                start_ns = message.t_ns
                writer.add_all(rig_topics(cameras, start_ns), start_ns)
            writer.add_all(topics(key, message), message.t_ns)
        for picture in pictures:
            coding = CODINGS[picture.file.suffix.lower()]
            writer.add_all([picture_topic(picture.camera, picture.t_ns, _read(picture.file), coding)], picture.t_ns)
        writer.finish()
    return writer.counts


def _read(picture: Path) -> bytes:
    try:
        return picture.read_bytes()
    except OSError as error:
        raise ConfigError(f"{picture}: cannot be read: {error.strerror or error}") from error


class _TopicWriter:
    def __init__(self, writer: Writer) -> None:
        self.counts: dict[str, int] = {}
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        writer.start(profile="", library=f"rhot/{__version__}")

    def add_all(self, found: Iterable[Topic], t_ns: int) -> None:
        for topic, value in found:
            self._writer.add_message(
                self._channel(topic, value),
                log_time=t_ns,
                publish_time=t_ns,
                data=value.encode(),
                sequence=self.counts.get(topic, 0),
            )
            self.counts[topic] = self.counts.get(topic, 0) + 1

    def finish(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _channel(self, topic: str, message: Shown) -> int:
        if topic not in self._channels:
            schema = message.get_schema()
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", self._schemas[schema.name])
        return self._channels[topic]
