"""The TOML file of a study.

Keys: name, base, seeds, method, run, version, time_limit_s, memory_limit_mb, and the table [grid]
(or several, [[grid]]), whose keys are those of a scene's file. `base` is a scene's name, or a file
beside the study's; `run` is `package.module:function`, or `file.py:function` beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...core.config import from_table, quantity, read_toml
from ...core.errors import ConfigError
from .function_reference import FunctionReference


@dataclass(frozen=True)
class _StudyTable:
    grid: Any
    name: str | None = None
    base: str | None = None
    seeds: Any = 1
    method: str = "joint"
    run: str | None = None
    version: str = ""
    time_limit: float | None = quantity("s", None, above=0.0)
    memory_limit_mb: float | None = quantity("", None, above=0.0)


def read(path: Path) -> dict[str, Any]:
    """The arguments of Study that a TOML file holds. Raises ConfigError."""
    table = from_table(_StudyTable, read_toml(path), path.name)
    grids = table.grid if isinstance(table.grid, tuple) else (table.grid,)
    if not all(isinstance(grid, Mapping) for grid in grids):
        raise ConfigError(f"grid in {path.name} must be a table", remedy="write [grid] or [[grid]]")
    if not isinstance(table.seeds, int | tuple):
        raise ConfigError("seeds must be a number or a list", value=repr(table.seeds))
    beside = None if table.base is None else path.parent / table.base
    run = {}
    if table.run is not None:
        run["run"] = FunctionReference.parse(table.run, path.parent).load()
    return {
        "name": table.name or path.stem,
        "base": beside if beside is not None and beside.is_file() else table.base,
        "grid": [dict(_flat(grid)) for grid in grids],
        "seeds": table.seeds,
        "method": table.method,
        "version": table.version,
        "time_limit": table.time_limit,
        "memory_limit": None if table.memory_limit_mb is None else 1e6 * table.memory_limit_mb,
        **run,
    }


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested tables: TOML reads `material.young_kpa = ...` as a table."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
