"""Tables of numbers in CSV files."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import ConfigError


def read_table(path: Path) -> dict[str, FloatArray]:
    """Return the columns of a CSV file of numbers.

    Raises:
        ConfigError: it cannot be read, or a cell is not a number.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            head, *rows = list(csv.reader(file))
        values = np.array(rows, dtype=np.float64)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}; is DATA the right folder?") from error
    except (ValueError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not a table of numbers under one header: {error}") from error
    if values.ndim != 2 or values.shape[1] != len(head) or not np.isfinite(values).all():
        raise ConfigError(f"{path}: holds {values.shape} numbers under {len(head)} columns; rows must be whole, finite")
    return dict(zip(head, values.T, strict=True))


def read_columns(path: Path, names: Sequence[str]) -> dict[str, FloatArray]:
    """Return the columns of a CSV file of numbers, with all of these among them.

    Raises:
        ConfigError: it cannot be read, a cell is not a number, or a column is missing.
    """
    table = read_table(path)
    missing = [name for name in names if name not in table]
    if missing:
        raise ConfigError(f"{path}: holds no column {', '.join(missing)}; {','.join(names)} are needed")
    return table
