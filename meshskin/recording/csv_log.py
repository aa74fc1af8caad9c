"""A robot's own log: two CSV files, contacts and readings.

Columns are in SI units or name their unit (px_mm, pressure_kpa, time_ms). A column `reading` or
`count` in place of `pressure` holds raw readings, in a unit of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from ..core import arrow
from ..core.config import UNITS
from ..core.errors import RecordingError

QUANTITIES = {
    "time": "s", "force": "N", "pressure": "Pa",
    **dict.fromkeys(("px", "py", "pz"), "m"),
    **dict.fromkeys(("nx", "ny", "nz", "qw", "qx", "qy", "qz", "taxel", "reading", "count"), ""),
}  # fmt: skip
"""SI units of the columns that are read; columns beside them may have any."""
REQUIRED = {
    "contacts": ("time", "px", "py", "pz", "force"),
    "readings": ("time", "taxel", "pressure"),
}
"""Columns that each file must have."""
RAW_COLUMNS = ("reading", "count")
"""Columns of raw readings: of any sign and scale, without a unit."""
LIMITS: dict[str, tuple[Callable[[Any], Any], str, str]] = {
    "force": (lambda x: x <= 0, "above 0 N", "remove the rows without contact"),
    "pressure": (
        lambda x: x < 0,
        "at least 0 Pa",
        "remove the offsets of the sensors, or name the column reading if it holds raw readings",
    ),
    "taxel": (lambda x: x < 0, "at least 0", "remove the readings of other sensors"),
}
"""For a column: which values are invalid, the limit that they break, and the remedy."""
UTF16 = (b"\xff\xfe", b"\xfe\xff")
"""First bytes of a file in UTF-16."""


NAMES = "contacts.csv", "readings.csv"
"""Names of the files of a log in a folder of its own."""


def find(path: Path) -> tuple[Path, Path] | None:
    """The CSV files of contacts and of readings at `path`; None if there is neither.

    They are in the folder `path`, or `path` is the common part of their names. Raises
    RecordingError if one of the two is missing, or `path` is one of them.
    """
    if path.name in NAMES and all((path.parent / name).is_file() for name in NAMES):
        raise RecordingError(
            f"{path} is one of the two files of a log", remedy=f"give their folder, {path.parent}"
        )
    for contacts, readings in (
        (path / NAMES[0], path / NAMES[1]),
        (path.parent / f"{path.name}.contacts.csv", path.parent / f"{path.name}.readings.csv"),
    ):
        missing = [file for file in (contacts, readings) if not file.is_file()]
        if len(missing) == 1:
            raise RecordingError(
                f"half a log: {missing[0]} is missing", remedy="put it beside the other file"
            )
        if not missing:
            return contacts, readings
    return None


def read(file: Path, part: str) -> pa.Table:
    """The table of a CSV file, "contacts" or "readings", in SI units. Raises RecordingError.

    Raw readings become the column "pressure" of a table with the metadata {"readings": "raw"}.
    """
    columns: dict[str, pa.Array] = {}
    for label, values in _read_columns(file).items():
        name, _, suffix = label.strip().lower().partition("_")
        every = [QUANTITIES[name]] if name in QUANTITIES else ["", "m", "s", "N", "Pa"]
        units = {"": 1.0} | {u: factor for unit in every for u, factor in UNITS[unit].items()}
        factor = None if label.strip().endswith("mPa") else units.get(suffix)  # milli, not mega
        if factor is None or name in columns:
            raise RecordingError(
                f"a column of {file.name} has an unknown unit or occurs twice",
                value=label,
                limit=" or ".join(f"{name}_{unit}" if unit else name for unit in units),
                remedy="rename or remove it",
            )
        numbers = _integers(values, file) if name == "taxel" else _numbers(values, label, file)
        if name in LIMITS:
            invalid, limit, remedy = LIMITS[name]
            if np.any(bad := invalid(numbers)):
                row = int(np.argmax(bad))
                value = f"{label} = {numbers[row]:g} in row {row}"
                raise RecordingError(
                    f"{name} of {file.name} is out of range",
                    value=value, limit=limit, remedy=remedy,
                )  # fmt: skip
        columns[name] = arrow.column(numbers if name == "taxel" else numbers * factor)
    raw = [name for name in RAW_COLUMNS if name in columns and "pressure" not in columns]
    if raw:
        columns["pressure"] = columns.pop(raw[0])
    missing = [name for name in REQUIRED[part] if name not in columns]
    if missing:
        raise RecordingError(
            f"{file.name} lacks {', '.join(missing)}",
            value=f"columns {', '.join(columns)}",
            remedy=f"it needs {', '.join(REQUIRED[part])}, in SI units or as px_mm, pressure_kpa; "
            "raw readings are a column reading or count",
        )
    return arrow.table(columns).replace_schema_metadata({"readings": "raw"} if raw else None)


def _read_columns(file: Path) -> dict[str, np.ndarray]:
    """The columns of a CSV file by label. Raises RecordingError."""
    from pyarrow import csv

    try:
        with file.open("rb") as stream:
            if stream.read(2) in UTF16:
                raise RecordingError(f"{file} is in UTF-16", remedy="save it as UTF-8")
        table = csv.read_csv(file)
        labels = table.column_names
    except (pa.ArrowInvalid, OSError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{file} cannot be read: {str(error).splitlines()[0]}",
            remedy="write one header line and numbers separated by commas, in UTF-8",
        ) from error
    if len(set(labels)) < len(labels):
        twice = next(label for label in labels if labels.count(label) > 1)
        raise RecordingError(f"the column {twice} of {file.name} occurs twice", remedy="remove one")
    return {label: table.column(label).to_numpy() for label in labels}


def _numbers(values: np.ndarray, label: str, file: Path) -> np.ndarray:
    """A column as floats; RecordingError names the first entry that is not a number."""
    try:
        return np.asarray(values, dtype=float)
    except (ValueError, TypeError) as error:
        row = next(k for k, value in enumerate(values) if not _is_number(value))
        raise RecordingError(
            f"a column of {file.name} must contain numbers",
            value=f"{label} = {values[row]} in row {row}",
            remedy="write numbers with decimal points, separated by commas, or remove the column",
        ) from error


def _is_number(text: object) -> bool:
    try:
        float(str(text))
    except ValueError:
        return False
    return True


def _integers(values: np.ndarray, file: Path) -> np.ndarray:
    """Taxel ids as integers, of 32 bits where these suffice. Raises RecordingError."""
    if not np.issubdtype(values.dtype, np.integer):
        numbers = _numbers(values, "taxel", file)
        whole = np.isfinite(numbers) & (numbers == np.round(numbers)) & (np.abs(numbers) < 2**53)
        if not whole.all():
            row = int(np.argmin(whole))
            raise RecordingError(
                f"a taxel id of {file.name} must be a whole number",
                value=f"{numbers[row]:g} in row {row}",
            )
        values = numbers
    small = not len(values) or np.abs(values).max() < 2**31
    return np.asarray(values).astype(np.int32 if small else np.int64)
