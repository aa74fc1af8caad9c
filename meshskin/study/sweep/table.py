"""The results of a study as Arrow tables, and as Parquet files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.atomic_io import atomic
from .case import Case
from .outcome import Outcome

if TYPE_CHECKING:
    import pyarrow as pa

MISSING = "missing"
"""Status of a case that has no result yet."""


class Columns:
    """Columns that grow row by row; a column is null in rows that do not have it."""

    def __init__(self) -> None:
        self.columns: dict[str, list[Any]] = {}
        self.rows = 0

    def add(self, row: dict[str, Any]) -> None:
        """Add a row."""
        for name in row:
            if name not in self.columns:
                self.columns[name] = [None] * self.rows
        for name, column in self.columns.items():
            column.append(row.get(name))
        self.rows += 1

    def table(self) -> pa.Table:
        """The Arrow table; the type of a column follows from its values."""
        import pyarrow as pa

        return pa.table({name: _column(values) for name, values in self.columns.items()})


def _column(values: list[Any]) -> pa.Array:
    import pyarrow as pa

    kinds = {type(v) for v in values if v is not None}
    if not kinds:
        return pa.array(values, pa.float64())
    if kinds == {bool}:
        return pa.array(values, pa.bool_())
    if kinds == {int}:
        return pa.array(values, pa.int64())
    if kinds <= {int, float}:
        return pa.array([None if v is None else float(v) for v in values], pa.float64())
    return pa.array([None if v is None else str(v) for v in values], pa.string())


def tables(rows: Iterable[tuple[Case, Outcome | None]]) -> tuple[pa.Table, pa.Table]:
    """The table of results and the table of times, one row per case, in the order of the cases.

    A parameter that is neither a number nor text (a list) is written as text.
    """
    main, times = Columns(), Columns()
    for case, outcome in rows:
        main.add(
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
        times.add({"key": case.key, "seconds": outcome.seconds if outcome else None})
    return main.table(), times.table()


def _cell(value: Any) -> Any:
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def write(table: pa.Table, path: Path) -> None:
    """Write a table as Parquet, atomically. Raises OutputError."""
    import pyarrow.parquet as pq

    with atomic(path) as temporary:
        pq.write_table(table, temporary)
