"""The messages of a recording, from MCAP or from JSON Lines as `rhot process` writes them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import IO, Final

from pydantic import ValidationError

from rhot.errors import ConfigError, WireError
from rhot.messages import Message, first_problem
from rhot.recording.mcap.gaps import Tally
from rhot.recording.mcap.reader import RecordedSample, is_mcap, open_mcap
from rhot.recording.mcap.wire_models import model_of_key

_KEY: Final = re.compile(r"rhot(/[A-Za-z0-9_.-]{1,64}){1,3}")
"""Keys of ours. Tables, files and joints are named after them, so that none may act on a terminal or a file system."""


class RecordedMessages:
    """Key and message of everything in a file that is a message of ours; iterable repeatedly.

    Attributes:
        path: the file.
        attachments: files inside an MCAP file, by name.
        note: what is missing from a file that was cut off; empty for a complete one.
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
        self.note = self._recording.note if self._recording else ""

    def span_ns(self) -> tuple[int, int]:
        """Return the times of the first and the last message: arrival in an MCAP file, else capture; (0, 0) of none."""
        if self._recording is not None:
            return self._recording.start_ns, self._recording.end_ns
        times = [message.t_ns for _, message in self]
        return (min(times), max(times)) if times else (0, 0)

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        """Return the messages in the order of the file."""
        self.invalid = 0
        return self._from_lines() if self._recording is None else self._from_samples(self._recording.samples())

    def _from_samples(self, samples: Iterator[RecordedSample]) -> Iterator[tuple[str, Message]]:
        tally = Tally()
        for sample in samples:
            if not (_KEY.fullmatch(sample.key) and tally.admits(sample.key, sample.encoding)):
                self.invalid += 1
                continue
            try:
                message = sample.message()
            except WireError:
                self.invalid += 1
                continue
            if isinstance(message, Message):
                yield sample.key, message

    def _from_lines(self) -> Iterator[tuple[str, Message]]:
        try:
            with self.path.open(encoding="utf-8-sig") as stream:
                yield from self._parsed(stream)
        except UnicodeDecodeError as error:
            raise self._refusal(1, "not text") from error
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {error.strerror or error}") from error

    def _parsed(self, stream: IO[str]) -> Iterator[tuple[str, Message]]:
        tally = Tally()
        for number, line in enumerate(stream, start=1):
            try:
                entry = json.loads(line)
                key, value = entry["key"], json.dumps(entry["value"])
            except (ValueError, TypeError, KeyError, RecursionError) as error:
                raise self._refusal(number, line.strip()[:60]) from error
            model = model_of_key(str(key))
            if model is None:
                continue
            if not (_KEY.fullmatch(str(key)) and tally.admits(str(key), "")):
                self.invalid += 1
                continue
            try:
                # From text: strict models take a JSON array for a tuple only there.
                yield str(key), model.model_validate_json(value)
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
