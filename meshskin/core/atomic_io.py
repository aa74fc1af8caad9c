"""Atomic writes: a file is written under a temporary name in its folder, then renamed."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .errors import OutputError

RESULTS = (
    "calibration.parquet", "calibration.csv", "cross_validation.parquet", "metrics.json",
    "report.html", "corrected.urdf",
)  # fmt: skip
"""Files that a calibration writes; those of an earlier recording are removed."""


def output_error(
    path: Path, error: OSError, remedy: str = "choose a folder that you may write to (--out)"
) -> OutputError:
    """The OutputError for a file or folder that cannot be written."""
    return OutputError(f"cannot write {path}", value=error.strerror, remedy=remedy)


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """Context with a temporary path, renamed to `path` on success and deleted on failure.

    Makes the folder of `path`. Raises OutputError if it cannot be written; an error of the body
    that is not about writing this file, as of reading another one, is raised as it is.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        os.close(handle)
    except OSError as error:
        raise output_error(path, error) from error
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, path)
    except OSError as error:
        of_writing = error.errno is not None and error.filename in (None, name, temporary)
        if not of_writing:
            raise
        raise output_error(path, error, "free space or choose another --out") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_folder(folder: Path) -> None:
    """Make an output folder and check, before any work, that it is writable. Raises OutputError."""
    check_writable(folder / "metrics.json")


def check_writable(path: Path) -> None:
    """Check, before any work, that a file can be written. Raises OutputError."""
    probe = path.with_name(f"{path.name}.probe")
    try:
        with atomic(probe):
            pass
    except OutputError as error:
        raise OutputError(f"cannot write {path}", value=error.value, remedy=error.remedy) from error
    probe.unlink()


def remove_results(folder: Path) -> None:
    """Remove the result files of an earlier recording."""
    for name in RESULTS:
        (folder / name).unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` to `path` atomically, in UTF-8."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as JSON to `path` atomically, with null for infinite and NaN numbers; numbers
    and arrays of NumPy are written as numbers and lists."""
    write_text(path, json.dumps(plain(value, finite), indent=2) + "\n")


def plain(value: Any, number: Callable[[float], Any] = float) -> Any:
    """`value` of Python's own types, at any depth; `number`: what becomes of a float."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(v, number) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v, number) for v in value]
    return number(value) if isinstance(value, float) else value


def finite(value: float) -> float | None:
    """None for an infinite number and for NaN, which JSON does not have."""
    return value if math.isfinite(value) else None
