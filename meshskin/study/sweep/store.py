"""The folder of a study: one small file per case, a manifest, and tables.

    OUT/study.json               definition of the study
    OUT/results/3f/3fa0....json  one case: a line with a checksum, a line of JSON
    OUT/table.parquet            the cases in order: parameters, status, results
    OUT/table.csv                the same table for people and spreadsheets
    OUT/times.parquet            seconds of each case, which differ from run to run

Every file is written under a temporary name and moved into place. A file that is incomplete
nevertheless (after a power cut) fails its checksum and is ignored. Only the process that holds the
lock writes.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.atomic_io import atomic, output_error, write_text
from ...core.errors import OutputError, StudyError
from ...core.provenance import digest
from .case import Case, Limits, Outcome

if TYPE_CHECKING:
    import pyarrow as pa


if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


class Store:
    """Results by key, in the folder of a study."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.results = self.folder / "results"

    def file(self, key: str) -> Path:
        """Path of the result of a case."""
        return self.results / key[:2] / f"{key}.json"

    def write(self, outcome: Outcome) -> None:
        """Write a result. Raises OutputError if the disk is full or not writable."""
        text = json.dumps(asdict(outcome), separators=(",", ":"))
        write_text(self.file(outcome.key), f"{digest(text)}\n{text}\n")

    def read(self, key: str) -> Outcome | None:
        """The result of a case; None if there is none, or if its file is incomplete or of another
        version. Raises OutputError if the file cannot be read."""
        try:
            text = self.file(key).read_text(encoding="utf-8")
        except (FileNotFoundError, UnicodeDecodeError):
            return None
        except OSError as error:
            raise OutputError(f"cannot read {self.file(key)}", value=error.strerror) from error
        checksum, _, body = text.partition("\n")
        body = body.removesuffix("\n")
        if checksum != digest(body):
            return None
        try:
            fields = json.loads(body)
            found = Outcome(**fields | {"limits": Limits(**fields["limits"])})
        except (KeyError, TypeError, ValueError):
            warnings.warn(
                f"results in {self.results} that another version of meshskin wrote are ignored",
                stacklevel=2,
            )
            return None
        return found if found.key == key else None

    def keys(self) -> set[str]:
        """Keys of all result files, complete or not. Removes what an interrupted writer left."""
        found: set[str] = set()
        if not self.results.is_dir():
            return found
        for shard in os.scandir(self.results):
            for entry in os.scandir(shard.path) if shard.is_dir() else ():
                if entry.name.endswith(".part"):
                    Path(entry.path).unlink(missing_ok=True)
                elif entry.name.endswith(".json"):
                    found.add(entry.name.removesuffix(".json"))
        return found

    def describe(self, manifest: dict[str, Any]) -> None:
        """Write study.json."""
        text = json.dumps(manifest, indent=2, default=str)
        write_text(self.folder / "study.json", text + "\n")

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the lock of the folder; the system releases it when the process ends.

        Raises StudyError if another process holds it, OutputError if the folder is not writable.
        """
        path = self.folder / ".lock"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise output_error(self.folder, error) from error
        with file:
            try:
                _lock(file.fileno())
            except OSError as error:
                file.seek(0)
                raise StudyError(
                    f"another run is writing to {self.folder}",
                    value=file.read().strip() or None,
                    remedy="wait for it, or choose another --out",
                ) from error
            try:
                file.truncate(0)
                file.write(f"process {os.getpid()} on {socket.gethostname()}")
                file.flush()
            except OSError as error:
                raise OutputError(
                    f"cannot write {path}", value=error.strerror, remedy="free space"
                ) from error
            yield


def _lock(descriptor: int) -> None:
    """Take an exclusive lock without waiting. Raises OSError."""
    if sys.platform == "win32":
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


MISSING = "missing"
"""Status of a case that has no result yet."""


def _table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """The Arrow table of rows; a column is null in rows that do not have it."""
    import pyarrow as pa

    names = dict.fromkeys(name for row in rows for name in row)
    return pa.table({name: _column([row.get(name) for row in rows]) for name in names})


def _column(values: list[Any]) -> pa.Array:
    """An Arrow column, whose type follows from its values; text for values of several types."""
    import pyarrow as pa

    if all(v is None for v in values):
        return pa.array(values, pa.float64())
    try:
        column = pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        column = None
    # True after 0.5 is taken for 1.0, True after 1 is refused
    if column is None or (any(v is True or v is False for v in values) and column.type != "bool"):
        return pa.array([None if v is None else str(v) for v in values], pa.string())
    return column


def tables(rows: Iterable[tuple[Case, Outcome | None]]) -> tuple[pa.Table, pa.Table]:
    """The table of results and the table of times, one row per case, in the order of the cases.

    A parameter that is neither a number nor text (a list) is written as text.
    """
    main: list[dict[str, Any]] = []
    times: list[dict[str, Any]] = []
    for case, outcome in rows:
        main.append(
            {
                **{name: _cell(value) for name, value in case.parameters.items()},
                "method": case.method,
                "seed": case.seed,
                "key": case.key,
                "status": outcome.status if outcome else MISSING,
                "error": outcome.error if outcome else None,
                **(outcome.values if outcome else {}),
            }
        )
        times.append({"key": case.key, "seconds": outcome.seconds if outcome else None})
    return _table(main), _table(times)


def _cell(value: Any) -> Any:
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table as Parquet or CSV, by the suffix, atomically. Raises OutputError."""
    from pyarrow import csv, parquet

    with atomic(path) as temporary:
        if path.suffix == ".csv":
            csv.write_csv(table, temporary)
        else:
            parquet.write_table(table, temporary)
