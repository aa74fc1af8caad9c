"""Files that are either whole or not there: written beside their place, then moved into it."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import OutputError


def output_error(path: Path, error: OSError) -> OutputError:
    """What to say of a file or folder that the system does not let one make."""
    return OutputError(
        f"cannot write {path}",
        value=error.strerror,
        remedy="choose a folder that you may write to (--out)",
    )


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; move it to `path` on success, delete it otherwise.

    Raises OutputError if the folder cannot be written.
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
        raise OutputError(
            f"cannot write {path}",
            value=error.strerror,
            remedy="free space or choose another --out",
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def check_folder(folder: Path) -> None:
    """Make the output folder and try it, before any work is done. Raises OutputError."""
    check_writable(folder / "metrics.json")


def check_writable(path: Path) -> None:
    """Make a file's folder and try it, before any work is done. Raises OutputError."""
    probe = path.with_name(f"{path.name}.probe")
    with atomic(probe):
        pass
    probe.unlink()


def write_text(path: str | Path, text: str) -> None:
    """Write `text` to `path` atomically, in UTF-8."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` to `path` atomically, with null in place of numbers that JSON does not know."""
    write_text(path, json.dumps(_finite(value), indent=2) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
