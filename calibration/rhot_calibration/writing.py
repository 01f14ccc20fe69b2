"""Writing what a calibration command found into the rig folder."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel
from rich.console import Console

from rhot.atomic_file import write_atomic
from rhot.rig import write_json_model


def write_found(
    console: Console, file: Path, found: BaseModel, before: BaseModel | None, *, dry_run: bool, then: str
) -> None:
    """Write a file of the rig folder, keep the one before as NAME.previous.json, and say so.

    Args:
        console: where it is said.
        file: of the rig folder.
        found: what is to stand in it.
        before: what stood there; None where nothing did.
        dry_run: write nothing.
        then: who takes it, and when.

    Raises:
        ConfigError: the folder cannot be written.
    """
    if dry_run:
        console.print(f"nothing was written (--dry-run); {file} is as before")
        return
    if before is not None:
        write_json_model(file.with_suffix(".previous.json"), before)
    write_json_model(file, found)
    console.print(f"written: {file}; {then}")


def replace_found(console: Console, file: Path, found: BaseModel, then: str) -> None:
    """Write a file of the rig folder whatever stood there, keep that as NAME.previous.json, and say so.

    Args:
        console: where it is said.
        file: of the rig folder.
        found: what is to stand in it.
        then: who takes it, and when.

    Raises:
        ConfigError: the folder cannot be written.
    """
    kept = ""
    if file.exists():
        # As it is: one that cannot be read is replaced, too.
        previous = file.with_suffix(".previous.json")
        write_atomic(previous, file.read_bytes())
        kept = f"; the one before is {previous}"
    write_json_model(file, found)
    console.print(f"written: {file}{kept}. {then}", markup=False, highlight=False)
