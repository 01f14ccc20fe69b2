"""Reading recordings of `rhot record`, complete or cut off by a crash.

A file that lost its end opens up to its last complete chunk, and `McapRecording.note` says how much is missing. The
records inside a chunk are decoded one by one, so that a replay never stalls on a whole chunk.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Schema
from mcap.records import Message as MessageRecord
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from rhot.errors import ConfigError
from rhot.messages import Message, decode
from rhot.recording.mcap.wire_models import model_of_encoding
from rhot.recording.mcap.writer import ENCODING_METADATA

_RECORD_HEAD: Final = struct.Struct("<BQ")
_CHUNK_TIMES: Final = struct.Struct("<QQ")
_MAX_CHUNK_BYTES: Final = 1 << 30


@dataclass(frozen=True, slots=True)
class RecordedSample:
    """One sample as it was on the bus.

    Attributes:
        key: its key.
        encoding: its Zenoh encoding.
        payload: its bytes.
        t_ns: capture time, rig clock; the arrival where the message carries none.
        log_ns: arrival at the recorder, nanoseconds since the Unix epoch.
    """

    key: str
    encoding: str
    payload: bytes
    t_ns: int
    log_ns: int

    def message(self) -> Message | bytes:
        """Return the decoded message, or the payload where its encoding names no model of ours.

        Raises:
            WireError: the payload is not a valid message of its model.
        """
        model = model_of_encoding(self.encoding)
        return self.payload if model is None else decode(self.payload, model)


@dataclass(frozen=True, slots=True)
class RecordedChannel:
    """One key of a recording.

    Attributes:
        key: the key.
        encoding: Zenoh encoding of its samples.
    """

    key: str
    encoding: str


@dataclass(frozen=True, slots=True)
class _ChunkSpan:
    offset: int
    length: int
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class McapRecording:
    """An opened recording; `samples` reads it, as often as wanted.

    Attributes:
        path: the file.
        channels: its keys by the number they have in the file.
        attachments: attached files by name, such as `rig/rig.toml`.
        note: what is missing from a file that was cut off; empty for a complete one.
        start_ns, end_ns: arrival of the first and of the last sample; both 0 in an empty recording.
    """

    path: Path
    channels: dict[int, RecordedChannel]
    attachments: dict[str, bytes]
    note: str
    start_ns: int
    end_ns: int
    _chunks: tuple[_ChunkSpan, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys in the order of their first samples."""
        return tuple(dict.fromkeys(channel.key for channel in self.channels.values()))

    def samples(self, from_ns: int | None = None, to_ns: int | None = None) -> Iterator[RecordedSample]:
        """Yield the samples in the order in which they arrived.

        Args:
            from_ns, to_ns: only samples that arrived in this span, both ends included.

        Raises:
            ConfigError: a chunk is damaged; names the byte.
        """
        first = self.start_ns if from_ns is None else from_ns
        last = self.end_ns if to_ns is None else to_ns
        with _opened(self.path) as stream:
            for span in self._chunks:
                if span.end_ns < first or span.start_ns > last:
                    continue
                for record in _chunk_records(self.path, stream, span):
                    if not isinstance(record, MessageRecord) or not first <= record.log_time <= last:
                        continue
                    channel = self.channels.get(record.channel_id)
                    if channel is None:
                        raise ConfigError(
                            f"{self.path}: damaged: a sample in the chunk at byte {span.offset} belongs to channel "
                            f"{record.channel_id}, which the file does not describe"
                        )
                    yield RecordedSample(
                        channel.key, channel.encoding, record.data, record.publish_time, record.log_time
                    )


def is_mcap(path: Path) -> bool:
    """Tell whether a file begins like an MCAP file.

    Raises:
        ConfigError: it cannot be read.
    """
    with _opened(path) as stream:
        return stream.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC


def open_mcap(path: Path) -> McapRecording:
    """Open a recording and find its chunks, keys and attachments.

    Raises:
        ConfigError: missing, unreadable, not an MCAP file, damaged, or not written in chunks.
    """
    with _opened(path) as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise ConfigError(f"{path}: not an MCAP file; `rhot record` writes such files, their names end in .mcap")
        scan = _scan(path, stream, size)
        if not scan.complete:
            _drop_broken_tail(path, stream, scan)
        if not (scan.complete and scan.channels):
            for span in scan.chunks:
                for record in _chunk_records(path, stream, span):
                    scan.describe(record)
    return McapRecording(
        path=path,
        channels={number: _recorded(channel, scan.schemas) for number, channel in scan.channels.items()},
        attachments=scan.attachments,
        note="" if scan.complete else _cut_off(path, size - scan.end),
        start_ns=min((span.start_ns for span in scan.chunks), default=0),
        end_ns=max((span.end_ns for span in scan.chunks), default=0),
        _chunks=tuple(scan.chunks),
    )


class _Scan:
    """What lies where in a file; `end` is the end of the last complete chunk or, before the first, of what was read."""

    def __init__(self) -> None:
        self.chunks: list[_ChunkSpan] = []
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.attachments: dict[str, bytes] = {}
        self.complete = False
        self.end = len(MCAP0_MAGIC)

    def describe(self, record: Channel | Schema | MessageRecord) -> None:
        if isinstance(record, Channel):
            self.channels.setdefault(record.id, record)
        elif isinstance(record, Schema):
            self.schemas.setdefault(record.id, record)


def _scan(path: Path, stream: IO[bytes], size: int) -> _Scan:
    scan = _Scan()
    offset = len(MCAP0_MAGIC)
    stream.seek(-len(MCAP0_MAGIC), io.SEEK_END)
    ends_whole = size >= 2 * len(MCAP0_MAGIC) and stream.read() == MCAP0_MAGIC
    while offset + _RECORD_HEAD.size <= size:
        stream.seek(offset)
        opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
        body, offset = offset + _RECORD_HEAD.size, offset + _RECORD_HEAD.size + length
        # Opcode 0 does not exist; it is what a file system leaves where it had not written yet.
        if opcode == 0 or offset > size:
            break
        try:
            _take(scan, stream, opcode, body, length)
        except Exception as error:
            raise _damaged(path, body, error) from error
        if opcode == Opcode.FOOTER:
            scan.complete = ends_whole and offset + len(MCAP0_MAGIC) == size
            break
    if ends_whole and not scan.complete:
        raise ConfigError(f"{path}: damaged: its records end at byte {scan.end} of {size}, before the index does")
    return scan


def _take(scan: _Scan, stream: IO[bytes], opcode: int, body: int, length: int) -> None:
    if opcode == Opcode.CHUNK:
        if length > _MAX_CHUNK_BYTES:
            raise ValueError(f"a chunk of {length} bytes is over the limit of {_MAX_CHUNK_BYTES}")
        start_ns, end_ns = _CHUNK_TIMES.unpack(stream.read(_CHUNK_TIMES.size))
        scan.chunks.append(_ChunkSpan(body, length, start_ns, end_ns))
    elif opcode == Opcode.MESSAGE:
        raise ValueError("messages stand outside chunks; only files written in chunks, as `rhot record` does, are read")
    elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
        data = ReadDataStream(io.BytesIO(stream.read(length)))
        scan.describe(Channel.read(data) if opcode == Opcode.CHANNEL else Schema.read(data))
    elif opcode == Opcode.ATTACHMENT:
        attachment = Attachment.read(ReadDataStream(io.BytesIO(stream.read(length))))
        scan.attachments[attachment.name] = attachment.data
    elif opcode not in (Opcode.HEADER, Opcode.METADATA, Opcode.MESSAGE_INDEX):
        return
    scan.end = body + length


def _drop_broken_tail(path: Path, stream: IO[bytes], scan: _Scan) -> None:
    """Forget the last chunk of a cut-off file when its length is there but not all of its bytes were written."""
    if not scan.chunks:
        return
    last = scan.chunks[-1]
    try:
        for _ in _chunk_records(path, stream, last):
            pass
    except ConfigError:
        scan.chunks.pop()
        scan.end = last.offset - _RECORD_HEAD.size


def _chunk_records(path: Path, stream: IO[bytes], span: _ChunkSpan) -> Iterator[Channel | Schema | MessageRecord]:
    stream.seek(span.offset)
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(stream.read(span.length))))
        data, size = get_chunk_data_stream(chunk, validate_crc=True)
        while data.count < size:
            opcode, length = data.read1(), data.read8()
            if opcode == Opcode.MESSAGE:
                yield MessageRecord.read(data, length)
            elif opcode == Opcode.CHANNEL:
                yield Channel.read(data)
            elif opcode == Opcode.SCHEMA:
                yield Schema.read(data)
            else:
                data.read(length)
    except Exception as error:
        # Whatever the decompressors and the record parser raise on wrong bytes: the file is at fault.
        raise _damaged(path, span.offset, error) from error


def _recorded(channel: Channel, schemas: dict[int, Schema]) -> RecordedChannel:
    encoding = channel.metadata.get(ENCODING_METADATA)
    if encoding is None:
        # Written by another program.
        schema = schemas.get(channel.schema_id)
        encoding = f"application/{channel.message_encoding}" + (f";{schema.name}" if schema else "")
    return RecordedChannel(channel.topic, encoding)


def _cut_off(path: Path, lost: int) -> str:
    return (
        f"{path} was cut off: it opens up to its last complete chunk; {lost} bytes after that, at most about a second, "
        "are lost"
    )


def _damaged(path: Path, offset: int, error: Exception) -> ConfigError:
    return ConfigError(
        f"{path}: damaged at byte {offset}: {error or type(error).__name__}; copy it again from where it was recorded"
    )


def _opened(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such recording") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
