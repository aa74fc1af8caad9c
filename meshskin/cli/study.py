"""`meshskin study FILE --out DIR`: run a parameter study; a repeated call resumes it.

DIR/table.parquet and table.csv hold one row per case: parameters, status, results. figure.png shows
the mean position error, or the first result, over the first parameter with several values.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from .options import QUIET, RESULTS, integer, option
from .progress_bar import bar

if TYPE_CHECKING:
    import pyarrow as pa

    from ..study.sweep.study import Progress
    from ..study.sweep.study_table import StudyTable

SHOWN = 5
"""Failed cases that the summary lists."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "file FILE", "study file (TOML)", Path)
    option(parser, "--out DIR", RESULTS, Path, required=True)
    where = parser.add_mutually_exclusive_group()
    option(where, "--workers N", "processes (default: every core)", integer(1))
    option(where, "--scheduler URL", "address of a Dask scheduler, tcp://host:port")
    option(parser, "--retry", "run failed cases again")
    option(parser, "--quiet", QUIET)


def command(options: argparse.Namespace) -> int:
    """Run the study and print the summary: 0 when every case is done, 1 when some failed."""
    from ..study.sweep.study import Study

    study = Study.load(options.file)
    with bar(options.quiet) as show:

        def progress(state: Progress) -> None:
            if show is not None:
                failed = f", {state.failed} failed" * bool(state.failed)
                show("cases", state.done, state.total, failed)

        try:
            table = study.sweep(
                options.out,
                workers=options.workers,
                scheduler=options.scheduler,
                retry=options.retry,
                progress=progress,
            )
        except KeyboardInterrupt:
            kept = f"cases that are done are kept in {options.out}; the same command continues"
            print(f"meshskin: {kept}", file=sys.stderr)
            raise
    figure = draw(study.results(options.out), options.out)
    if not options.quiet:
        print(summary(study.name, table, options.out))
        print(f"  figure {figure}")
    return int("failed" in table.column("status").to_pylist())


def draw(table: StudyTable, folder: Path) -> Path | str:
    """Draw the table; returns the file, or why there is none."""
    from ..core import drawing
    from ..core.atomic_io import atomic
    from ..core.errors import StudyError

    path = folder / "figure.png"
    try:
        content = drawing.png(table.plot())
    except StudyError as error:
        path.unlink(missing_ok=True)
        return f"none: {error}"
    with atomic(path) as temporary:
        temporary.write_bytes(content)
    return path


def summary(name: str, table: pa.Table, folder: Path) -> str:
    """The text that the command prints."""
    rows = [
        (key, error)
        for key, status, error in zip(
            *(table.column(c).to_pylist() for c in ("key", "status", "error")), strict=True
        )
        if status == "failed"
    ]
    lines = [f"{name}: {table.num_rows} cases, {len(rows)} failed"]
    lines += [f"  {key}  {error}" for key, error in rows[:SHOWN]]
    if len(rows) > SHOWN:
        lines.append(f"  and {len(rows) - SHOWN} more")
    if rows:
        lines.append("  use --retry to run the failed cases again")
    lines.append(f"  table  {folder / 'table.parquet'}, table.csv")
    return "\n".join(lines)
