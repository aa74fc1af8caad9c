"""CSV and Parquet files with a column of times, or folders of them.

Columns are streams by their names (column_names.py); in a folder the name of the file comes before:
joints/q_*. Rows in which all columns of a stream are empty are those of other streams. Times are
numbers, dates, or two columns of seconds and nanoseconds.
"""

from __future__ import annotations

import fnmatch
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from ...core.arguments import REPR_LENGTH, repr_short
from ...core.arrays import Array
from ...core.errors import RecordingError, UnknownNameError
from ..log_map import TIME_UNITS, StreamMap
from ..stream import CONTACTS, JOINTS, TAXELS, Log, Stream, contact_fields
from . import csv_file, parquet_file
from .column_names import groups as groups_of
from .column_names import is_time, split_unit, suggest, wrench_columns
from .csv_file import CsvFile
from .parquet_file import ParquetFile

if TYPE_CHECKING:
    from ..log_map import LogMap

SUFFIXES = (".csv", ".tsv", ".parquet")
STEPS = (1e-4, 5.0)
"""Median times, s, from one row to the next that streams of a robot have: force sensors have 7 kHz
at most, and a touch of some seconds has some rows."""
USUAL = (5e-4, 0.5)
"""Median times, s, of which one unit at most has them: it is proposed where s is none."""
LATEST = 1e11
"""Largest time, s: clocks of computers, which count from 1970, reach it in the year 5138."""
SAME = 3.0
"""Mean number of rows of one time from which times are rounded: streams of robots have one each."""
SECONDS = ("sec", "secs", "seconds")
NANOSECONDS = ("nanosec", "nanosecs", "nanoseconds", "nsec", "nsecs")
"""Ends of the names of two columns that make a time."""


def read(
    path: Path, log_map: LogMap | None, *, progress: bool = False
) -> tuple[Log, dict[str, list[StreamMap]]]:
    """The log in a CSV or Parquet file or in a folder of them, and what its streams could be.

    With a map the mapped columns alone are read. Raises RecordingError for files that are no
    tables, UnknownNameError for columns that are not there.
    """
    from tqdm import tqdm

    folder = path.is_dir()
    files = sorted(p for p in path.iterdir() if p.suffix in SUFFIXES) if folder else [path]
    groups: dict[str, tuple[Path, list[str]]] = {}
    streams, could = list[Stream](), dict[str, list[StreamMap]]()
    notes, failed = list[str](), dict[str, RecordingError]()
    for file in files:
        try:
            found = groups_of(_opened(file).names)
            own = {f"{file.stem}/{k}" if folder else k: columns for k, columns in found.items()}
            listed = [] if log_map is not None else _listed(file, own, notes, progress)
        except RecordingError as error:
            failed[file.stem] = error
            notes.append(f"{file.name} is left out: {error}")
            continue
        groups |= {group: (file, columns) for group, columns in own.items()}
        streams += [stream for stream, _ in listed]
        could |= {stream.name: maps for stream, maps in listed}
    if len(failed) == len(files):
        raise failed[files[0].stem]
    hidden = None if progress else True  # None: hidden where stderr is no terminal
    every = () if log_map is None else log_map.streams
    for given in tqdm(every, path.name, leave=False, disable=hidden):
        if (refused := failed.get(given.topic.partition("/")[0])) is not None:
            raise refused
        file, columns = _choose(given.topic, given, groups, path)
        streams.append(_stream(given, file, columns, notes))
    return Log(path, tuple(streams), tuple(dict.fromkeys(notes))), could


def _choose(
    topic: str, given: StreamMap, groups: dict[str, tuple[Path, list[str]]], path: Path
) -> tuple[Path, list[str]]:
    """The file and the columns of a stream."""
    patterns = given.values
    if topic in groups and not patterns:
        return groups[topic]
    files = {file.stem: file for file, _ in groups.values()}
    file = files.get(topic.partition("/")[0]) or (path if path.is_file() else None)
    every = [] if file is None else list(_opened(file).names)
    if not patterns and (alone := topic if path.is_file() else topic.partition("/")[2]) in every:
        patterns = (alone,)
    if file is None or not patterns:
        raise UnknownNameError("group of columns", topic, groups, f" in {path.name}")
    found: list[str] = []
    for pattern in patterns:
        matches = [name for name in every if name == pattern or fnmatch.fnmatchcase(name, pattern)]
        if not matches:
            raise UnknownNameError("column", pattern, every, f" in {file.name}")
        found += matches
    return file, found


def _opened(file: Path) -> CsvFile | ParquetFile:
    """How the file is written. Raises RecordingError for what is no table."""
    status = file.stat()
    return _opened_at(file, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=64)
def _opened_at(file: Path, size: int, changed: int) -> CsvFile | ParquetFile:
    """The file as it was at that size and time of change, ns."""
    with file.open("rb") as stream:
        parquet = stream.read(4) == parquet_file.MAGIC
    return parquet_file.opened(file) if parquet else csv_file.opened(file)


def _time_columns(file: CsvFile | ParquetFile, asked: str) -> list[str]:
    """The column of times, or those of seconds and nanoseconds. Raises RecordingError."""
    names = file.names
    if asked and asked in names:
        return [asked]
    named = [name for name in names if not asked and is_time(name)]
    if usual := [name for name in named if is_time(split_unit(name)[0])]:
        return usual[:1]
    for name in names:
        start, _, end = name.rpartition(".")
        start = f"{start}." if start else ""
        if end in SECONDS and (not asked or asked == start[:-1]):
            for nano in NANOSECONDS:
                if f"{start}{nano}" in names:
                    return [name, f"{start}{nano}"]
    if asked:
        raise UnknownNameError("column", asked, names, f" in {file.path.name}")
    if isinstance(file, ParquetFile) and file.timed:
        return [file.timed]
    if len(named) == 1:
        return named
    count = "several columns that could be" if named else "no column of"
    raise RecordingError(
        f"{file.path.name} has {count} times",
        value=shorten(", ".join(named or names), REPR_LENGTH, placeholder=" ..."),
        remedy="name it time, time_s or time_ms, or give its name as time in the map",
    )


def _unit(times: list[str], batch: pa.RecordBatch, otherwise: str) -> str:
    """The unit of columns of times: that of their type or name, or `otherwise`."""
    if pa.types.is_temporal(batch.column(times[0]).type):
        return "ns"
    unit = split_unit(times[0])[1]
    return "s" if len(times) > 1 else unit if unit in TIME_UNITS else otherwise


def _seconds(numbers: Array, unit: str) -> Array:
    """Times (n,), s, of numbers (n, 1), or of seconds and nanoseconds (n, 2)."""
    nano = TIME_UNITS["ns"] * numbers[:, 1] if numbers.shape[1] > 1 else 0.0
    return np.asarray(numbers[:, 0] * TIME_UNITS[unit] + nano)


def _usual_unit(step: float) -> str:
    """The unit of times whose median step is `step` of it; s where it can be."""
    if not step or STEPS[0] <= step < STEPS[1]:
        return "s"
    return next((u for u, s in TIME_UNITS.items() if USUAL[0] <= s * step < USUAL[1]), "s")


def _listed(
    path: Path, groups: dict[str, list[str]], notes: list[str], progress: bool
) -> list[tuple[Stream, list[StreamMap]]]:
    """The streams of a file with their times alone, and what each could be."""
    from tqdm import tqdm

    file = _opened(path)
    columns = _time_columns(file, "")
    _check_once(file, columns)
    names = [name for own in groups.values() for name in own]
    every = [name for name in names if file.names.count(name) == 1 and name not in columns]
    parts, known, unit = list[Array](), list[list[NDArray[np.bool_]]](), "s"
    texts: dict[str, str] = {}
    batches = file.batches([*columns, *every], notes)
    hidden = None if progress else True  # None: hidden where stderr is no terminal
    row = 0
    for batch in tqdm(batches, path.name, leave=False, unit=" parts", disable=hidden):
        unit = _unit(columns, batch, "")
        parts.append(_numbers(batch, columns, path, row))
        known.append([_known(batch, own, every) for own in groups.values()])
        for name in every if not row else ():
            if not _is_number(text := batch.column(name)[0].as_py()):
                texts[name] = str(text)
        row += len(batch)
    numbers = np.concatenate(parts) if parts else np.empty((0, len(columns)))
    guessed = ""
    if not unit:
        unit = _usual_unit(Stream("", "", numbers[:, 0], np.empty((row, 0))).period)
        guessed = unit
    times, found = _seconds(numbers, unit), []
    for k, (topic, own) in enumerate(groups.items()):
        rows = np.concatenate([part[k] for part in known]) if known else slice(0)
        stream = Stream(topic, "table", times[rows], np.empty((len(times[rows]), 0)), tuple(own))
        maps = [] if set(own) <= set(texts) else suggest(topic, own, texts)
        found.append((stream, [replace(one, time_unit=guessed or one.time_unit) for one in maps]))
    return found


def _known(batch: pa.RecordBatch, columns: list[str], read: list[str]) -> NDArray[np.bool_]:
    """The rows (n,) of a batch in which one of the columns that are read is not empty; all of them
    where none is read."""
    read = [name for name in columns if name in read]
    known = np.full(len(batch), not read)
    for name in read:
        column = batch.column(name)
        known |= ~pc.is_null(column, nan_is_null=True).to_numpy(zero_copy_only=False)
        if known.all():
            break
    return known


def _check_once(file: CsvFile | ParquetFile, columns: list[str]) -> None:
    """Raise RecordingError for a column that occurs twice in the file or in `columns`."""
    every = [*file.names, *columns]
    if twice := [name for name in columns if every.count(name) > 2]:
        raise RecordingError(
            f"a column of {file.path.name} occurs twice, or the map takes it twice",
            value=twice[0],
            remedy="rename it in the header, or correct values in the map",
        )


def _stream(given: StreamMap, path: Path, columns: list[str], notes: list[str]) -> Stream:
    """The stream of some columns of a file."""
    topic, file = given.topic, _opened(path)
    if given.kind == JOINTS and (forces := wrench_columns(columns)):
        raise RecordingError(
            f"{topic} has columns of forces, which are no joints", value=", ".join(forces),
            remedy='write kind = "wrench" in the map, or correct values',
        )  # fmt: skip
    stamps = _time_columns(file, given.time)
    _check_once(file, [*stamps, *columns])
    parts, unit, row = list[Array](), given.time_unit, 0
    for batch in file.batches([*stamps, *columns], notes):
        unit = _unit(stamps, batch, given.time_unit)
        numbers = _numbers(batch, [*stamps, *columns], path, row)
        parts.append(numbers[np.isfinite(numbers[:, len(stamps) :]).any(axis=1)])
        row += len(batch)
    table = np.concatenate(parts) if parts else np.empty((0, len(stamps) + len(columns)))
    times, values = _seconds(table[:, : len(stamps)], unit), table[:, len(stamps) :]
    given.check_length(len(columns), 0)
    fields = tuple(columns)
    if given.kind == TAXELS:
        fields = given.taxel_ids(len(columns))
    elif given.kind == JOINTS and given.names:
        fields = given.names
    elif given.kind == CONTACTS:
        fields = contact_fields(len(columns))
    if len(fields) != len(columns):
        raise RecordingError(
            f"{topic} needs one name for each column",
            value=f"{len(fields)} names", limit=f"{len(columns)} columns",
        )  # fmt: skip
    stream = Stream(topic, "table", times, values, fields, given.kind, given.unit or given.si_unit)
    _check_times(stream, stamps[0], unit)
    return stream


def _check_times(stream: Stream, column: str, unit: str) -> None:
    """Refuse times that cannot be in their unit, or are rounded."""
    if lost := int(np.sum(~np.isfinite(stream.times))):
        raise RecordingError(
            f"rows of {stream.name} have no time", value=f"{lost} of {len(stream)}",
            remedy="remove them from the file",
        )  # fmt: skip
    if stream.kind == CONTACTS or not stream.period:
        paced = True
    else:
        paced = STEPS[0] <= stream.period < STEPS[1]
        rows = len(stream) / (1 + np.count_nonzero(np.diff(stream.times)))
        if rows > SAME and stream.kind != JOINTS:  # joints may be in messages of their own
            raise RecordingError(
                f"the times of {stream.name} are rounded",
                value=f"{rows:.3g} rows of each time in {column}",
                limit=f"{SAME:g}",
                remedy="write times with all decimals, or give the column that has them as time in "
                "the map",
            )
    if (len(stream) > 0 and np.abs(stream.times).max() >= LATEST) or not paced:
        other = _usual_unit(stream.period / TIME_UNITS[unit])
        raise RecordingError(
            f"the times of {stream.name} cannot be in {unit}",
            value=f"{column} from {stream.times[0]:g} s in steps of {stream.period:g} s",
            limit=f"steps of {STEPS[0]:g} to {STEPS[1]:g} s, below {LATEST:g} s",
            remedy=f'give time_unit = "{other}" in the map, if that is their unit, or name the '
            f"column with its unit, time_{other}",
        )


def _numbers(batch: pa.RecordBatch, columns: list[str], file: Path, row: int) -> Array:
    """Columns of a batch as numbers (n, k), of dates and durations ns. Raises RecordingError.

    row: that of the file at which the batch begins.
    """
    parts = []
    for name in columns:
        column = batch.column(name)
        if pa.types.is_temporal(column.type):
            column = _nanoseconds(column)
        values = column.to_numpy(zero_copy_only=False)
        try:
            parts.append(np.asarray(values, dtype=float))
        except (TypeError, ValueError) as error:
            at = next(k for k, value in enumerate(values) if not _is_number(value))
            raise RecordingError(
                f"the columns of {file.name} must contain numbers",
                value=f"{name} = {repr_short(values[at])} in row {row + at + 1}",
                remedy="write times in s, or dates as 2026-01-31 10:00:00.000, or remove the row"
                if name == columns[0]
                else "write numbers with decimal points and without separators of thousands, leave "
                "missing ones empty, or leave the column out of the map",
            ) from error
    return np.stack(parts, axis=1)


def _is_number(value: object) -> bool:
    try:
        float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return value is None
    return True


def _nanoseconds(column: pa.Array) -> pa.Array:
    """Dates, times of a day and durations as whole numbers of ns."""
    kind = column.type
    if pa.types.is_duration(kind):
        column = column.cast(pa.duration("ns"))
    elif pa.types.is_time(kind):
        column = column.cast(pa.time64("ns"))
    else:
        column = column.cast(pa.timestamp("ns", getattr(kind, "tz", None)))
    return column.cast(pa.int64())
