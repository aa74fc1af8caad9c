"""`meshskin lint FILE`: find defects of a skin file.

Find defects of a skin file. Exit code 0: no defect; 1: defects found; 2: the file cannot be read.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .options import add_part, option

if TYPE_CHECKING:
    from ..skin.lint import Defect

SHOWN = 12
"""Ranges of numbers that one line shows."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option(parser, "file FILE", "skin file in any supported format", Path)
    add_part(parser)
    option(parser, "--all", "print long lists in full")


def command(options: argparse.Namespace) -> int:
    """Print the defects."""
    from ..skin import files
    from ..skin.lint import check

    table = files.read(options.file, options.part)
    defects = check(table)
    count, found = int(table.is_taxel().sum()), len(defects)
    words = {0: "no defect found", 1: "1 defect"}.get(found, f"{found} defects")
    print(f"{options.file.name}: {table.format}, {count} taxels, {words}")
    for defect in defects:
        print()
        for line in lines(defect, None if options.all else SHOWN):
            print(line)
    return 1 if defects else 0


def lines(defect: Defect, shown: int | None) -> Iterator[str]:
    """The lines of text that describe a defect."""
    yield f"{defect.kind}: {defect.what}"
    if defect.taxels:
        yield f"  taxels   {numbers(defect.taxels, shown)}"
    if defect.modules:
        yield f"  modules  {numbers(defect.modules, shown)}"
    yield f"  remedy   {defect.remedy}"


def numbers(values: Sequence[int], shown: int | None) -> str:
    """Sorted numbers as ranges such as "0-5, 7", at most `shown` of them."""
    ranges: list[list[int]] = []
    for value in values:
        if ranges and value == ranges[-1][1] + 1:
            ranges[-1][1] = value
        else:
            ranges.append([value, value])
    few = ranges[:shown]
    text = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in few)
    left = sum(b - a + 1 for a, b in ranges[len(few) :])
    return f"{text}, and {left} more (--all)" if left else text
