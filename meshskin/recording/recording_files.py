"""The files of a recording: one Parquet file a table, which appear only when all are written."""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pyarrow as pa
import pyarrow.parquet as pq

from ..core.atomic_io import atomic
from ..core.errors import RecordingError

_KEY = b"meshskin"


def part_path(path: str | Path, part: str) -> Path:
    """The file that holds one table of the recording at `path`: path.PART.parquet."""
    path = Path(path)
    return path.parent / f"{path.name}.{part}.parquet"


def common_part(path: Path) -> Path:
    """The common part of a recording's file names, from one of its files or its run's folder."""
    if path.name.endswith((".contacts.parquet", ".readings.parquet", ".motion.parquet")):
        return path.with_suffix("").with_suffix("")
    in_folder = path / "recording"
    return in_folder if part_path(in_folder, "contacts").exists() else path


def read_table(file: Path) -> tuple[pa.Table, dict[str, Any]]:
    """A table of a recording, memory-mapped, and its metadata. Raises RecordingError."""
    try:
        table = pq.ParquetFile(file, memory_map=True).read()
        return table, json.loads((pq.read_metadata(file).metadata or {})[_KEY])
    except (pa.ArrowInvalid, OSError) as error:
        raise RecordingError(
            f"{file} cannot be read: {str(error).splitlines()[0]}", remedy="record it again"
        ) from error
    except (KeyError, ValueError) as error:
        raise RecordingError(
            f"{file} has no meshskin metadata",
            remedy="write it with Recording.save or RecordingWriter",
        ) from error


class RecordingWriter:
    """Streams tables to the files of a recording, which appear only when all are written.

    Use as a context manager; an exception inside leaves nothing behind. `metadata` is written last,
    so that it may be completed while the tables stream.
    """

    def __init__(self, path: str | Path, metadata: Mapping[str, Any]) -> None:
        self.path = Path(path)
        self.metadata = dict(metadata)
        self._stack = ExitStack()
        self._writers: dict[str, pq.ParquetWriter] = {}

    def __enter__(self) -> Self:
        return self

    def _writer(self, part: str, schema: pa.Schema) -> pq.ParquetWriter:
        if part not in self._writers:
            temporary = self._stack.enter_context(atomic(part_path(self.path, part)))
            self._writers[part] = self._stack.enter_context(pq.ParquetWriter(temporary, schema))
        return self._writers[part]

    def write(
        self, *, contacts: pa.Table, readings: pa.Table, motion: pa.Table | None = None
    ) -> None:
        """Append rows to the tables."""
        for part, table in (("contacts", contacts), ("readings", readings), ("motion", motion)):
            if table is not None:
                self._writer(part, table.schema).write_table(table)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            header = self._header()
            for writer in self._writers.values():
                writer.add_key_value_metadata({_KEY: header})
            if "motion" not in self._writers:
                part_path(self.path, "motion").unlink(missing_ok=True)

    def _header(self) -> str:
        """The metadata as JSON. Raises RecordingError."""
        try:
            return json.dumps({**self.metadata, "recording_id": secrets.token_hex(8)})
        except (TypeError, ValueError) as error:
            raise RecordingError(
                f"metadata of a recording must be JSON values: {error}",
                remedy="give numbers, texts, lists and dicts",
            ) from error
