"""Files of figures, as the measuring commands leave them with `--json`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from rhot.errors import ConfigError
from rhot.rig.folder import read_json_model
from rhot_tools.measures.rows import Row


class _Model(BaseModel):
    """Part of a file; commands may say more than is read here."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Machine(_Model):
    """What the figures were measured on; see `rhot_tools.measures.provenance`."""

    cpu: str
    cores: int
    system: str
    load: float | None = None


class Run(_Model):
    """Where the figures come from; see `rhot_tools.measures.provenance`."""

    command_line: str
    date: str
    machine: Machine
    versions: dict[str, str | None]
    commit: str | None = None


class Figure(_Model):
    """One figure; see `rhot_bench.measures.rows.Row`. None = could not be measured."""

    name: str
    value: float | None
    unit: str = ""
    most: float | None = None
    least: float | None = None
    peer: str = ""
    note: str = ""

    @property
    def row(self) -> Row:
        """The figure as it is shown."""
        value = math.nan if self.value is None else self.value
        return Row(self.name, value, self.unit, self.most, self.least, self.peer, self.note)


class Table(_Model):
    """Figures that belong together."""

    title: str
    rows: tuple[Figure, ...]


class Results(_Model):
    """Everything one run of a command measured."""

    version: Literal[1]
    command: str
    run: Run
    sections: tuple[Table, ...]


def load_results(folder: Path) -> dict[str, Results]:
    """Return every file of figures in a folder by its name without `.json`, in order of names.

    Raises:
        ConfigError: there is none, or one is not what the measuring commands write.
    """
    files = sorted(folder.glob("*.json")) if folder.is_dir() else []
    if not files:
        raise ConfigError(f"{folder}: holds no *.json; make some with `rhot bench --json {folder}/bench.json`")
    return {file.stem: read_json_model(file, Results, ConfigError) for file in files}
