"""The messages of a recording, from MCAP or from JSON Lines as `rhot process` writes them."""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, Final

import msgpack
from pydantic import ValidationError

from rhot.errors import ConfigError, WireError
from rhot.messages import Message, first_problem
from rhot.recording.mcap.gaps import Tally
from rhot.recording.mcap.reader import RecordedSample, is_mcap, open_mcap
from rhot.recording.mcap.wire_models import model_of_encoding, model_of_key

_KEY: Final = re.compile(r"rhot(/[A-Za-z0-9_.-]{1,64}){1,3}")
"""Keys of ours. Tables, files and joints are named after them, so that none may act on a terminal or a file system."""


class RecordedMessages:
    """Key and message of everything in a file that is a message of ours; iterable repeatedly.

    Attributes:
        path: the file.
        attachments: files inside an MCAP file, by name.
        invalid: messages left out by the last iteration because they or their keys are not valid, or because there are
            more keys than a rig has.
    """

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            ConfigError: missing, unreadable, or neither MCAP nor JSON Lines.
        """
        self.path = path
        self.invalid = 0
        self._recording = open_mcap(path) if is_mcap(path) else None
        self.attachments = self._recording.attachments if self._recording else {}

    @property
    def note(self) -> str:
        """What is missing from a file that was cut off or is damaged, as far as it was read; empty for a whole one."""
        recording = self._recording
        return "" if recording is None else "; ".join(filter(None, (recording.note, *recording.damage)))

    @property
    def lost(self) -> list[str]:
        """What the last iteration left out, as sentences."""
        invalid = [f"{self.path}: {self.invalid} messages are not valid and are left out"] if self.invalid else []
        return [self.note, *invalid] if self.note else invalid

    def span_ns(self) -> tuple[int, int]:
        """Return the times of the first and the last message: arrival in an MCAP file, else capture; (0, 0) of none."""
        if self._recording is not None:
            return self._recording.start_ns, self._recording.end_ns
        times = [message.t_ns for _, message in self]
        return (min(times), max(times)) if times else (0, 0)

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        """Return the messages in the order of the file."""
        return self._messages_of(self._lines()) if self._recording is None else self._messages()

    def payloads(
        self, keys: Container[str] | None = None, leave_out: type[Message] | None = None
    ) -> Iterator[tuple[str, type[Message], list[bytes]]]:
        """Yield key, model and msgpack payloads of the messages, which are not yet checked; each key's in their order.

        Args:
            keys: only these.
            leave_out: a model whose keys are named alone, without payloads.
        """
        if self._recording is None:
            for number, key, model, value in self._lines():
                if keys is None or key in keys:
                    try:
                        packed = [] if model is leave_out else [msgpack.packb(value)]
                    except (OverflowError, ValueError) as error:
                        # A whole number of more than 64 bits or half of a surrogate pair.
                        raise ConfigError(f"{self.path}, line {number}: {key}: not a message: {error}") from error
                    yield key, model, packed
            return
        self.invalid = 0
        tally = Tally()
        known: dict[int, tuple[str, type[Message]]] = {}
        refused = set()
        for number, channel in self._recording.channels.items():
            model_here = model_of_encoding(channel.encoding)
            if not (_KEY.fullmatch(channel.key) and tally.admits(channel.key, channel.encoding)):
                refused.add(number)
            elif model_here is leave_out and leave_out is not None:
                yield channel.key, leave_out, []
            elif model_here is not None and (keys is None or channel.key in keys):
                known[number] = channel.key, model_here
        for number, payloads in self._recording.payloads(known.keys() | refused):
            if number in refused:
                self.invalid += len(payloads)
            else:
                yield *known[number], payloads

    def _samples(self) -> Iterator[RecordedSample]:
        """Yield what a rig's own keys hold."""
        self.invalid = 0
        tally = Tally()
        assert self._recording is not None
        for sample in self._recording.samples():
            if _KEY.fullmatch(sample.key) and tally.admits(sample.key, sample.encoding):
                yield sample
            else:
                self.invalid += 1

    def _messages(self) -> Iterator[tuple[str, Message]]:
        for sample in self._samples():
            try:
                message = sample.message()
            except WireError:
                self.invalid += 1
                continue
            if isinstance(message, Message):
                yield sample.key, message

    def _lines(self) -> Iterator[tuple[int, str, type[Message], Any]]:
        """Yield number, key, model and value of each line that is a message of ours."""
        self.invalid = 0
        try:
            with self.path.open(encoding="utf-8-sig") as stream:
                yield from self._parsed(stream)
        except UnicodeDecodeError as error:
            raise self._refusal(1, "not text") from error
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {error.strerror or error}") from error

    def _parsed(self, stream: IO[str]) -> Iterator[tuple[int, str, type[Message], Any]]:
        tally = Tally()
        for number, line in enumerate(stream, start=1):
            try:
                entry = json.loads(line)
                key, value = str(entry["key"]), entry["value"]
            except (ValueError, TypeError, KeyError, RecursionError) as error:
                raise self._refusal(number, line.strip()[:60]) from error
            model = model_of_key(key)
            if model is None:
                continue
            if _KEY.fullmatch(key) and tally.admits(key, ""):
                yield number, key, model, value
            else:
                self.invalid += 1

    def _messages_of(self, lines: Iterator[tuple[int, str, type[Message], Any]]) -> Iterator[tuple[str, Message]]:
        for number, key, model, value in lines:
            try:
                yield key, model.model_validate(value)
            except ValidationError as error:
                raise ConfigError(f"{self.path}, line {number}: {key}: {first_problem(error)}") from error

    def _refusal(self, number: int, what: str) -> ConfigError:
        return ConfigError(
            f"{self.path}, line {number}: neither an MCAP file of `rhot record` nor JSON Lines of `rhot process` "
            f'({{"key": ..., "value": ...}} in each line): {what}'
        )


def joined_parts(files: Sequence[Path]) -> list[RecordedMessages]:
    """Return the parts of one recording in order of time.

    Raises:
        ConfigError: they overlap, lie too far apart or carry different rigs, so they are not parts of one recording.
    """
    parts = sorted((RecordedMessages(file) for file in files), key=lambda part: part.span_ns())
    for before, after in pairwise(parts):
        end_ns, start_ns = before.span_ns()[1], after.span_ns()[0]
        apart_s = 1e-9 * (start_ns - end_ns)
        # Between two parts of one recording: a recorder begins the next file within a second. Chosen.
        # By which times may go back from one part to the next: keys arrive later than each other by less.
        if not -500_000_000 <= start_ns - end_ns <= 10_000_000_000:
            how = f"begins {apart_s:.1f} s after the end" if apart_s > 0 else f"begins {-apart_s:.1f} s before the end"
            raise ConfigError(
                f"--join: {after.path} {how} of {before.path}: not parts of one recording; export each alone"
            )
        if before.attachments != after.attachments:
            raise ConfigError(f"--join: {before.path} and {after.path} carry different rigs; export each alone")
    return parts
