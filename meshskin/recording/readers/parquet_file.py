"""Parquet files: columns of numbers, of lists of them, and of nested fields.

A list of a fixed length is columns `skin[0]`, `skin[1]`, and a field of a struct is `joints.elbow`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from ...core.errors import RecordingError

MAGIC = b"PAR1"
"""First bytes of a Parquet file, and its last ones."""
ROWS = 4096
"""Rows that are read at once, of which the first tell how long lists are."""

LISTS = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)


@dataclass(frozen=True)
class ParquetFile:
    """The columns of a Parquet file."""

    path: Path
    sources: dict[str, str]
    """The column of the file by the names of what it holds."""
    timed: str
    """The first column of times by its type; empty if there is none."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self.sources)

    def batches(self, columns: list[str], notes: list[str]) -> Iterator[pa.RecordBatch]:
        """Rows of some columns, a part at a time. Raises RecordingError."""
        import pyarrow.parquet as pq

        wanted = list(dict.fromkeys(self.sources[name] for name in columns))
        try:
            for batch in pq.ParquetFile(self.path).iter_batches(ROWS, columns=wanted):
                found = self._flat(batch)
                for name in columns:  # rows of other streams alone
                    if batch.column(self.sources[name]).null_count == len(batch):
                        found.setdefault(name, pa.nulls(len(batch), pa.float64()))
                if missing := [name for name in columns if name not in found]:
                    raise RecordingError(
                        f"the lists of {self.sources[missing[0]]} in {self.path.name} have "
                        "different lengths", value=f"no {missing[0]} in some rows",
                        remedy="write lists of one length",
                    )  # fmt: skip
                yield pa.record_batch({name: found[name] for name in columns})
        except (pa.ArrowInvalid, OSError) as error:
            notes.append(
                f"{self.path.name} is torn ({str(error).splitlines()[0]}): what is before is read"
            )

    def _flat(self, batch: pa.RecordBatch) -> dict[str, pa.Array]:
        return {
            name: part
            for column in batch.schema.names
            for name, part in _flat(column, batch.column(column), self.path)
        }


def _flat(name: str, column: pa.Array, file: Path) -> Iterator[tuple[str, pa.Array]]:
    """The columns of numbers of a column, with their names. Raises RecordingError for lists of
    different lengths."""
    kind = column.type
    if pa.types.is_struct(kind):
        for k in range(kind.num_fields):
            yield from _flat(f"{name}.{kind.field(k).name}", pc.struct_field(column, k), file)
    elif any(test(kind) for test in LISTS):
        sizes = pc.min_max(pc.list_value_length(column))
        least, most = sizes["min"].as_py(), sizes["max"].as_py()
        if least != most:
            raise RecordingError(
                f"the lists of {name} in {file.name} have different lengths",
                value=f"{least} to {most} values", remedy="write lists of one length",
            )  # fmt: skip
        for k in range(most or 0):
            yield from _flat(f"{name}[{k}]", pc.list_element(column, k), file)
    else:
        yield name, column.dictionary_decode() if pa.types.is_dictionary(kind) else column


def opened(path: Path) -> ParquetFile:
    """The columns of a Parquet file. Raises RecordingError for one that is torn."""
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(path)
        first = next(file.iter_batches(ROWS), None)
    except (pa.ArrowInvalid, OSError) as error:
        raise RecordingError(
            f"{path.name} cannot be read: {str(error).splitlines()[0]}",
            remedy="a torn Parquet file has lost its columns; record it again",
        ) from error
    schema = file.schema_arrow
    timed = [field.name for field in schema if pa.types.is_temporal(field.type)]
    if first is None:
        sources = {name: name for name in schema.names}
    else:
        sources = {
            name: column
            for column in schema.names
            for name, _ in _flat(column, first.column(column), path)
        }
    return ParquetFile(path, sources, timed[0] if timed else "")
