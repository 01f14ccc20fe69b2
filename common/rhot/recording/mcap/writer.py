"""Writing bus samples to MCAP files: payload bytes as they were, one channel a key, one file or several by size.

Messages are encoded `msgpack` as on the bus; each channel names its Zenoh encoding in its metadata (`encoding`) and
carries the JSON schema of its message model. `publish_time` is the message's capture time on the rig clock,
`log_time` when it arrived at the recorder, on the recorder's clock. Chunks are compressed with zstd: of 120 hand poses
(443 kB) it takes 0.9 ms and leaves 27 %; lz4 takes 0.3 ms and leaves 35 %.

Format: MCAP version 0, https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from mcap.writer import CompressionType, Writer

from rhot import __version__
from rhot.atomic_file import sync_folder, why
from rhot.errors import ConfigError
from rhot.recording.mcap.wire_models import MSGPACK_ENCODING, json_schema, model_of_encoding
from rhot.rig.folder import settings_files

ENCODING_METADATA: Final = "encoding"
"""Entry of a channel's metadata: the Zenoh encoding of its samples."""
RIG_PREFIX: Final = "rig/"
"""Attached files of the rig folder have names that begin with this."""
_MOST_CHANNELS: Final = (1 << 16) - 1
_MEDIA_TYPES: Final = {".toml": "application/toml", ".json": "application/json"}


def rig_files(folder: Path) -> dict[str, bytes]:
    """Return the settings of a rig folder, its `*.toml` and `*.json`, by the name they are attached under.

    Raises:
        ConfigError: a file cannot be read.
    """
    return attachments_of(settings_files(folder))


def attachments_of(settings: Mapping[str, bytes]) -> dict[str, bytes]:
    """Return the settings of a rig by the names they are attached under."""
    return {f"{RIG_PREFIX}{name}": data for name, data in settings.items()}


class McapWriter:
    """Writes samples in the order of their arrival; use as a context manager.

    Attributes:
        files: written so far, the one in progress last.
    """

    def __init__(
        self,
        target: Path,
        *,
        now_ns: int,
        max_bytes: int | None = None,
        attachments: Mapping[str, bytes] | None = None,
        about: Mapping[str, str] | None = None,
    ) -> None:
        """Open the first file.

        Args:
            target: file to write; with `max_bytes` its name gets a number, `desk.mcap` becomes `desk-001.mcap`.
            now_ns: the time that attachments are stamped with, nanoseconds since the Unix epoch.
            max_bytes: begin a new file when the present one is at least this large.
            attachments: put into every file, by name.
            about: put into every file as the metadata record `rhot`.

        Raises:
            ConfigError: the file exists, or cannot be written.
        """
        self.files: list[Path] = []
        self._target = target
        self._now_ns = now_ns
        self._max_bytes = max_bytes
        self._attachments = dict(attachments or {})
        self._about = dict(about or {})
        self._log_ns = 0
        self._closed_bytes = 0
        self._open()

    def __enter__(self) -> McapWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def written_bytes(self) -> int:
        """Bytes in all files so far, without the chunk in progress."""
        return self._closed_bytes + (0 if self._stream.closed else self._stream.tell())

    def write(self, key: str, encoding: str, payload: bytes, t_ns: int | None, seq: int | None, log_ns: int) -> None:
        """Add one sample.

        Args:
            key: its key.
            encoding: its Zenoh encoding.
            payload: its bytes.
            t_ns: capture time; None = the message carries none, so its arrival stands for it.
            seq: the publisher's number, where it has one.
            log_ns: arrival, nanoseconds since the Unix epoch; made not to decrease.

        Raises:
            ConfigError: the disk is full, or the file cannot be written any more.
        """
        self._log_ns = max(self._log_ns, log_ns)
        with self._failing_clearly():
            channel = self._channels.get((key, encoding)) or self._channel(key, encoding)
            self._writer.add_message(
                channel,
                log_time=self._log_ns,
                data=payload,
                publish_time=self._log_ns if t_ns is None else t_ns,
                sequence=(seq or 0) & 0xFFFFFFFF,
            )

    def flush(self) -> None:
        """Close the chunk in progress, so that a crash loses nothing before this; begin a new file when it is time.

        Raises:
            ConfigError: the disk is full, the file was deleted, or it cannot be written any more.
        """
        with self._failing_clearly():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._stream.flush()
        if os.fstat(self._stream.fileno()).st_nlink == 0:
            raise ConfigError(
                f"{self.files[-1]}: was deleted while it was written; what was recorded so far is lost. Record again"
            )
        if self._max_bytes is not None and self._stream.tell() >= self._max_bytes:
            self.close()
            self._open()

    def sync(self) -> None:
        """Bring what was flushed to the disk: a power cut costs what came after this. May be called on any thread.

        Raises:
            ConfigError: the disk reports that it could not be written.
        """
        stream = self._stream
        try:
            handle = os.dup(stream.fileno())
        except (ValueError, OSError):
            return  # closed in this moment, and synced then
        try:
            os.fsync(handle)
        except OSError as error:
            raise self._unwritable(error) from error
        finally:
            os.close(handle)

    def close(self) -> None:
        """Complete the file in progress with its index, for good."""
        if self._stream.closed:
            return
        with self._failing_clearly():
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._closed_bytes += self._stream.tell()
            self._stream.close()

    def _open(self) -> None:
        file = self._target
        if self._max_bytes is not None:
            file = file.with_name(f"{file.stem}-{len(self.files) + 1:03d}{file.suffix}")
        try:
            self._stream: io.BufferedWriter = file.open("xb")
        except FileExistsError as error:
            raise ConfigError(f"{file} exists already and is not overwritten; choose another --out") from error
        except OSError as error:
            raise ConfigError(f"{file}: cannot be written: {why(error)}; choose another --out") from error
        self.files.append(file)
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        chunk_bytes = 1 << 20
        self._writer = Writer(self._stream, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        with self._failing_clearly():
            self._writer.start(profile="", library=f"rhot/{__version__}")
            self._writer.add_metadata("rhot", self._about)
            for name, data in self._attachments.items():
                media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
                self._writer.add_attachment(
                    create_time=0, log_time=self._now_ns, name=name, media_type=media_type, data=data
                )
            self._stream.flush()
            sync_folder(file.parent)

    def _channel(self, key: str, encoding: str) -> int:
        if len(self._channels) >= _MOST_CHANNELS:
            raise ConfigError(f"{self.files[-1]}: MCAP numbers {_MOST_CHANNELS} keys at most; record fewer")
        kind = encoding.partition(";")[0]
        channel: int = self._writer.register_channel(
            topic=key,
            message_encoding="msgpack" if kind == MSGPACK_ENCODING else kind.rpartition("/")[2],
            schema_id=self._schema(encoding),
            metadata={ENCODING_METADATA: encoding},
        )
        self._channels[key, encoding] = channel
        return channel

    def _schema(self, encoding: str) -> int:
        model = model_of_encoding(encoding)
        if model is None:
            return 0  # MCAP's number for "none"
        name = model.__name__
        if name not in self._schemas:
            schema: int = self._writer.register_schema(name=name, encoding="jsonschema", data=json_schema(model))
            self._schemas[name] = schema
        return self._schemas[name]

    @contextlib.contextmanager
    def _failing_clearly(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # The buffer cannot be written either; closing says so once more and closes the file all the same.
            with contextlib.suppress(OSError):
                self._stream.close()
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> ConfigError:
        return ConfigError(
            f"{self.files[-1]}: cannot be written any more: {why(error)}; the file opens up to its last complete "
            "chunk, at most a second before this; or record with --out on another disk"
        )
