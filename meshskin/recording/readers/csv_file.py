"""CSV files: encoding, header line, what is between columns and before decimals, and the rows.

Between columns are commas, or semicolons, tabs or spaces where the header has these; runs of spaces
count as one. Numbers may have decimal commas where the columns do not end at commas, or are in
quotes. Before the header may be empty lines, comments after # or %, and Excel's line `sep=;`; the
header may be the last comment.
"""

from __future__ import annotations

import codecs
import csv
import mmap
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from ...core.arguments import repr_short
from ...core.errors import RecordingError
from .column_names import is_time

HEAD = 65536
"""Bytes of a file that tell its encoding and its header, and mostly its decimal point."""
COMMENTS = ("#", "%")
"""First characters of comments."""
FOREIGN = {b"PK\x03\x04": ("an Excel workbook or a zip archive", "save it as CSV, or unpack it"),
           b"\x1f\x8b": ("compressed by gzip", "unpack it with gunzip"),
           b"\x28\xb5\x2f\xfd": ("compressed by zstd", "unpack it with zstd -d"),
           b"\x89HDF": ("an HDF5 or MATLAB file", "export it as CSV or Parquet"),
           b"MATLAB": ("a MATLAB file", "export it with writetable as CSV")}  # fmt: skip
"""What files are that begin with these bytes, and the remedy."""


@dataclass(frozen=True)
class CsvFile:
    """How a CSV file is written."""

    path: Path
    encoding: str
    names: tuple[str, ...]
    """Names of the columns."""
    delimiter: str
    before: int
    """Lines up to and with the header."""
    decimal_point: str

    def batches(self, columns: list[str], notes: list[str]) -> Iterator[pa.RecordBatch]:
        """Rows of some columns, a part at a time. Raises RecordingError.

        The last line is left out if it does not end or is short: the log is torn there.
        """
        from pyarrow import csv as arrow_csv

        short: list[arrow_csv.InvalidRow] = []

        def skip(row: arrow_csv.InvalidRow) -> str:
            short.append(row)
            return "skip"

        options = {
            "read_options": arrow_csv.ReadOptions(
                use_threads=False, column_names=self.names, skip_rows=self.before,
                encoding="utf8" if self.encoding == "utf-8-sig" else self.encoding,
            ),
            "parse_options": arrow_csv.ParseOptions(
                delimiter=self.delimiter, invalid_row_handler=skip
            ),
        }  # fmt: skip
        convert = arrow_csv.ConvertOptions(
            include_columns=columns, decimal_point=self.decimal_point
        )
        whole, held = self._ends_with_a_line(), None
        try:
            with arrow_csv.open_csv(self._input(), convert_options=convert, **options) as reader:
                convert.column_types = dict(map(_widest, reader.schema))
            short.clear()
            with arrow_csv.open_csv(self._input(), convert_options=convert, **options) as reader:
                for batch in reader:
                    if held is not None:
                        yield held
                    held = batch if len(batch) else held
        except (pa.ArrowInvalid, pa.ArrowKeyError, OSError, UnicodeDecodeError) as error:
            raise RecordingError(
                f"{self.path.name} cannot be read: {str(error).splitlines()[0]}",
                remedy="write one header line and numbers separated by commas, in UTF-8",
            ) from error
        if len(short) > 1 or (short and whole):
            raise RecordingError(
                f"{len(short)} lines of {self.path.name} have another number of columns than its "
                "header",
                value=f"{short[0].actual_columns} columns", limit=f"{short[0].expected_columns}",
                remedy="give each column a name in the header, with the same separator as in the "
                "rows" if short[0].actual_columns > short[0].expected_columns else "remove them",
            )  # fmt: skip
        if held is None:
            return
        if not whole:
            notes.append(f"{self.path.name} does not end with a line: its last line is left out")
        held = held if whole or short else held.slice(0, len(held) - 1)
        if len(held):
            yield held

    def _input(self) -> Any:
        """What is parsed: the path, or the content with single spaces."""
        if self.delimiter != " ":
            return self.path
        return pa.TransformInputStream(pa.OSFile(str(self.path)), _SingleSpaces())

    def _ends_with_a_line(self) -> bool:
        with self.path.open("rb") as stream:
            stream.seek(max(self.path.stat().st_size - 2, 0))
            return stream.read().rstrip(b"\0")[-1:] in (b"\n", b"\r")


class _SingleSpaces:
    """Makes one space of each run of them, and none of those at the ends of lines."""

    def __init__(self) -> None:
        self.at_start, self.spaces = True, False

    def __call__(self, part: pa.Buffer) -> bytes:
        text = re.sub(rb" +", b" ", bytes(part))
        text = re.sub(rb"(?<=[\r\n]) | (?=[\r\n])", b"", text)
        if self.at_start or self.spaces:
            text = text.removeprefix(b" ")
        if not text:
            return b""
        if self.spaces and not self.at_start and text[:1] not in b"\r\n":
            text = b" " + text
        self.spaces = text.endswith(b" ")
        text = text.removesuffix(b" ")
        self.at_start = text[-1:] in b"\r\n" if text else self.at_start
        return text


def opened(path: Path) -> CsvFile:
    """How a CSV file is written. Raises RecordingError for what has no header of two names."""
    with path.open("rb") as stream:
        head = stream.read(HEAD)
    encoding = _encoding(head)
    text = head.decode(encoding, errors="replace") if encoding else ""
    lines = re.split("\r\n|\r|\n", text)  # not splitlines(), which splits at Latin-1's x85, too
    before, names, delimiter = _header(lines)
    if len(names) < 2:
        raise _no_table(path, head)
    if _is_data(lines[before - 1]):
        raise RecordingError(
            f"{path.name} has no header line", value=repr_short(lines[before - 1]),
            remedy="write the names of the columns before the first row",
        )  # fmt: skip
    point = _decimal_point(path, head, encoding, delimiter)
    return CsvFile(path, encoding, tuple(names), delimiter, before, point)


def _no_table(path: Path, head: bytes) -> RecordingError:
    for start, (what, remedy) in FOREIGN.items():
        if head.startswith(start):
            return RecordingError(f"{path.name} is {what}", remedy=remedy)
    return RecordingError(
        f"{path.name} is no log: neither a bag nor a table with a header line",
        remedy="give a ROS bag, an MCAP file, a YARP folder, or CSV or Parquet files",
    )


def _encoding(head: bytes) -> str:
    """The encoding of a text by its first bytes; empty for what is no text."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if b"\0" in head:
        return ""
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def _header(lines: list[str]) -> tuple[int, list[str], str]:
    """How many lines there are up to and with the header, its names and what is between them."""
    separator, comment = "", -1
    for number, line in enumerate(lines):
        text = line.strip()
        if match := re.fullmatch('"?sep=(.)"?', text):
            separator = match[1]
        elif text.startswith(COMMENTS):
            comment = number
        elif text:
            at = comment if comment >= 0 and _is_data(text) else number
            break
    else:
        at = comment
    if at < 0:
        return 0, [], ","
    line = lines[at]
    delimiter = separator or _delimiter(line)
    if delimiter == " ":
        line = " ".join(line.split())
    try:
        names = next(csv.reader([line], skipinitialspace=True, delimiter=delimiter), [])
    except csv.Error:
        return 0, [], ","
    names = [name.strip() for name in names]
    if names and (names[0].startswith("#") or names[0] == "%"):  # %time is a name
        names[:1] = filter(None, [names[0].lstrip("#% ")])
    return at + 1, names, delimiter


def _is_data(line: str) -> bool:
    """Whether a line holds more numbers than words and names no times: other columns of a header
    may be numbered."""
    words = re.split(r"[\s,;]+", line.strip())
    if any(map(is_time, words)):
        return False
    numbers = sum(bool(re.fullmatch(r"[-+]?[\d.]+([eE][-+]?\d+)?|nan", word)) for word in words)
    return 2 * numbers > len(words)


def _delimiter(header: str) -> str:
    """What is between the columns of a CSV file, by its header."""
    most = max(",;\t", key=header.count)
    spaced = most not in header and any(map(is_time, header.split()))
    return " " if spaced else most


def _decimal_point(path: Path, head: bytes, encoding: str, delimiter: str) -> str:
    """What is before the decimals of numbers: by the first rows, else by the first that have any.

    In quotes beside commas `2,360` may be 2360 or 2.36: other numbers of decimals tell.
    """
    ends = rf"[{delimiter}\r\n]"

    def number(point: str) -> re.Pattern[bytes]:
        text = rf'(?:^|{ends}) *"?[-+]?\d*{point}\d+(?:[eE][-+]?\d+)?"? *(?:$|{ends})'
        return re.compile(text.encode())

    with_point, with_comma = number("[.]"), number(",")
    if delimiter == ",":
        with_comma = re.compile(rb'"[-+]?\d+,(?:\d{1,2}|\d{4,})"')
    if encoding == "utf-16":
        head = path.read_text(encoding, errors="replace").encode()
    if with_point.search(head):
        return "."
    if with_comma.search(head):
        return ","
    with path.open("rb") as stream:
        if len(head) < HEAD or encoding == "utf-16":
            return "."
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as every:
            return "," if with_comma.search(every) and not with_point.search(every) else "."


def _widest(field: pa.Field) -> tuple[str, pa.DataType]:
    """Name and type of a column whose first rows are of a type: integers may have decimals later,
    missing numbers be there, and seconds have parts."""
    if pa.types.is_integer(field.type) or pa.types.is_null(field.type):
        return field.name, pa.float64()
    if pa.types.is_timestamp(field.type):
        return field.name, pa.timestamp("ns", field.type.tz)
    return field.name, field.type
