"""Writing what a calibration command found into the rig folder."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel
from rich.console import Console

from rhot.atomic_file import write_atomic
from rhot.rig import write_json_model


def write_found(
    console: Console, file: Path, found: BaseModel, then: str, *, before: Path | None = None, dry_run: bool = False
) -> None:
    """Write a file of the rig folder, keep the one that it replaces as NAME.previous.json, and say so.

    Args:
        console: where it is said.
        file: of the rig folder.
        found: what is to stand in it.
        then: who takes it, and when; a sentence.
        before: the file that it replaces, where that has another name.
        dry_run: write nothing.

    Raises:
        ConfigError: the folder cannot be written.
    """
    if dry_run:
        console.print(f"nothing was written (--dry-run); {file} is as before", markup=False, highlight=False)
        return
    replaced, kept = before or file, ""
    if replaced.exists():
        # Byte by byte: one that cannot be read is replaced, too.
        previous = file.with_suffix(".previous.json")
        write_atomic(previous, replaced.read_bytes())
        kept = f"; the one before is {previous}"
    write_json_model(file, found)
    console.print(f"written: {file}{kept}. {then}", markup=False, highlight=False)
