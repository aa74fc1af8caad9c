"""A robot's own log: two CSV files, contacts and readings, in SI units or with the unit in the name
of the column (px_mm, pressure_kpa, time_ms).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from ..core.config import UNITS
from ..core.errors import RecordingError
from ..core.se3 import Array

SUFFIXES = {
    "": 1.0,
    **{name: factor for unit in ("m", "s", "N", "Pa") for name, factor in UNITS[unit].items()},
}
"""Units that a column of a CSV log may name, in SI."""
NEEDED = {
    "contacts": ("time", "px", "py", "pz", "force"),
    "readings": ("time", "taxel", "pressure"),
}


def find(path: Path) -> tuple[Path, Path] | None:
    """The CSV files of contacts and of readings at `path`: in a folder of that name, or with it as
    the common part of their names; None where there is neither.

    Raises RecordingError where one of the two is missing.
    """
    for contacts, readings in (
        (path / "contacts.csv", path / "readings.csv"),
        (path.with_name(f"{path.name}.contacts.csv"), path.with_name(f"{path.name}.readings.csv")),
    ):
        missing = [file for file in (contacts, readings) if not file.is_file()]
        if len(missing) == 1:
            raise RecordingError(
                f"half a log: {missing[0]} is missing", remedy="put it beside the other one"
            )
        if not missing:
            return contacts, readings
    return None


def read(file: Path, part: str) -> pa.Table:
    """The table of a CSV file, "contacts" or "readings", in SI units. Raises RecordingError."""
    from pyarrow import csv

    try:
        table = csv.read_csv(file)
    except (pa.ArrowInvalid, OSError) as error:
        raise RecordingError(
            f"{file} cannot be read: {str(error).splitlines()[0]}",
            remedy="write one header line and numbers with commas between",
        ) from error
    columns: dict[str, pa.Array] = {}
    for label in table.column_names:
        name, _, suffix = label.strip().lower().partition("_")
        factor = SUFFIXES.get(suffix)
        if factor is None or name in columns:
            raise RecordingError(
                f"a column of {file.name} that is unknown or twice there",
                value=label,
                limit=f"units {', '.join(filter(None, SUFFIXES))}",
                remedy="rename it or take it out",
            )
        values = _numbers(table.column(label), label, file)
        columns[name] = pa.array(_ids(values, file) if name == "taxel" else values * factor)
    missing = [name for name in NEEDED[part] if name not in columns]
    if missing:
        raise RecordingError(
            f"{file.name} lacks {', '.join(missing)}",
            value=f"columns {', '.join(table.column_names)}",
            remedy=f"it needs {', '.join(NEEDED[part])}, in SI units or as px_mm, pressure_kpa",
        )
    return pa.table(columns)


def _numbers(column: pa.ChunkedArray, label: str, file: Path) -> Array:
    """A column as numbers; RecordingError names the first entry that is none."""
    values = column.to_numpy()
    try:
        return np.asarray(values, dtype=float)
    except (ValueError, TypeError) as error:
        row = next(k for k, value in enumerate(values) if not _is_number(value))
        raise RecordingError(
            f"a column of {file.name} is not of numbers",
            value=f"{label} = {values[row]} in row {row}",
            remedy="write numbers with points for decimals and commas between, or take it out",
        ) from error


def _is_number(text: object) -> bool:
    try:
        float(str(text))
    except ValueError:
        return False
    return True


def _ids(values: Array, file: Path) -> np.ndarray:
    """Taxel ids, which are whole numbers."""
    whole = np.isfinite(values) & (values == np.round(values)) & (np.abs(values) < 2**31)
    if not whole.all():
        row = int(np.argmin(whole))
        raise RecordingError(
            f"a taxel id of {file.name} is no whole number", value=f"{values[row]:g} in row {row}"
        )
    return values.astype(np.int32)
