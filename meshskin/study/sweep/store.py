"""The folder of a study: one small file a case, a manifest, and tables.

    OUT/study.json               what the study is
    OUT/results/3f/3fa0....json  one case: a line with the checksum, a line of JSON
    OUT/table.parquet            the cases in order: parameters, status, results
    OUT/times.parquet            seconds of each case, which differ from run to run

Every file is written beside its place and moved there. A file that is torn nevertheless (a power
cut) fails its checksum and counts as not there. Only the process that holds the lock writes.
"""

from __future__ import annotations

import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...core.atomic_io import unwritable, write_text
from ...core.errors import OutputError, StudyError
from ...core.provenance import digest
from .outcome import Limits, Outcome

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


class Store:
    """Results by key, in a folder."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.results = self.folder / "results"

    def file(self, key: str) -> Path:
        """Where the result of a case is."""
        return self.results / key[:2] / f"{key}.json"

    def write(self, outcome: Outcome) -> None:
        """Keep a result. Raises OutputError where the disk is full or may not be written."""
        text = json.dumps(asdict(outcome), separators=(",", ":"))
        write_text(self.file(outcome.key), f"{digest(text)}\n{text}\n")

    def read(self, key: str) -> Outcome | None:
        """The result of a case; None where there is none, or a torn one."""
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
        fields = json.loads(body)
        found = Outcome(**fields | {"limits": Limits(**fields["limits"])})
        return found if found.key == key else None

    def keys(self) -> set[str]:
        """Keys of all result files, torn ones too; what an interrupted writer left is removed."""
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
        """Be the only one that writes here; the system lets go of it when the process ends.

        Raises StudyError where another process holds it, OutputError for an unwritable folder.
        """
        path = self.folder / ".lock"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise unwritable(self.folder, error) from error
        with file:
            try:
                _lock(file.fileno())
            except OSError as error:
                file.seek(0)
                raise StudyError(
                    f"another run is working in {self.folder}",
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
