"""MCAP files: what goes in comes out, whoever reads it, whatever happened to the file."""

from __future__ import annotations

import asyncio
import json
import resource
import shutil
import struct
import tracemalloc
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import cast

import lz4.frame  # type: ignore[import-untyped]
import msgpack
import numpy as np
import pytest
import zstandard
from hand_messages import hand_pose, marker_frame, object_pose
from machine.power_cut import Disk, Loss
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from mcap.writer import MCAP0_MAGIC

from rhot.bus import EventSubscriber, Sample
from rhot.errors import ConfigError
from rhot.messages import HandPose, MarkerFrame, Message, encode, encoding_of, with_seq
from rhot.recording.mcap import session
from rhot.recording.mcap.gaps import Tally, peek
from rhot.recording.mcap.reader import RecordedSample, open_mcap
from rhot.recording.mcap.writer import McapWriter, rig_files

BEGIN_NS = 1_800_000_000_000_000_000
FRAME_NS = 10_000_000
CONFIG = RecordedSample("rhot/config/fusion/main", "application/json", b'{"hold_s": 1}', BEGIN_NS, BEGIN_NS)


def recorded(key: str, message: Message, log_ns: int) -> RecordedSample:
    return RecordedSample(key, encoding_of(type(message)), encode(message), message.t_ns, log_ns)


def samples(frames: int = 50) -> list[RecordedSample]:
    made = [CONFIG]
    for frame in range(frames):
        t_ns = BEGIN_NS + frame * FRAME_NS
        made += [
            recorded("rhot/markers/left", with_seq(marker_frame("left", t_ns), frame), t_ns + 2_000_000),
            recorded("rhot/hand/right", with_seq(hand_pose(0.01 * frame, t_ns), frame), t_ns + 4_000_000),
            recorded("rhot/object/cube", with_seq(object_pose(t_ns, 0.001 * frame), frame), t_ns + 4_500_000),
        ]
    return made


def write(file: Path, wanted: list[RecordedSample], flush_every: int = 30, **options: object) -> list[Path]:
    with McapWriter(file, now_ns=BEGIN_NS, **options) as writer:  # type: ignore[arg-type]
        for number, sample in enumerate(wanted):
            is_message = sample.encoding != "application/json"
            t_ns, seq = peek(sample.payload) if is_message else (None, None)
            writer.write(sample.key, sample.encoding, sample.payload, t_ns, seq, sample.log_ns)
            if number % flush_every == flush_every - 1:
                writer.flush()
    return writer.files


def test_what_is_written_is_read_byte_by_byte(tmp_path: Path) -> None:
    wanted = samples()
    write(tmp_path / "a.mcap", wanted)
    recording = open_mcap(tmp_path / "a.mcap")
    assert list(recording.samples()) == wanted
    assert recording.note == ""
    assert (recording.start_ns, recording.end_ns) == (wanted[0].log_ns, wanted[-1].log_ns)
    assert set(recording.keys) == {sample.key for sample in wanted}


def test_messages_come_as_models_and_other_payloads_as_bytes(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", samples(2))
    found = list(open_mcap(tmp_path / "a.mcap").samples())
    assert [type(sample.message()) for sample in found[:3]] == [bytes, MarkerFrame, HandPose]
    hand = found[2]
    assert (hand.key, hand.t_ns, hand.log_ns) == ("rhot/hand/right", BEGIN_NS, BEGIN_NS + 4_000_000)
    assert hand.message() == with_seq(hand_pose(0.0, BEGIN_NS), 0)


def test_a_span_of_time_is_cut_out(tmp_path: Path) -> None:
    wanted = samples()
    write(tmp_path / "a.mcap", wanted)
    first, last = BEGIN_NS + 100_000_000, BEGIN_NS + 200_000_000
    cut = list(open_mcap(tmp_path / "a.mcap").samples(first, last))
    assert cut == [sample for sample in wanted if first <= sample.log_ns <= last]
    assert len(cut) == 30


def test_a_reader_that_knows_nothing_of_ours_finds_schemas_messages_and_the_rig(
    tmp_path: Path, rig_folder: Path
) -> None:
    wanted = samples()
    write(tmp_path / "a.mcap", wanted, attachments=rig_files(rig_folder))
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == len(wanted)
        assert len(summary.channels) == 4, "one channel a key"
        entries = list(reader.iter_messages())
        (attachment,) = reader.iter_attachments()
    assert attachment.name == "rig/rig.toml"
    assert attachment.data == (rig_folder / "rig.toml").read_bytes()
    assert [(channel.topic, message.data) for _, channel, message in entries] == [(s.key, s.payload) for s in wanted]
    for schema, channel, message in entries:
        if schema is None:
            assert (channel.topic, channel.message_encoding) == (CONFIG.key, "json")
            continue
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "msgpack")
        document, value = json.loads(schema.data), msgpack.unpackb(message.data)
        assert document["title"] == schema.name
        assert set(document["required"]) <= set(value) <= set(document["properties"])
        assert message.publish_time == value["t_ns"]
        assert message.sequence == value["seq"]


def test_a_recording_that_was_cut_off_opens_up_to_its_last_complete_chunk(tmp_path: Path) -> None:
    wanted, file, cut = samples(), tmp_path / "a.mcap", tmp_path / "cut.mcap"
    write(file, wanted, flush_every=30)
    whole = file.read_bytes()
    seen = set()
    for size in np.linspace(len(whole) - 1, 9, 60, dtype=int).tolist():
        cut.write_bytes(whole[:size])
        recording = open_mcap(cut)
        found = list(recording.samples())
        assert found == wanted[: len(found)]
        assert len(found) % 30 == 0 or len(found) == len(wanted), "whole chunks only"
        assert "was cut off" in recording.note
        seen.add(len(found))
    assert seen >= {0, 30, 60, 90, 120, len(wanted)}


def third_chunk(file: Path) -> ChunkIndex:
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes[2]


@pytest.mark.parametrize("step", [10_000, -700], ids=["added", "missing"])
def test_bytes_that_were_added_or_are_missing_cost_what_follows_them(tmp_path: Path, step: int) -> None:
    """The index at the end still reads well then, and points to nothing."""
    wanted, file = samples(), tmp_path / "a.mcap"
    write(file, wanted, flush_every=30)
    content = bytearray(file.read_bytes())
    chunk_at = third_chunk(file).chunk_start_offset
    at = chunk_at + 100
    content[at : at - min(step, 0)] = content[at : at + max(step, 0)] * 2
    file.write_bytes(content)
    recording = open_mcap(file)
    assert list(recording.samples()) == wanted[:60]
    assert f"damaged at byte {chunk_at}" in "".join((recording.note, *recording.damage))


def test_what_a_file_system_had_not_written_counts_as_lost(tmp_path: Path) -> None:
    """After a power failure a file may have its length, but zeros where its last bytes belong."""
    wanted, file = samples(), tmp_path / "a.mcap"
    write(file, wanted, flush_every=30)
    whole = file.read_bytes()
    kept = third_chunk(file).chunk_start_offset + 100
    file.write_bytes(whole[:kept] + bytes(len(whole) - kept))
    recording = open_mcap(file)
    assert list(recording.samples()) == wanted[:60]
    assert "was cut off" in recording.note


@pytest.mark.parametrize("at_share", [0.5, None], ids=["in its content", "in its length"])
def test_one_damaged_chunk_costs_that_chunk_alone(
    tmp_path: Path, at_share: float | None, caplog: pytest.LogCaptureFixture
) -> None:
    wanted, file = samples(), tmp_path / "a.mcap"
    write(file, wanted, flush_every=30)
    content = bytearray(file.read_bytes())
    chunk = third_chunk(file)
    at = 7 if at_share is None else round(at_share * chunk.chunk_length)
    content[chunk.chunk_start_offset + at] ^= 0xFF
    file.write_bytes(content)
    recording = open_mcap(file)
    found = list(recording.samples())
    assert list(recording.samples()) == found
    said = [record.getMessage() for record in caplog.records]
    if at_share is None:
        assert found == wanted, "the index at the end says where everything is"
        assert not said
    else:
        assert found == wanted[:60] + wanted[90:], "all but the third chunk"
        assert len(said) == 1
        assert "0.1 s from there are left out" in said[0]


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("honest", [True, False])
def test_a_chunk_that_unpacks_to_gigabytes_is_left_out(
    tmp_path: Path, compression: str, honest: bool, caplog: pytest.LogCaptureFixture
) -> None:
    size = 3 << 30
    if compression == "zstd":
        packer = zstandard.ZstdCompressor().compressobj()
        packed = b"".join([packer.compress(bytes(1 << 24)) for _ in range(size >> 24)]) + packer.flush()
    else:
        with lz4.frame.LZ4FrameCompressor() as frame:
            packed = frame.begin() + b"".join([frame.compress(bytes(1 << 24)) for _ in range(size >> 24)])
            packed += frame.flush()
    name = compression.encode()
    stated = size if honest else 1000
    body = struct.pack("<QQQIL", 1, 2, stated, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    file = tmp_path / "bomb.mcap"
    file.write_bytes(MCAP0_MAGIC + b"\x06" + struct.pack("<Q", len(body)) + body)
    tracemalloc.start()
    assert list(open_mcap(file).samples()) == []
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1.2e9


def damaged_files() -> Iterator[tuple[str, bytes | None, str]]:
    yield "absent", None, "no such recording"
    yield "empty", b"", "not an MCAP file"
    yield "picture", b"\x89PNG\r\n\x1a\n" + bytes(100), "not an MCAP file"
    yield "text", b'{"key": 1}\n', "not an MCAP file"


@pytest.mark.parametrize(("name", "content", "says"), list(damaged_files()), ids=lambda value: str(value)[:12])
def test_foreign_files_end_in_one_error(tmp_path: Path, name: str, content: bytes | None, says: str) -> None:
    file = tmp_path / f"{name}.mcap"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ConfigError, match=says):
        open_mcap(file)


def test_flipped_bytes_are_an_error_of_ours_or_change_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    wanted, file, bad = samples(20), tmp_path / "a.mcap", tmp_path / "bad.mcap"
    write(file, wanted)
    whole = file.read_bytes()
    rng = np.random.default_rng(3)
    refused = 0
    caplog.set_level("CRITICAL")
    for _ in range(150):
        content = bytearray(whole)
        content[int(rng.integers(8, len(whole)))] ^= int(rng.integers(1, 256))
        bad.write_bytes(content)
        try:
            recording = open_mcap(bad)
            found = list(recording.samples())
        except ConfigError as error:
            assert str(bad) in str(error)
            refused += 1
        else:
            # A name or a time outside the chunks may have changed; payloads cannot.
            assert {sample.payload for sample in found} <= {sample.payload for sample in wanted}
            refused += len(found) < len(wanted)
    assert refused > 75


def test_files_follow_each_other_by_size_and_each_opens_alone(tmp_path: Path, rig_folder: Path) -> None:
    wanted = samples(200)
    attachments = rig_files(rig_folder)
    files = write(tmp_path / "a.mcap", wanted, max_bytes=100_000, attachments=attachments)
    assert [file.name for file in files] == [f"a-{number:03d}.mcap" for number in range(1, len(files) + 1)]
    assert len(files) > 2
    parts = [open_mcap(file) for file in files]
    assert [sample for part in parts for sample in part.samples()] == wanted
    assert all(part.attachments == attachments for part in parts)
    assert all(file.stat().st_size < 150_000 for file in files)


def test_a_full_disk_is_one_clear_error_and_what_was_written_opens(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(ConfigError, match=r"cannot be written any more: .*make room.*last complete chunk"):
            write(tmp_path / "a.mcap", samples(400))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    recording = open_mcap(tmp_path / "a.mcap")
    assert len(list(recording.samples())) > 60
    assert "was cut off" in recording.note


def test_a_power_cut_costs_what_was_written_since_the_last_sync(tmp_path: Path) -> None:
    disk = Disk(tmp_path)
    wanted = samples(50)
    with disk.watched():
        writer = McapWriter(tmp_path / "a.mcap", now_ns=BEGIN_NS)
        for sample in wanted:
            writer.write(sample.key, sample.encoding, sample.payload, sample.t_ns, None, sample.log_ns)
        writer.flush()
        writer.sync()
    disk.lose(Loss.CONTENT)
    assert len(list(open_mcap(tmp_path / "a.mcap").samples())) == len(wanted)


def test_a_file_deleted_while_it_is_written_is_an_error(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    writer = McapWriter(folder / "a.mcap", now_ns=BEGIN_NS)
    for sample in samples(3):
        writer.write(sample.key, sample.encoding, sample.payload, sample.t_ns, None, sample.log_ns)
    writer.flush()
    shutil.rmtree(folder)
    with pytest.raises(ConfigError, match=r"a\.mcap: was deleted while it was written"):
        writer.flush()


class NoSamples:
    """A mailbox that nothing comes to."""

    def __init__(self) -> None:
        self._closed = asyncio.Event()

    def close(self) -> None:
        self._closed.set()

    async def __aiter__(self) -> AsyncIterator[Sample]:
        await self._closed.wait()
        nothing: list[Sample] = []
        for sample in nothing:
            yield sample


async def test_a_recording_is_synced_while_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "_SYNC_S", 0.01)
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()

    class Writer(McapWriter):
        def sync(self) -> None:
            super().sync()
            loop.call_soon_threadsafe(stop.set)

    with Writer(tmp_path / "a.mcap", now_ns=0) as writer:
        mailbox = cast(EventSubscriber, NoSamples())
        async with asyncio.timeout(30.0):
            await session.record(mailbox, writer, Tally(), stop, on_beat=lambda: None)


def test_more_keys_than_mcap_can_number_are_one_clear_error(tmp_path: Path) -> None:
    with (
        pytest.raises(ConfigError, match="65535 keys at most"),
        McapWriter(tmp_path / "a.mcap", now_ns=0) as writer,
    ):
        for number in range(1 << 16):
            writer.write(f"rhot/x/{number}", "a/b", b"", None, None, number)


def test_nothing_is_overwritten_and_an_impossible_place_is_named(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", samples(1))
    before = (tmp_path / "a.mcap").read_bytes()
    with pytest.raises(ConfigError, match="exists already"):
        McapWriter(tmp_path / "a.mcap", now_ns=0)
    assert (tmp_path / "a.mcap").read_bytes() == before
    with pytest.raises(ConfigError, match=r"nowhere.*cannot be written"):
        McapWriter(tmp_path / "nowhere" / "a.mcap", now_ns=0)
