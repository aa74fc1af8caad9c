"""The table of a study's results, as a notebook shows it, and its figure."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ...core import config
from ...core.errors import StudyError
from ...core.notebook import Card, Tabular
from ...core.palette import METHOD_COLOURS
from ...core.value import Value

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

USUAL = "position_error_mm.mean"
"""The result that a figure shows where the study has it."""
MAX_LINES = 8
"""Lines of a figure: more cannot be distinguished."""
SYMBOLS = {"pa": "Pa", "kpa": "kPa", "mpa": "MPa", "gpa": "GPa", "hz": "Hz", "n": "N", "n_m": "N m"}
"""Symbols of units with capital letters, by the suffix of a column's name."""


@dataclass(frozen=True, eq=False)
class StudyTable(Value, Card, Tabular):
    """The results of a study: one row per case."""

    table: pa.Table
    parameters: tuple[str, ...]
    """Columns that are parameters, in the order of the grid; "method" among them if it varies."""
    name: str = "study"

    def __repr__(self) -> str:
        return f"<StudyTable {self.name!r}: {self.status}, {self.table.num_columns} columns>"

    def to_arrow(self) -> pa.Table:
        """The Arrow table."""
        return self.table

    @property
    def status(self) -> str:
        """How many cases are done, failed and missing, in words."""
        counts = Counter(self.table.column("status").to_pylist()).most_common()
        return ", ".join(f"{n} {status}" for status, n in counts) or "no cases"

    @property
    def results(self) -> list[str]:
        """The columns that hold numbers and are neither parameters nor facts of a case."""
        import pyarrow.types as kinds

        fixed = {*self.parameters, "method", "seed", "key", "status", "error"}
        return [
            field.name
            for field in self.table.schema
            if field.name not in fixed
            and (kinds.is_floating(field.type) or kinds.is_integer(field.type))
        ]

    def facts(self) -> dict[str, str]:
        """Cases, parameters with their values, and results, for a notebook."""
        facts = {"name": self.name, "cases": self.status}
        for name in self.parameters:
            facts[name] = ", ".join(map(str, _distinct(self.table.column(name).to_pylist())))
        return facts | {"results": ", ".join(self.results) or "none"}

    def plot(
        self,
        ax: Axes | None = None,
        y: str | None = None,
        x: str | None = None,
        by: str | None = None,
    ) -> Figure:
        """Draw the mean of the result `y` over `x`, one line for each value of `by`.

        All other parameters and the seeds are averaged over; faint dots are single cases. y: by
        default the mean position error, or else the first result; x and by: the first two
        parameters with several values. ax: matplotlib axes; None: those of a new figure. Raises
        StudyError for an unknown column, and where no case has a result.
        """
        from ...core import drawing

        columns = self.table.column_names
        y = y or (USUAL if USUAL in columns else next(iter(self.results), None))
        varied = [p for p in self.parameters if len(_distinct(self.table[p].to_pylist())) > 1]
        x = x or next((p for p in varied if p != by), "seed")
        by = by or next((p for p in varied if p != x), None)
        for name in (y, x, by):
            if name is not None and name not in columns:
                raise StudyError("no such column", value=name, limit=", ".join(columns))
        if y is None or self.table[y].null_count == self.table.num_rows:
            raise StudyError("no case has a result to draw", value=self.status)
        rows = list(zip(*(self._column(name) for name in (by, x, y)), strict=True))
        lines = []
        for line in _distinct(row[0] for row in rows)[:MAX_LINES]:
            own = [(at, value) for label, at, value in rows if label == line and value is not None]
            across = _distinct(at for at, _ in own)
            values = [[v for a, v in own if a == at] for at in across]
            label = "" if by is None else f"{by.rpartition('.')[2]} = {line}"
            lines.append((label, across, values))
        colors = {f"method = {method}": color for method, color in METHOD_COLOURS.items()}
        return drawing.curves(ax, lines, _axis(x), _axis(y), colors)

    def _column(self, name: str | None) -> list[Any]:
        return [None] * self.table.num_rows if name is None else self.table.column(name).to_pylist()


def _axis(name: str) -> str:
    """The end of a column's name: effects.friction.young_kpa reads "friction, young (kPa)"."""
    words = []
    for part in name.split(".")[-2:]:
        plain = config.stem(part)
        unit = part[len(plain) + 1 :]
        words.append(f"{plain} ({SYMBOLS.get(unit, unit)})" if unit else plain)
    return ", ".join(words).replace("_per_", "/").replace("_", " ")


def _distinct(values: Any) -> list[Any]:
    """The values without repetitions: numbers in their order, others as they come."""
    found = list(dict.fromkeys(v for v in values))
    plain = all(isinstance(v, int | float) for v in found)
    return sorted(found) if plain else found
