"""Reading recordings of `rhot record`, complete or cut off by a crash.

A file that lost its end opens up to its last complete chunk, and `McapRecording.note` says how much is missing. A chunk
that is damaged is left out, and the log says what is lost. The records inside a chunk are decoded one by one, so that a
replay never stalls on a whole chunk. A chunk unpacks to a bounded size, whatever it says of itself.
"""

from __future__ import annotations

import importlib
import io
import logging
import struct
import zlib
from collections.abc import Container, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import IO, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Chunk, ChunkIndex, Footer, Schema
from mcap.records import Message as MessageRecord
from mcap.writer import MCAP0_MAGIC

from rhot.errors import ConfigError
from rhot.messages import Message, decode
from rhot.recording.mcap.wire_models import model_of_encoding
from rhot.recording.mcap.writer import ENCODING_METADATA

_RECORD_HEAD: Final = struct.Struct("<BQ")
_FOOTER_BYTES: Final = _RECORD_HEAD.size + 20
_MESSAGE: Final = struct.Struct("<HIQQ")
"""Channel, sequence number, log and publish time, which a message's data follow."""
_CHUNK_TIMES: Final = struct.Struct("<QQ")
_MAX_CHUNK_BYTES: Final = 1 << 28
"""Of a chunk, packed and unpacked. `rhot record` begins a new one every second; pictures are not in it."""

logger = logging.getLogger(__name__)


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


class _DamagedError(ConfigError):
    """A chunk that cannot be read; the others can."""


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
    _damaged: dict[int, str] = field(default_factory=dict)

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys in the order of their first samples."""
        return tuple(dict.fromkeys(channel.key for channel in self.channels.values()))

    @property
    def damage(self) -> tuple[str, ...]:
        """What of its chunks could not be read, as far as they have been."""
        return tuple(self._damaged.values())

    def samples(self, from_ns: int | None = None, to_ns: int | None = None) -> Iterator[RecordedSample]:
        """Yield the samples in the order in which they arrived; what is damaged is left out, and the log says so once.

        Args:
            from_ns, to_ns: only samples that arrived in this span, both ends included.

        Raises:
            ConfigError: the file cannot be opened any more.
        """
        first = self.start_ns if from_ns is None else from_ns
        last = self.end_ns if to_ns is None else to_ns
        with _opened(self.path) as stream:
            for span in self._chunks:
                if span.end_ns < first or span.start_ns > last:
                    continue
                try:
                    for record in _chunk_records(self.path, stream, span):
                        if isinstance(record, MessageRecord) and first <= record.log_time <= last:
                            yield self._sample(record, span)
                except _DamagedError as error:
                    self._warn(span, error)

    def payloads(self, channels: Container[int]) -> Iterator[tuple[int, list[bytes]]]:
        """Yield the payloads of some channels, a list for each chunk and channel, in the order in which they arrived.

        A tenth of the time of `samples`, for who needs no times of arrival; what is damaged is left out alike.

        Args:
            channels: their numbers in the file.

        Raises:
            ConfigError: the file cannot be opened any more.
        """
        with _opened(self.path) as stream:
            for span in self._chunks:
                found: dict[int, list[bytes]] = {}
                try:
                    _gather(self.path, stream, span, channels, found)
                except _DamagedError as error:
                    self._warn(span, error)
                yield from found.items()

    def _warn(self, span: _ChunkSpan, error: _DamagedError) -> None:
        self._damaged[span.offset] = str(error)
        _warn_once(str(error))

    def _sample(self, record: MessageRecord, span: _ChunkSpan) -> RecordedSample:
        channel = self.channels.get(record.channel_id)
        if channel is None:
            raise _damaged(self.path, span, f"no channel {record.channel_id} is described")
        return RecordedSample(channel.key, channel.encoding, record.data, record.publish_time, record.log_time)


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
                try:
                    for record in _chunk_records(path, stream, span):
                        scan.describe(record)
                except _DamagedError:
                    # Said when its samples are read.
                    continue
    return McapRecording(
        path=path,
        channels={number: _recorded(channel, scan.schemas) for number, channel in scan.channels.items()},
        attachments=scan.attachments,
        note="" if scan.complete else _incomplete(path, scan, size - scan.end),
        start_ns=min((span.start_ns for span in scan.chunks), default=0),
        end_ns=max((span.end_ns for span in scan.chunks), default=0),
        _chunks=tuple(scan.chunks),
    )


@cache
def _warn_once(text: str) -> None:
    """Log what is damaged, once however often and by how many the file is read."""
    logger.warning("%s", text)


class _Scan:
    """What lies where in a file; `end` is the end of the last complete chunk or, before the first, of what was read.

    A file that `ends_whole` without being complete is damaged before its end; others were cut off.
    """

    def __init__(self) -> None:
        self.chunks: list[_ChunkSpan] = []
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.attachments: dict[str, bytes] = {}
        self.complete = False
        self.ends_whole = False
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
    scan.ends_whole = size >= 2 * len(MCAP0_MAGIC) and stream.read() == MCAP0_MAGIC
    problem: ConfigError | None = None
    while offset + _RECORD_HEAD.size <= size:
        stream.seek(offset)
        opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
        body, offset = offset + _RECORD_HEAD.size, offset + _RECORD_HEAD.size + length
        # Opcode 0 does not exist; it is what a file system leaves where it had not written yet.
        if opcode == 0 or offset > size:
            break
        try:
            _add_record(scan, stream, opcode, body, length)
        except Exception as error:
            problem = _unreadable(path, body, error)
            break
        if opcode == Opcode.FOOTER:
            scan.complete = scan.ends_whole and offset + len(MCAP0_MAGIC) == size
            break
    if scan.ends_whole and not scan.complete:
        try:
            indexed = _scan_summary(path, stream, size)
        except ConfigError as error:
            problem = problem or error
        else:
            # Bytes that were added or are missing before it make the index point to nothing.
            if len(indexed.chunks) >= len(scan.chunks):
                return indexed
    if problem is not None and not scan.chunks:
        raise problem
    return scan


def _scan_summary(path: Path, stream: IO[bytes], size: int) -> _Scan:
    """Return what the index at the file's end says, where the records before it are damaged.

    Raises:
        ConfigError: the index is damaged, too.
    """
    scan = _Scan()
    try:
        footer_at = size - len(MCAP0_MAGIC) - _FOOTER_BYTES
        stream.seek(footer_at + _RECORD_HEAD.size)
        start = Footer.read(ReadDataStream(io.BytesIO(stream.read(_FOOTER_BYTES - _RECORD_HEAD.size)))).summary_start
        if not 0 < start < footer_at or footer_at - start > _MAX_CHUNK_BYTES:
            raise ValueError("its index is not where the file's end says")
        stream.seek(start)
        data = ReadDataStream(io.BytesIO(stream.read(footer_at - start)))
        while data.count < footer_at - start:
            opcode, length = data.read1(), data.read8()
            body = ReadDataStream(io.BytesIO(data.read(length)))
            if opcode == Opcode.CHUNK_INDEX:
                _add_indexed(scan, ChunkIndex.read(body))
            elif opcode == Opcode.CHANNEL:
                scan.describe(Channel.read(body))
            elif opcode == Opcode.SCHEMA:
                scan.describe(Schema.read(body))
            elif opcode == Opcode.ATTACHMENT_INDEX:
                index = AttachmentIndex.read(body)
                stream.seek(index.offset + _RECORD_HEAD.size)
                attachment = Attachment.read(
                    ReadDataStream(io.BytesIO(stream.read(min(index.length, _MAX_CHUNK_BYTES))))
                )
                scan.attachments[attachment.name] = attachment.data
    except Exception as error:
        raise _unreadable(path, scan.end, error) from error
    scan.complete, scan.end = True, size
    return scan


def _add_indexed(scan: _Scan, index: ChunkIndex) -> None:
    if index.chunk_length > _MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {index.chunk_length} bytes is over the limit of {_MAX_CHUNK_BYTES}")
    offset, length = index.chunk_start_offset + _RECORD_HEAD.size, index.chunk_length - _RECORD_HEAD.size
    scan.chunks.append(_ChunkSpan(offset, length, index.message_start_time, index.message_end_time))


def _add_record(scan: _Scan, stream: IO[bytes], opcode: int, body: int, length: int) -> None:
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
    except _DamagedError:
        scan.chunks.pop()
        scan.end = last.offset - _RECORD_HEAD.size


def _chunk_records(path: Path, stream: IO[bytes], span: _ChunkSpan) -> Iterator[Channel | Schema | MessageRecord]:
    stream.seek(span.offset)
    try:
        chunk = Chunk.read(ReadDataStream(io.BytesIO(stream.read(span.length))))
        unpacked = _unpacked(chunk)
        for opcode, body, end in _records(unpacked):
            if opcode == Opcode.MESSAGE:
                # By hand: mcap's own reader takes ten times as long, and there are hundreds a second.
                channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(unpacked, body)
                yield MessageRecord(channel, log_ns, unpacked[body + _MESSAGE.size : end], publish_ns, sequence)
            elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
                record = ReadDataStream(io.BytesIO(unpacked[body:end]))
                yield Channel.read(record) if opcode == Opcode.CHANNEL else Schema.read(record)
    except Exception as error:
        # Whatever the decompressors and the record parser raise on wrong bytes: the file is at fault.
        raise _damaged(path, span, str(error) or type(error).__name__) from error


def _records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield of each record of an unpacked chunk its opcode, and where its content begins and ends.

    Raises:
        ValueError: a record ends after its chunk.
    """
    end = 0
    while end < len(data):
        opcode, length = _RECORD_HEAD.unpack_from(data, end)
        body = end + _RECORD_HEAD.size
        end = body + length
        if end > len(data):
            raise ValueError("a record ends after its chunk")
        yield opcode, body, end


def _gather(
    path: Path, stream: IO[bytes], span: _ChunkSpan, channels: Container[int], found: dict[int, list[bytes]]
) -> None:
    """Add a chunk's payloads of some channels to the lists by channel."""
    stream.seek(span.offset)
    try:
        data = _unpacked(Chunk.read(ReadDataStream(io.BytesIO(stream.read(span.length)))))
        for opcode, body, end in _records(data):
            if opcode == Opcode.MESSAGE:
                number = data[body] | data[body + 1] << 8
                if number in channels:
                    found.setdefault(number, []).append(data[body + _MESSAGE.size : end])
    except Exception as error:
        raise _damaged(path, span, str(error) or type(error).__name__) from error


def _unpacked(chunk: Chunk) -> bytes:
    """Return a chunk's records; no more memory is used than `_MAX_CHUNK_BYTES`, whatever the chunk says of itself.

    Raises:
        ValueError: larger, not of the size that it states, or its checksum does not fit.
    """
    most = min(chunk.uncompressed_size, _MAX_CHUNK_BYTES) + 1
    if chunk.compression == "":
        data = bytes(chunk.data)
    elif chunk.compression == "lz4":
        data = importlib.import_module("lz4.frame").LZ4FrameDecompressor().decompress(chunk.data, max_length=most)
    elif chunk.compression == "zstd":
        packed = io.BytesIO(chunk.data)
        with importlib.import_module("zstandard").ZstdDecompressor().stream_reader(packed) as reader:
            data = reader.read(most)
    else:
        raise ValueError(f"its compression {chunk.compression[:40]!r} is not known")
    if len(data) != chunk.uncompressed_size:
        more = "more than " if len(data) >= most else ""
        raise ValueError(f"unpacks to {more}{len(data) - bool(more)} bytes in place of {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("its checksum does not fit")
    return data


def _recorded(channel: Channel, schemas: dict[int, Schema]) -> RecordedChannel:
    encoding = channel.metadata.get(ENCODING_METADATA)
    if encoding is None:
        # Written by another program.
        schema = schemas.get(channel.schema_id)
        encoding = f"application/{channel.message_encoding}" + (f";{schema.name}" if schema else "")
    return RecordedChannel(channel.topic, encoding)


def _incomplete(path: Path, scan: _Scan, lost: int) -> str:
    if scan.ends_whole:
        return (
            f"{path}: damaged at byte {scan.end}: it opens up to there, the {lost} bytes after that are lost; copy it "
            "again from where it was recorded"
        )
    return f"{path} was cut off: it opens up to its last complete chunk; the {lost} bytes after that are lost"


def _damaged(path: Path, span: _ChunkSpan, why: str) -> _DamagedError:
    lasts_s = max(span.end_ns - span.start_ns, 0) * 1e-9
    return _DamagedError(
        f"{path}: damaged at byte {span.offset}: {why}; {lasts_s:.1f} s from there are left out. Copy the file again "
        "from where it was recorded"
    )


def _unreadable(path: Path, offset: int, error: Exception) -> ConfigError:
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
