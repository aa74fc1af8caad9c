"""Readers of logs, one format a file, chosen by content."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from ...core.arguments import check_path, check_type
from ...core.errors import RecordingError

if TYPE_CHECKING:
    from ..log_map import LogMap, StreamMap
    from ..stream import Log


def read_log(
    path: str | Path,
    log_map: LogMap | None = None,
    *,
    messages: Collection[str | Path] | str | Path = (),
    progress: bool = False,
    scan: bool = False,
) -> Log:
    """The log at `path`: a ROS 1 bag, a ROS 2 bag (SQLite or MCAP, file or folder), a folder of the
    YARP data dumper, or CSV or Parquet files.

    With a map the streams that it names, with their values; without one the times of all streams.
    `messages`: definitions (.msg) of message types that a bag lacks, or one of them. `scan`: read a
    ROS 1 bag that was never closed. Raises RecordingError for what is not a log or is not what the
    map says, UnknownNameError for a stream that is not there. A torn file is read up to the tear,
    and the notes of the log say so.
    """
    return read_and_suggest(path, log_map, messages=messages, progress=progress, scan=scan)[0]


def read_and_suggest(
    path: str | Path,
    log_map: LogMap | None = None,
    *,
    messages: Collection[str | Path] | str | Path = (),
    progress: bool = False,
    scan: bool = False,
) -> tuple[Log, dict[str, list[StreamMap]]]:
    """The log at `path` and, without a map, what its streams could be, the likeliest first."""
    from ..log_map import LogMap
    from .bag import read as bag

    if log_map is not None:
        check_type(LogMap, log_map, "log_map")
    path = check_path("a log", path, error=RecordingError)
    messages = (messages,) if isinstance(messages, str | os.PathLike) else messages
    if not path.exists():
        raise RecordingError(f"no log at {path}", remedy="check the path")
    try:
        if (reader := _other_reader(path)) is not None:
            if messages or scan:
                raise RecordingError(
                    "message types and the scan of records are for bags", value=path.name,
                    remedy="leave messages= (--messages) and scan=True (--scan) out",
                )  # fmt: skip
            return reader.read(path, log_map, progress=progress)
        files = (*map(Path, messages), *(log_map.messages if log_map is not None else ()))
        return bag.read(path, log_map, files, progress=progress, scan=scan)
    except OSError as error:
        raise RecordingError(f"cannot read {path}", value=error.strerror) from error


def _other_reader(path: Path) -> ModuleType | None:
    """The reader of a log that is not a bag; None: it is one."""
    from . import table, yarp
    from .bag import read as bag

    if path.is_dir():
        names = {file.name for file in path.iterdir()}
        if any(path.rglob("data.log")):
            return yarp
        tables = {Path(name).suffix for name in names} & set(table.SUFFIXES)
        return table if "metadata.yaml" not in names and tables else None
    if bag.format_of(path):
        return None
    return yarp if path.name in ("data.log", "info.log") else table
