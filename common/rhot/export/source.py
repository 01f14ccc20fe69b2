"""The messages of a recording, from MCAP or from JSON Lines as `rhot process` writes them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from pydantic import ValidationError

from rhot.errors import ConfigError, WireError
from rhot.messages import Message, first_problem
from rhot.recording.mcap.reader import RecordedSample, is_mcap, open_mcap
from rhot.recording.mcap.wire_models import model_of_key


class RecordedMessages:
    """Key and message of everything in a file that is a message of ours; iterable repeatedly.

    Attributes:
        path: the file.
        attachments: files inside an MCAP file, by name.
        note: what is missing from a file that was cut off; empty for a complete one.
        invalid: messages left out by the last iteration because they are not valid.
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

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        """Return the messages in the order of the file."""
        self.invalid = 0
        return self._from_lines() if self._recording is None else self._from_samples(self._recording.samples())

    def _from_samples(self, samples: Iterator[RecordedSample]) -> Iterator[tuple[str, Message]]:
        for sample in samples:
            try:
                message = sample.message()
            except WireError:
                self.invalid += 1
                continue
            if isinstance(message, Message):
                yield sample.key, message

    def _from_lines(self) -> Iterator[tuple[str, Message]]:
        try:
            with self.path.open(encoding="utf-8") as stream:
                yield from self._parsed(stream)
        except UnicodeDecodeError as error:
            raise self._refusal(1, "not text") from error
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {error.strerror or error}") from error

    def _parsed(self, stream: IO[str]) -> Iterator[tuple[str, Message]]:
        for number, line in enumerate(stream, start=1):
            try:
                entry = json.loads(line)
                key, value = entry["key"], json.dumps(entry["value"])
            except (ValueError, TypeError, KeyError, RecursionError) as error:
                raise self._refusal(number, line.strip()[:60]) from error
            model = model_of_key(str(key))
            if model is None:
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
