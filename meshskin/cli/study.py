"""`meshskin study FILE --out DIR`: run a parameter study on this machine or a cluster."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    import pyarrow as pa

    from ..study.sweep.study import Progress

SHOWN = 5
"""Failed cases that the summary lists."""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "study",
        help="run all cases of a parameter study; a repeated call resumes it",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="study file (TOML)")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, metavar="N", help="processes (default: every core)")
    where.add_argument(
        "--scheduler", metavar="URL", help="address of a Dask scheduler, tcp://host:port"
    )
    parser.add_argument("--retry", action="store_true", help="run failed cases again")
    parser.add_argument("--quiet", action="store_true", help="print no progress bar and no summary")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Run the study and print the summary: 0 when every case is done, 1 when some failed."""
    from ..study.sweep.study import Study

    study = Study.load(options.file)
    with _bar(options.quiet) as progress:
        table = study.sweep(
            options.out,
            workers=options.workers,
            scheduler=options.scheduler,
            retry=options.retry,
            progress=progress,
        )
    if not options.quiet:
        print(summary(study.name, table, options.out))
    return int("failed" in table.column("status").to_pylist())


@contextmanager
def _bar(quiet: bool) -> Iterator[Callable[[Progress], None]]:
    """A progress bar on stderr; its remaining time does not count cases of earlier runs."""
    from tqdm import tqdm

    bars: list[tqdm] = []

    def progress(state: Progress) -> None:
        if not bars:
            bars.append(
                tqdm(total=state.total, initial=state.kept, desc="cases", unit="", disable=quiet)
            )
        if state.failed:
            bars[0].set_postfix_str(f"{state.failed} failed", refresh=False)
        bars[0].update(state.done - bars[0].n)

    try:
        yield progress
    finally:
        for bar in bars:
            bar.close()


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
    lines.append(f"  table  {folder / 'table.parquet'}")
    return "\n".join(lines)
