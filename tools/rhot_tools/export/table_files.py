"""Tables as CSV and as Parquet files: `t_s`, `t_ns`, then the columns of the table."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rhot.atomic_file import replacing, why
from rhot.errors import ConfigError
from rhot.plugins import load_library
from rhot_tools.export.columns import Table


def write_csv(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """Write one CSV file a table; numbers in full precision, a missing one as an empty cell.

    Raises:
        ConfigError: the folder cannot be written.
    """
    origin_ns = _origin_ns(tables)
    files = []
    for table in tables:
        file = _file(folder, table, ".csv")
        with replacing(file) as part, part.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(["t_s", "t_ns", *table.columns])
            for row in table.order():
                t_ns = table.t_ns[row]
                cells = [_cell(column[row], name in table.whole) for name, column in table.columns.items()]
                writer.writerow([f"{(t_ns - origin_ns) / 1e9:.9f}", t_ns, *cells])
        files.append(file)
    return files


def write_parquet(folder: Path, tables: Sequence[Table]) -> list[Path]:
    """Write one Parquet file a table; a missing value is null.

    Raises:
        ConfigError: pyarrow is not installed, or the folder cannot be written.
    """
    arrow, parquet = (load_library(name, "--parquet", "parquet") for name in ("pyarrow", "pyarrow.parquet"))
    origin_ns = _origin_ns(tables)
    files = []
    for table in tables:
        file = _file(folder, table, ".parquet")
        order = np.array(table.order(), dtype=np.int64)
        t_ns = np.array(table.t_ns)[order]
        columns = {"t_s": (t_ns - origin_ns) / 1e9, "t_ns": t_ns}
        for name, column in table.columns.items():
            if isinstance(column, list):
                columns[name] = arrow.array([column[row] or None for row in order], arrow.string())
            else:
                numbers = arrow.array(np.array(column)[order], from_pandas=True)
                columns[name] = numbers.cast(arrow.int64()) if name in table.whole else numbers
        with replacing(file) as part:
            parquet.write_table(arrow.table(columns), part)
        files.append(file)
    return files


def _origin_ns(tables: Sequence[Table]) -> int:
    """Return where `t_s` is 0 in all tables: the earliest row of any."""
    return min((min(table.t_ns) for table in tables if len(table.t_ns)), default=0)


def _file(folder: Path, table: Table, suffix: str) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {why(error)}") from error
    return folder / f"{table.name}{suffix}"


def _cell(value: float | str, whole: bool) -> float | str:
    if isinstance(value, str):
        return value
    if math.isnan(value):
        return ""
    return int(value) if whole else value
