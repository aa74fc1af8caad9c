"""CSV and Parquet files with a column of times, or folders of them.

Columns are streams by their names (column_names.py); in a folder the name of the file comes before:
joints/q_*. Between columns are commas, or semicolons, tabs or single spaces where the header has
these; a file without commas between columns may have decimal commas.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from ...core.errors import RecordingError, UnknownNameError
from ..log_map import TIME_UNITS, StreamMap
from ..stream import CONTACTS, JOINTS, TAXELS, Log, Stream, contact_fields
from .column_names import groups as groups_of
from .column_names import is_time, split_unit, suggest

if TYPE_CHECKING:
    from ..log_map import LogMap

PARQUET = b"PAR1"
"""First bytes of a Parquet file, and its last ones."""
SUFFIXES = (".csv", ".parquet")
STEPS = (1e-4, 5.0)
"""Median times, s, from one row to the next that streams of a robot have: force sensors have 7 kHz
at most, and a touch of some seconds has some rows."""
HEAD = 65536
"""Characters of a CSV file that tell its decimal point."""
LATEST = 1e11
"""Largest time, s: clocks of computers, which count from 1970, reach it in the year 5138."""


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
    for file in files:
        for group, columns in groups_of(_columns(file)).items():
            groups[f"{file.stem}/{group}" if folder else group] = file, columns
    chosen: list[tuple[str, StreamMap | None]] = (
        [(group, None) for group in groups]
        if log_map is None
        else [(one.topic, one) for one in log_map.streams]
    )
    streams, notes, could = list[Stream](), list[str](), dict[str, list[StreamMap]]()
    hidden = None if progress else True  # None: hidden where stderr is no terminal
    for topic, given in tqdm(chosen, path.name, leave=False, disable=hidden):
        file, columns = _choose(topic, given, groups, path)
        stream = _stream(topic, file, columns, given, notes)
        streams.append(stream)
        could[topic] = suggest(topic, stream.fields) if given is None else []
    return Log(path, tuple(streams), tuple(dict.fromkeys(notes))), could


def _choose(
    topic: str, given: StreamMap | None, groups: dict[str, tuple[Path, list[str]]], path: Path
) -> tuple[Path, list[str]]:
    """The file and the columns of a stream."""
    patterns = () if given is None else given.values
    if topic in groups and not patterns:
        return groups[topic]
    files = {file.stem: file for file, _ in groups.values()}
    file = files.get(topic.partition("/")[0]) or (path if path.is_file() else None)
    every = [] if file is None else _columns(file)
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


def _columns(file: Path) -> list[str]:
    """Names of the columns. Raises RecordingError."""
    import csv

    import pyarrow.parquet as pq

    try:
        if _is_parquet(file):
            return list(pq.read_schema(file).names)
        with file.open(encoding="utf-8-sig", newline="") as stream:
            header = next(csv.reader(stream, skipinitialspace=True, delimiter=_delimiter(file)), [])
            names = [name.strip() for name in header]
            if names and names[0].startswith("#"):
                names[:1] = filter(None, [names[0].lstrip("# ")])
    except (UnicodeDecodeError, csv.Error):
        names = []
    except (pa.ArrowInvalid, OSError) as error:
        raise RecordingError(
            f"{file.name} cannot be read: {str(error).splitlines()[0]}",
            remedy="a torn Parquet file has lost its columns; record it again",
        ) from error
    if len(names) < 2:
        raise RecordingError(
            f"{file.name} is no log: neither a bag nor a table with a header line",
            remedy="give a ROS bag, an MCAP file, a YARP folder, or CSV or Parquet files",
        )
    return names


def _delimiter(file: Path) -> str:
    """What is between the columns of a CSV file, by its header."""
    with file.open(encoding="utf-8-sig") as stream:
        header = stream.readline()
    most = max(",;\t", key=header.count)
    spaced = most not in header and any(map(is_time, header.split()))
    return " " if spaced else most


def _decimal_point(file: Path, delimiter: str) -> str:
    """What is before the decimals of numbers in a CSV file, by its first rows."""
    with file.open(encoding="utf-8-sig", errors="replace") as stream:
        stream.readline()
        rows = stream.read(HEAD)
    with_comma = delimiter != "," and re.search(r"\d,\d", rows) and not re.search(r"\d\.\d", rows)
    return "," if with_comma else "."


def _is_parquet(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.read(4) == PARQUET


def _time_column(names: list[str], file: Path) -> str:
    for name in names:
        if is_time(name):
            return name
    raise RecordingError(
        f"{file.name} has no column of times",
        value=", ".join(names)[:60],
        remedy="name it time, time_s or time_ms, or give its name as time in the map",
    )


def _stream(
    topic: str, file: Path, columns: list[str], given: StreamMap | None, notes: list[str]
) -> Stream:
    """The stream of some columns of a file."""
    time = given.time if given is not None and given.time else _time_column(_columns(file), file)
    if time not in _columns(file):
        raise UnknownNameError("column", time, _columns(file), f" in {file.name}")
    wanted = columns if given is not None else []
    every = [*_columns(file), time, *wanted]
    if twice := [name for name in (time, *wanted) if every.count(name) > 2]:
        raise RecordingError(
            f"a column of {file.name} occurs twice, or the map takes it twice",
            value=twice[0],
            remedy="rename it in the header, or correct values in the map",
        )
    parts, dated = [], False
    for batch in _batches(file, [time, *wanted], notes):
        dated = pa.types.is_timestamp(batch.column(time).type)
        parts.append(_numbers(batch, [time, *wanted], file))
    table = np.concatenate(parts) if parts else np.empty((0, 1 + len(wanted)))
    _, unit = split_unit(time)
    stated = unit if unit in TIME_UNITS else "s" if given is None else given.time_unit
    times = table[:, 0] * TIME_UNITS["ns" if dated else stated]
    if given is None:
        return Stream(topic, "table", times, np.empty((len(times), 0)), tuple(columns))
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
    unit = given.unit or given.si_unit
    stream = Stream(topic, "table", times, table[:, 1:], fields, given.kind, unit)
    _check_times(stream, time, "ns" if dated else stated)
    return stream


def _check_times(stream: Stream, column: str, unit: str) -> None:
    """Refuse times that cannot be in their unit."""
    if lost := int(np.sum(~np.isfinite(stream.times))):
        raise RecordingError(
            f"rows of {stream.name} have no time", value=f"{lost} of {len(stream)}",
            remedy="remove them from the file",
        )  # fmt: skip
    late = len(stream) > 0 and np.abs(stream.times).max() >= LATEST
    paced = stream.kind == CONTACTS or not stream.period
    if late or not (paced or STEPS[0] <= stream.period < STEPS[1]):
        raise RecordingError(
            f"the times of {stream.name} cannot be in {unit}",
            value=f"{column} from {stream.times[0]:g} s in steps of {stream.period:g} s",
            limit=f"steps of {STEPS[0]:g} to {STEPS[1]:g} s, below {LATEST:g} s",
            remedy='give their time_unit in the map, "s", "ms", "us" or "ns", or name the column '
            "with its unit, time_ms",
        )


def _batches(file: Path, columns: list[str], notes: list[str]) -> Iterator[pa.RecordBatch]:
    """Rows of some columns, a part at a time. Raises RecordingError.

    The last line of a CSV file is left out if it does not end or is short: the log is torn there.
    """
    import pyarrow.parquet as pq
    from pyarrow import csv

    if _is_parquet(file):
        try:
            yield from pq.ParquetFile(file).iter_batches(columns=columns)
        except (pa.ArrowInvalid, OSError) as error:
            notes.append(
                f"{file.name} is torn ({str(error).splitlines()[0]}): what is before is read"
            )
        return
    short: list[int] = []

    def skip(row: csv.InvalidRow) -> str:
        short.append(row.number if row.number is not None else -1)
        return "skip"

    whole, delimiter = _ends_with_a_line(file), _delimiter(file)
    options = {
        "read_options": csv.ReadOptions(
            use_threads=False, column_names=_columns(file), skip_rows=1
        ),
        "parse_options": csv.ParseOptions(delimiter=delimiter, invalid_row_handler=skip),
    }
    convert = csv.ConvertOptions(
        include_columns=columns, decimal_point=_decimal_point(file, delimiter)
    )
    try:
        with csv.open_csv(file, convert_options=convert, **options) as reader:
            convert.column_types = dict(map(_widest, reader.schema))
        short.clear()
        with csv.open_csv(file, convert_options=convert, **options) as reader:
            held = None
            for batch in reader:
                if held is not None:
                    yield held
                held = batch if len(batch) else held
    except (pa.ArrowInvalid, pa.ArrowKeyError, OSError, UnicodeDecodeError) as error:
        raise RecordingError(
            f"{file.name} cannot be read: {str(error).splitlines()[0]}",
            remedy="write one header line and numbers separated by commas, in UTF-8",
        ) from error
    if len(short) > 1 or (short and whole):
        raise RecordingError(
            f"{len(short)} lines of {file.name} have another number of columns than its header",
            remedy="remove them",
        )
    if held is None:
        return
    if not whole:
        notes.append(f"{file.name} does not end with a line: its last line is left out")
    yield held if whole or short else held.slice(0, len(held) - 1)


def _ends_with_a_line(file: Path) -> bool:
    with file.open("rb") as stream:
        stream.seek(max(file.stat().st_size - 1, 0))
        return stream.read(1) in (b"\n", b"\r")


def _widest(field: pa.Field) -> tuple[str, pa.DataType]:
    """Name and type of a column whose first rows are of a type: integers may have decimals later,
    missing numbers be there, and seconds have parts."""
    if pa.types.is_integer(field.type) or pa.types.is_null(field.type):
        return field.name, pa.float64()
    if pa.types.is_timestamp(field.type):
        return field.name, pa.timestamp("ns", field.type.tz)
    return field.name, field.type


def _numbers(batch: pa.RecordBatch, columns: list[str], file: Path) -> np.ndarray:
    """Columns of a batch as numbers (n, k), of dates ns since 1970. Raises RecordingError."""
    try:
        parts = []
        for name in columns:
            column = batch.column(name)
            if pa.types.is_timestamp(column.type):
                column = column.cast(pa.timestamp("ns")).cast(pa.int64())
            parts.append(np.asarray(column.to_numpy(zero_copy_only=False), dtype=float))
    except (TypeError, ValueError) as error:
        raise RecordingError(
            f"the columns of {file.name} must contain numbers: {error}",
            remedy="write numbers with decimal points, or leave the column out of the map",
        ) from error
    return np.stack(parts, axis=1)
